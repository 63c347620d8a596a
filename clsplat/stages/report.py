"""The run as one page that opens offline: figures, curves, where the time goes, views beside the truth, settings."""

import base64
import html
import logging
from collections import defaultdict
from typing import Any, ClassVar, Literal

import cv2
import numpy as np

from clsplat.files import write_text
from clsplat.stages.base import Stage
from clsplat.stages.svg import curve
from clsplat.training.metrics import render_view
from clsplat.training.perceptual import Image
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
SHOWN = 3  # worst and best views
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1060px;margin:2rem auto;padding:0 1rem;color:#1a202c}
h1{font-size:1.5rem;margin-bottom:.2rem}h2{font-size:1.1rem;margin-top:2.2rem}p.sub{color:#4a5568;margin-top:0}
dl.figures{display:flex;flex-wrap:wrap;gap:1.2rem 2.4rem}dl.figures dt{color:#4a5568;font-size:.85rem}
dl.figures dd{margin:0;font-size:1.35rem;font-weight:600}
.curves{display:grid;grid-template-columns:repeat(auto-fit,minmax(420px,1fr));gap:1rem}
svg{width:100%;height:auto;background:#f7fafc;border-radius:6px}svg text{font:11px system-ui;fill:#4a5568}
svg text.title{font-weight:600;fill:#1a202c;font-size:12px}svg .grid{stroke:#e2e8f0}
table{border-collapse:collapse}td,th{padding:.15rem .9rem .15rem 0;text-align:right}
th:first-child,td:first-child{text-align:left}
td.bar{width:320px}td.bar i{display:block;height:.8rem;background:#2b6cb0;border-radius:2px}
figure{margin:0 0 1.2rem}figure div{display:grid;grid-template-columns:repeat(3,auto);gap:.4rem;width:fit-content}
figure img{max-width:100%;max-height:26rem;border-radius:4px}figcaption{font-size:.9rem;color:#4a5568}
pre{background:#f7fafc;padding:1rem;border-radius:6px;overflow:auto;font-size:12px}
"""


class Report(Stage):
    """Write report.html."""

    stage: Literal["report"] = "report"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "metrics"})

    file: str = "report.html"  # inside the run folder

    def run(self, run: Run) -> None:
        sections = [_figures(run), _curves(run), _times(run), _views(run), _settings(run)]
        title = html.escape(f"{run.name} · {run.scene.path.name}")
        page = (
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{STYLE}</style>'
            f"<h1>{title}</h1><p class=sub>{html.escape(run.device.text)}</p>{''.join(sections)}</html>\n"
        )
        write_text(run.out / self.file, page)
        LOG.info("report written to %s", run.out / self.file)


def _figures(run: Run) -> str:
    figures = {}
    for split, scales in run.metrics.items():
        for scale, values in scales.items():
            suffix = "" if scale == "1" else f" at 1/{scale}"
            figures[f"{split} PSNR{suffix} ({values['views']} views)"] = f"{values['psnr']:.2f} dB"
            figures[f"{split} SSIM{suffix}"] = f"{values['ssim']:.4f}"
    figures["Gaussians"] = f"{run.trained.gaussians.count:,}"
    figures["steps"] = f"{run.step:,}"
    figures["training"] = _duration(run.train_seconds)
    return "<dl class=figures>" + "".join(f"<div><dt>{k}</dt><dd>{v}</dd></div>" for k, v in figures.items()) + "</dl>"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {rest} s"


def _curves(run: Run) -> str:
    train, tests = run.records.read("train"), run.records.read("evaluate")
    if not train:
        return ""
    line = {key: [(r["step"], r[key]) for r in train] for key in ("loss", "psnr", "gaussians", "ms")}
    measured = {
        f"{split} views": [(r["step"], r["psnr"]) for r in tests if r["split"] == split and r["scale"] == 1]
        for split in ("test", "train")
    }
    charts = [
        curve("PSNR, dB", {"view trained on": line["psnr"], **measured}),
        curve("loss", {"loss": line["loss"]}, logarithmic=True),
        curve("Gaussians", {"Gaussians": line["gaussians"]}),
        curve("milliseconds per step", {"ms": line["ms"]}),
    ]
    return f"<h2>Training</h2><div class=curves>{''.join(charts)}</div>"


def _times(run: Run) -> str:
    """Where a step's time goes on the device, averaged over the sampled steps."""
    samples = [r["stages"] for r in run.records.read("train") if r.get("stages")]
    if not samples:
        return ""
    totals: dict[str, float] = defaultdict(float)
    for sample in samples:
        for name, milliseconds in sample.items():
            totals[name] += milliseconds / len(samples)
    whole = sum(totals.values())
    rows = "".join(
        f"<tr><td>{html.escape(name)}<td>{ms:.2f}<td>{100 * ms / whole:.0f} %"
        f"<td class=bar><i style='width:{100 * ms / whole:.1f}%'></i>"
        for name, ms in totals.items()
    )
    return (
        f"<h2>A training step on the device</h2><p class=sub>average of {len(samples)} sampled steps</p>"
        f"<table><tr><th>stage<th>ms<th>share<th>{rows}<tr><td>sum<td>{whole:.2f}<td><td></table>"
    )


def _views(run: Run) -> str:
    """The worst and the best views of the last evaluation: render, truth and four times their difference."""
    lines = [r for r in run.records.read("view") if r["scale"] == 1 and r["step"] == run.step]
    by_name = {view.name: view for view in run.scene.views}
    ranked = sorted((r for r in lines if r["view"] in by_name), key=lambda r: r["psnr"])
    if not ranked:
        return ""
    worst = ranked[:SHOWN]
    best = [r for r in reversed(ranked) if r not in worst][:SHOWN]
    text = "<h2>Views</h2><p class=sub>render · photograph · difference, four times amplified</p>"
    for title, chosen in (("Worst", worst), ("Best", best)):
        text += f"<h3>{title}</h3>" if chosen else ""
        for record in chosen:
            target = run.targets.get(by_name[record["view"]])
            image = render_view(run.renderer, run.trained, target.camera, run.targets.background_array)
            text += _figure(record, image, target.pixels.get().transpose(1, 2, 0))
    return text


def _figure(record: dict[str, Any], image: Image, truth: Image) -> str:
    difference = np.clip(np.abs(image.astype(np.int16) - truth) * 4, 0, 255).astype(np.uint8)
    pictures = "".join(f'<img src="{_embedded(picture)}" alt="">' for picture in (image, truth, difference))
    name = html.escape(record["view"])
    caption = f"{name} ({record['split']}): {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}"
    return f"<figure><div>{pictures}</div><figcaption>{caption}</figcaption></figure>"


def _embedded(image: Image) -> str:
    _, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"


def _settings(run: Run) -> str:
    path = run.out / "pipeline.yaml"
    text = path.read_text() if path.exists() else ""
    return f"<h2>Settings</h2><pre>{html.escape(text)}</pre>"
