"""Draw test PSNR over CPU seconds of training, one chart for each scene: docs/time.svg.

    python docs/time_chart.py NAME=RUN,RUN … > docs/time.svg

NAME is a title for the scene. Each RUN is a run folder with an `evaluate` in its training; it need not be finished.
"""

import sys
from pathlib import Path

import numpy as np

from clsplat.conformance.bench.measurement import STYLE
from clsplat.runs.results import read_settings
from clsplat.training.records import Records
from clsplat.viewer.charts import HEIGHT, WIDTH, Line, curve

LONGEST = 130  # CPU seconds shown


def psnr_curve(run: Path) -> Line:
    """Return the test PSNR of a run over its CPU seconds."""
    records = Records(run).read()
    trained = [(0.0, 0.0), *((r["step"], r["cpu_seconds"]) for r in records if r["kind"] == "train")]
    tested = [(r["step"], r["psnr"]) for r in records if r["kind"] == "evaluate" and r["split"] == "test"]
    seconds = np.interp([step for step, _ in tested], *zip(*trained, strict=True))
    points = [(float(x), psnr) for x, (_, psnr) in zip(seconds, tested, strict=True) if x <= LONGEST]
    return Line(points, read_settings(run)["name"])


def draw_charts(charts: list[str]) -> str:
    """Return charts in two columns as one SVG."""
    rows = -(-len(charts) // 2)
    places = ((WIDTH * (i % 2), HEIGHT * (i // 2)) for i in range(len(charts)))
    inner = (
        chart.replace("<svg", f'<svg x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}"', 1)
        for chart, (x, y) in zip(charts, places, strict=True)
    )
    size = f'width="{2 * WIDTH}" height="{rows * HEIGHT}" viewBox="0 0 {2 * WIDTH} {rows * HEIGHT}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{"".join(inner)}{STYLE}</svg>\n'


if __name__ == "__main__":
    scenes = (argument.partition("=") for argument in sys.argv[1:])
    print(
        draw_charts([
            curve(f"{name}: test PSNR over CPU seconds, dB", [psnr_curve(Path(run)) for run in runs.split(",")])
            for name, _, runs in scenes
        ]),
        end="",
    )  # fmt: skip
