"""Rectangles before a scene in some of its photographs cost much, and little where pixels or Gaussians take them up.

Scenes are ray-cast, so that the photographs without rectangles are there to compare with.  The rectangles have one
colour and stand about the middle, where they look like one thing that many photographs show.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.data_tools.synthetic import Options, write_dataset
from tests.support.runs import train

PHOTOGRAPHS, SHARE, AREA = 14, 0.4, 0.1  # of them with a rectangle, of which a rectangle covers
MAGENTA = 255, 0, 255, 255
TRANSIENTS = "optimize.modules.transients={start: 100, tail: 3, above: 2}"
DISTRACTORS = "optimize.modules.distractors={start: 30}"
ONE_END = "optimize.evaluate.every=1000", "checkpoint.every=1000", "reset_opacity.stop=1"
LONG = "optimize.steps=400", "optimize.rates.means.over=400", "densify.every=50", "densify.start=50", "densify.stop=250"
SHORT = "optimize.steps=250", "optimize.rates.means.over=250", "densify.stop=16"


def occluded(clean: Path, size: int, seed: int) -> tuple[str, str]:
    """Write a copy of a scene with rectangles, and masks of them; return both folders."""
    rng, folder, masks = np.random.default_rng(seed), clean.parent / f"occluded {seed}", clean.parent / f"masks {seed}"
    write_dataset(folder, options(size), workers=1)
    (masks / "train").mkdir(parents=True)
    for number in sorted(rng.choice(PHOTOGRAPHS, round(SHARE * PHOTOGRAPHS), replace=False)):
        name = f"train/r_{number:03}.png"
        pixels, aspect = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED), rng.uniform(0.6, 1.6)
        height = int(np.sqrt(AREA * size * size * aspect))
        width = int(AREA * size * size / height)
        top, left = (rng.integers(size // 4, 3 * size // 4 - side + 1) for side in (height, width))
        mask = np.full((size, size), 255, np.uint8)
        pixels[top : top + height, left : left + width] = MAGENTA
        mask[top : top + height, left : left + width] = 0
        cv2.imwrite(str(folder / name), pixels)
        cv2.imwrite(str(masks / name), mask)
    return str(folder), str(masks)


def options(size: int) -> Options:
    return Options(size=size, train=PHOTOGRAPHS, test=8, seed=0)


def measured(scene: str | Path, out: Path, *overrides: str) -> float:
    """Train; return the PSNR of the test views, which have no rectangle."""
    train(Path(scene), out, *ONE_END, *overrides)
    return float(json.loads((out / "metrics.json").read_text())["test"]["1"]["psnr"])


def test_left_out_pixels_regain_most_in_a_short_training(tmp_path):
    """Of a fixed number of Gaussians."""
    write_dataset(tmp_path / "clean", options(48), workers=1)
    scene, _ = occluded(tmp_path / "clean", 48, seed=1)
    clean = measured(tmp_path / "clean", tmp_path / "run", *SHORT)
    without = measured(scene, tmp_path / "without", *SHORT)
    regained = measured(scene, tmp_path / "regained", *SHORT, TRANSIENTS)
    assert without < clean - 1.5
    assert regained > clean - 0.6


@pytest.mark.slow
def test_rectangles_cost_little_where_something_takes_them_up(tmp_path):
    """A mask of exactly the rectangles loses 0.4 dB too: what they cover is shown by fewer photographs."""
    clean = tmp_path / "clean"
    write_dataset(clean, options(64), workers=1)
    scene, masks = occluded(clean, 64, seed=0)
    kinds = {"none": (), "transients": (TRANSIENTS,), "distractors": (DISTRACTORS,)}
    before = {kind: measured(clean, tmp_path / f"clean {kind}", *LONG, *set_) for kind, set_ in kinds.items()}
    kinds["masks"] = (f"scene.masks='{masks}'",)
    found = {kind: measured(scene, tmp_path / kind, *LONG, *set_) for kind, set_ in kinds.items()}
    print(before, found)
    lost = {kind: before["none"] - psnr for kind, psnr in found.items()}
    assert lost["none"] > 2
    assert lost["transients"] < 0.8
    assert found["transients"] > found["masks"] - 0.4
    assert lost["distractors"] < lost["none"] - 0.7
    assert min(before.values()) > before["none"] - 0.1, "photographs without anything lose nothing"
