"""Views beside their photographs: the worst and the best."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from clsplat.metrics.perceptual import Image
from clsplat.metrics.views import render_view
from clsplat.pages.page import embedded
from clsplat.training.run import Run

MAX_VIEWS = 3  # of the worst, and of the best


@dataclass(frozen=True)
class ViewFigure:
    """Images of one view with a caption."""

    caption: str
    images: dict[str, str]  # label -> data URL


def views(run: Run) -> dict[str, list[ViewFigure]]:
    """Return the best and the worst views of the last evaluation, by heading."""
    by_name = {view.name: view for view in run.scene.downscaled(run.downscale).views}
    lines = [r for r in run.records.read("view") if r["downscale"] == run.downscale and r["step"] == run.model_step]
    last = {r["view"]: r for r in lines if r["view"] in by_name}  # a view may be measured twice after the same step
    ranked = sorted(last.values(), key=lambda r: r["psnr"])
    worst = ranked[:MAX_VIEWS]
    best = [r for r in reversed(ranked) if r not in worst][:MAX_VIEWS]
    chosen = {"The best views": best, "The worst views": worst}

    def figure(record: dict[str, Any]) -> ViewFigure:
        photograph = run.photographs.get(by_name[record["view"]])
        image = render_view(run.painter(), photograph.camera)
        return _figure(record, image, photograph.image())

    return {
        title: [figure(record) for record in run.until_interrupted(records)]
        for title, records in chosen.items()
        if records
    }


def _figure(record: dict[str, Any], image: Image, photograph: Image) -> ViewFigure:
    difference = np.clip(np.abs(image.astype(np.int16) - photograph) * 4, 0, 255).astype(np.uint8)
    images = {"render": image, "photograph": photograph, "difference": difference}
    caption = f"{record['view']} ({record['split']}): {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}"
    return ViewFigure(caption, {label: embedded(pixels) for label, pixels in images.items()})
