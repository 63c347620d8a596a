"""Draw docs/time.svg: test PSNR over CPU seconds of training, with one chart per scene.

    python docs/time_chart.py NAME=RUN,RUN … > docs/time.svg

NAME is the title of a chart. Each RUN is a run folder whose pipeline has an `evaluate` stage during training.
Unfinished runs are allowed.
"""

import sys
from pathlib import Path

import numpy as np

from clsplat.runs.results import read_settings
from clsplat.training.records import Records
from clsplat.viewer.charts import HEIGHT, WIDTH, Line, line_chart

MAX_SECONDS = 130  # CPU seconds to show
STYLE = "<style>text{font:11px sans-serif;fill:#4a5568}.grid{stroke:#e2e8f0}</style>"


def psnr_curve(run: Path) -> Line:
    """Return the test PSNR of a run over its CPU seconds."""
    records = Records(run).read()
    train_times = [(0.0, 0.0), *((r["step"], r["cpu_seconds"]) for r in records if r["kind"] == "train")]
    test_psnr = [(r["step"], r["psnr"]) for r in records if r["kind"] == "evaluate" and r["split"] == "test"]
    seconds = np.interp([step for step, _ in test_psnr], *zip(*train_times, strict=True))
    points = [(float(x), psnr) for x, (_, psnr) in zip(seconds, test_psnr, strict=True) if x <= MAX_SECONDS]
    return Line(points, read_settings(run)["name"])


def draw_charts(charts: list[str]) -> str:
    """Return an SVG image with the charts in two columns."""
    rows = -(-len(charts) // 2)
    positions = ((WIDTH * (i % 2), HEIGHT * (i // 2)) for i in range(len(charts)))
    placed_charts = (
        chart.replace("<svg", f'<svg x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}"', 1)
        for chart, (x, y) in zip(charts, positions, strict=True)
    )
    size = f'width="{2 * WIDTH}" height="{rows * HEIGHT}" viewBox="0 0 {2 * WIDTH} {rows * HEIGHT}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{"".join(placed_charts)}{STYLE}</svg>\n'


if __name__ == "__main__":
    scenes = (argument.partition("=") for argument in sys.argv[1:])
    print(
        draw_charts([
            line_chart(f"{name}: test PSNR over CPU seconds, dB", [psnr_curve(Path(run)) for run in runs.split(",")])
            for name, _, runs in scenes
        ]),
        end="",
    )  # fmt: skip
