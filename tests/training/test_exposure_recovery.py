"""Known exposures are recovered by runs that only know the points of the scene."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import clsplat
from clsplat.data_tools.synthetic import SyntheticOptions, write_dataset
from clsplat.metrics.views import color_metrics
from clsplat.training.modules.exposure import Gain
from tests.support.runs import train

pytestmark = pytest.mark.slow
FEW = (
    "scene.background=black",
    "optimize.steps=400",
    "optimize.during=[]",
    "init.count=4000",
    "optimize.rates.means=2.0e-4",
)
GAIN = "optimize.modules.exposure={}"


@pytest.fixture(scope="module")
def plain_scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scene") / "as_they_are"
    write_dataset(folder, SyntheticOptions(size=48, train=12, test=3, seed=0), workers=1)
    return folder


def write_with_gains(source: Path, out: Path, rng: np.random.Generator) -> dict[str, float]:
    """Copy a dataset, the training photographs times gains of e^N(0, 0.25); return their logarithms by name."""
    shutil.copytree(source, out)
    results = {}
    for file in sorted((out / "train").glob("*.png")):
        pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        results[file.stem] = float(rng.normal(0, 0.25))
        pixels[..., :3] = np.rint(np.clip(pixels[..., :3] * np.exp(results[file.stem]), 0, 255))
        cv2.imwrite(str(file), pixels)
    return results


def held_out(run: Path) -> float:
    """The mean PSNR of the test views in the colors of their photographs, dB."""
    renderer, scene = clsplat.Renderer(clsplat.load(run)), clsplat.read_scene(run.parent / f"{run.name}_scene")
    results = []
    for view in scene.split("test"):
        picture = renderer.render(view)
        photograph = np.rint(255 * view.photograph(picture.background)).astype(np.uint8)
        results.append(color_metrics(picture.image, photograph, None, Gain())["psnr_color"])
    return float(np.mean(results))


def test_known_exposures_are_found_again_from_scratch(plain_scene, rng, tmp_path):
    """Exposures begin alike, for the dataset has no tracks."""
    truth = write_with_gains(plain_scene, tmp_path / "gain_scene", rng)
    shutil.copytree(tmp_path / "gain_scene", tmp_path / "none_scene")
    for name, more in (("gain", (GAIN,)), ("none", ())):
        train(tmp_path / f"{name}_scene", tmp_path / name, *FEW, *more)
    table = json.loads((tmp_path / "gain" / "view_colors.json").read_text())["photographs"]
    names = list(table)
    actual = np.array([table[name]["exposure"] for name in names])
    known = np.array([truth[Path(name).stem] for name in names])
    errors = actual - actual.mean() - (known - known.mean())
    assert np.std(known) > 0.25
    assert np.sqrt(np.mean(errors**2)) < 0.08, "measured: 0.05"
    psnr = {name: held_out(tmp_path / name) for name in ("gain", "none")}
    assert psnr["gain"] > 28.4, "dB; measured: 29.1, and 29.3 of the photos as they were"
    assert psnr["none"] < psnr["gain"] - 1.2, "dB; measured: 27.0"
