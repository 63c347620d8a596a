"""Rectangles before a scene in some of its photographs cost much, and little where pixels or Gaussians take them up.

Scenes are ray-cast, so that the photographs without rectangles are there to compare with.  The rectangles have one
color and stand about the middle, where they look like one thing that many photographs show.
"""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.data_tools.synthetic import SyntheticOptions, write_dataset
from tests.support.runs import train

SIZE, PHOTOGRAPHS, SHARE, AREA = 40, 14, 0.4, 0.1  # a share of them has a rectangle, which covers a part
MAGENTA = 255, 0, 255, 255
TRANSIENTS = "optimize.modules.transients={start: 140, tail_ratio: 3, outlier_ratio: 2}"
DISTRACTORS = "optimize.modules.distractors={start: 30}"
ENDS = "optimize.evaluate.every=1000", "checkpoint.every=1000", "reset_opacity.stop=1"
STEPS = (
    "optimize.steps=350",
    "optimize.rates.means.over=350",
    "densify.every=40",
    "densify.start=40",
    "densify.stop=210",
)


def occlude(clean: Path) -> Path:
    """Write a copy of a scene with rectangles; return its folder."""
    rng, folder = np.random.default_rng(1), shutil.copytree(clean, clean.parent / "occluded")
    for number in sorted(rng.choice(PHOTOGRAPHS, round(SHARE * PHOTOGRAPHS), replace=False)):
        file = str(folder / f"train/r_{number:03}.png")
        pixels, aspect = cv2.imread(file, cv2.IMREAD_UNCHANGED), rng.uniform(0.6, 1.6)
        height = int(np.sqrt(AREA * SIZE * SIZE * aspect))
        width = int(AREA * SIZE * SIZE / height)
        top, left = (rng.integers(SIZE // 4, 3 * SIZE // 4 - side + 1) for side in (height, width))
        pixels[top : top + height, left : left + width] = MAGENTA
        cv2.imwrite(file, pixels)
    return folder


def measure(scene: Path, out: Path, *overrides: str) -> float:
    """Train; return the PSNR of the test views, which have no rectangle."""
    train(scene, out, *ENDS, *STEPS, *overrides)
    return float(json.loads((out / "metrics.json").read_text())["test"]["1"]["psnr"])


@pytest.mark.slow
def test_occluders_cost_little_with_a_matching_module(tmp_path):
    clean = tmp_path / "clean"
    write_dataset(clean, SyntheticOptions(size=SIZE, train=PHOTOGRAPHS, test=3, seed=0), workers=1)
    occluded = occlude(clean)
    kinds = {"none": (), "transients": (TRANSIENTS,), "distractors": (DISTRACTORS,)}
    before = {kind: measure(clean, tmp_path / f"clean {kind}", *more) for kind, more in kinds.items()}
    lost = {kind: before["none"] - measure(occluded, tmp_path / kind, *more) for kind, more in kinds.items()}
    print(before, lost)
    assert min(before.values()) > before["none"] - 0.1, "photos without anything lose nothing"
    assert lost["none"] > 2
    assert lost["transients"] < lost["none"] / 3, "0.5 to 0.9 dB of 3, by seed"
    assert lost["distractors"] < lost["none"] - 0.7
