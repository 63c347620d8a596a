"""Where runs differ: crops of matched views, each render under a slider that uncovers the photograph."""

import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from clsplat.compare.run_folder import RunFolder
from clsplat.metrics.images import psnr
from clsplat.metrics.perceptual import Image
from clsplat.pages.page import embedded
from clsplat.scene.images import load_image
from clsplat.scene.scene import Background, Scene, View
from clsplat.stages.render import image_path
from clsplat.views.photographs import BACKGROUNDS

LARGEST, SMALLEST = 192, 48  # px, side of a crop: a third of the image within these limits
SHOWN = 4  # crops of a scene, each of another view
OVERVIEW = 340  # px, width of the whole view
STYLE = """
.crop{margin:1.2rem 0 2rem;--cut:50%}.crop p{margin:.2rem 0;font-size:.9rem;color:#4a5568}
.crop>div{display:grid;grid-template-columns:repeat(auto-fit,minmax(190px,1fr));gap:.8rem;align-items:start}
.crop .whole{position:relative}.crop .whole img{width:100%;display:block;border-radius:4px}
.crop .whole i{position:absolute;border:2px solid #e53e3e;box-shadow:0 0 0 1px #fff}
.slider{position:relative;overflow:hidden;border-radius:4px;image-rendering:pixelated;
background:var(--truth) 0 0/100% 100%}
.slider img{display:block;width:100%;image-rendering:pixelated;clip-path:inset(0 calc(100% - var(--cut)) 0 0)}
.slider::after{content:"";position:absolute;top:0;bottom:0;left:var(--cut);width:2px;margin-left:-1px;background:#fff;
box-shadow:0 0 3px #000}
.slider input{position:absolute;inset:0;width:100%;height:100%;margin:0;opacity:0;cursor:ew-resize;z-index:1}
.slider b{position:absolute;bottom:.3rem;left:.3rem;padding:0 .35rem;border-radius:3px;background:#1a202ccc;color:#fff;
font-size:.72rem;font-weight:500}.slider b+b{left:auto;right:.3rem}
.slider:focus-within{outline:2px solid #2b6cb0}
"""
SCRIPT = """
document.addEventListener("input", event => {
  const crop = event.target.closest(".crop");
  crop.style.setProperty("--cut", event.target.value + "%");
  for (const slider of crop.querySelectorAll("input")) slider.value = event.target.value;
});
"""


@dataclass(frozen=True)
class Case:
    """A run under the name that the page gives it."""

    name: str  # HTML
    run: RunFolder


@dataclass(frozen=True)
class Crop:
    """A square of one view."""

    view: View
    truth: Image
    renders: list[Image]  # whole, by case
    x: int
    y: int
    side: int
    spread: float  # mean difference there, in grey levels

    def of(self, image: Image) -> Image:
        return np.ascontiguousarray(image[self.y : self.y + self.side, self.x : self.x + self.side])


def crops(cases: Sequence[Case], scene: Scene, background: Background) -> str:
    """Crops of the views that all runs of one scene rendered, where the renders differ most; "" when there is none.

    Raises DataError when a render or a photograph is damaged.
    """
    matched = [view for view in scene.views if all(_file(c.run, view).is_file() for c in cases)]
    chosen: list[Crop] = []  # one view at a time in memory, and the best ones
    for view in matched:
        renders = [load_image(replace(view, image_path=_file(c.run, view))) for c in cases]
        chosen.append(_largest_difference(view, load_image(view, BACKGROUNDS[background]), renders))
        chosen = sorted(chosen, key=lambda crop: -crop.spread)[:SHOWN]
    return "".join(_section(crop, cases) for crop in chosen)


def _file(run: RunFolder, view: View) -> Path:
    return image_path(run.renders, view.name)


def _largest_difference(view: View, truth: Image, renders: list[Image]) -> Crop:
    """The crop in which the renders differ most from each other, or a single one from the photograph."""
    images = np.stack(renders if len(renders) > 1 else [*renders, truth])
    spread = (images.max(axis=0) - images.min(axis=0)).mean(axis=2, dtype=np.float32)
    smaller = min(truth.shape[:2])
    side = min(smaller, max(SMALLEST, min(LARGEST, smaller // 3)))
    sums = cv2.boxFilter(spread, -1, (side, side), anchor=(0, 0), borderType=cv2.BORDER_CONSTANT)
    inside = sums[: truth.shape[0] - side + 1, : truth.shape[1] - side + 1]
    y, x = np.unravel_index(int(inside.argmax()), inside.shape)
    return Crop(view, truth, renders, int(x), int(y), side, float(inside.max()))


def _section(crop: Crop, cases: Sequence[Case]) -> str:
    height, width = crop.truth.shape[:2]
    place = (
        f"left:{100 * crop.x / width:.2f}%;top:{100 * crop.y / height:.2f}%;"
        f"width:{100 * crop.side / width:.2f}%;height:{100 * crop.side / height:.2f}%"
    )
    size = (OVERVIEW, max(1, round(OVERVIEW * height / width)))
    small = cv2.resize(crop.truth, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    truth = crop.of(crop.truth)
    cells = [
        f'<div><div class=whole><img src="{embedded(small)}" alt=""><i style="{place}"></i></div><p>photograph</div>'
    ]
    for case, image in zip(cases, crop.renders, strict=True):
        render = crop.of(image)
        slider = '<input type=range value=50 aria-label="share of the render; the rest is the photograph">'
        tags = "<b>render</b><b>photograph</b>"
        cells.append(
            f'<div><div class=slider><img src="{embedded(render, ".png")}" alt="">{slider}{tags}</div>'
            f"<p>{case.name}<br>{psnr(render, truth):.2f} dB in this crop</div>"
        )
    name = html.escape(crop.view.name)
    style = f"--truth:url({embedded(truth, '.png')})"
    return f'<div class=crop style="{style}"><h4>{name}</h4><div>{"".join(cells)}</div></div>'
