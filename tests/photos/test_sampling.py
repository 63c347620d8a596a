"""The sample of a step is a function of the step, so that interrupted runs resume to the same bits."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError, Interrupted
from clsplat.core.progress import Progress
from clsplat.photos.sampling import Sampler, ShuffleOrder, ViewPool, ViewSettings
from clsplat.photos.transforms import Blur
from clsplat.pipeline.loading import load, without_auto
from clsplat.runs import opening, runner
from clsplat.scene.detect import read_scene
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow

RESOLUTION = "optimize.views.resolution={points: [[0, 2], [20, 1]], between: steps}"
BLUR = "optimize.views.transforms=[{type: blur, sigma: [[0, 3.0], [30, 0.5], [45, 0.0]]}]"
FRACTIONS = "optimize.views.resolution=[[1, 3.0], [40, 1.0]]"


def test_sample_is_the_ordered_view_at_the_size_of_the_step(tiny_scene):
    views = read_scene(tiny_scene).downscaled(1, 2).split("train")
    settings = ViewSettings(order=ShuffleOrder(), resolution={"points": [[0, 2], [20, 1]], "between": "steps"})
    sampler, pool = Sampler(views, settings, seed=5), ViewPool(views, 5)
    for step in range(1, 40):
        view, sample = ShuffleOrder().view_at(pool, step), sampler.at(step)
        divisor = 2 if step < 20 else 1
        assert (sample.view.name, sample.view.downscale) == (view.name, view.downscale * divisor)
        assert sample.view.camera.width == 40 / (view.downscale * divisor)
        assert sample.step == step
    assert sampler.at(25).view in views, "at full size it is the scene's own"


def test_transforms_come_with_every_sample(tiny_scene):
    transforms = [Blur(sigma=2.0), Blur(sigma=0.5)]
    sampler = Sampler(read_scene(tiny_scene).split("train"), ViewSettings(transforms=transforms), seed=0)
    assert list(sampler.at(7).transforms) == transforms


@pytest.mark.parametrize("setting", [RESOLUTION, BLUR, FRACTIONS], ids=["resolution", "blur", "fractions"])
def test_run_with_changing_views_is_the_same_after_a_stop(tiny_scene, tmp_path, setting):
    few = "optimize.steps=24"
    whole = train(tiny_scene, tmp_path / "whole", few, setting)
    assert load(str(whole.out / "pipeline.yaml")).resolved_settings() == without_auto(whole.pipeline)
    checked = load("smoke", [f"scene.path='{tiny_scene}'", few, setting])
    out = tmp_path / "stopped"
    for stop_at in (10, 20):
        run = opening.open_run(checked, out, None)

        def stop(progress: Progress, run=run, stop_at=stop_at) -> None:
            run.interrupted = progress.step >= stop_at

        with pytest.raises(Interrupted):
            runner.execute(checked, run, "resume", stop)
    train(tiny_scene, out, few, setting, resume=True)
    assert digest(out) == digest(tmp_path / "whole")


def test_view_settings_change_training_except_defaults(tiny_scene, few_steps, tmp_path):
    """The default settings, written out, give the bits of a file without them."""
    same = "{order: {type: uniform}, resolution: 1.0, transforms: [{type: blur, sigma: 0.0}]}"
    train(tiny_scene, tmp_path / "same", *FEW, f"optimize.views={same}")
    assert digest(tmp_path / "same") == digest(few_steps)
    actual = {digest(few_steps)}
    for name, setting in (("resolution", RESOLUTION), ("blur", BLUR), ("order", "optimize.views.order=shuffle")):
        run = train(tiny_scene, tmp_path / name, *FEW, setting)
        actual.add(digest(tmp_path / name))
        assert run.metrics["test"].keys() == {"1"}, "what is measured keeps its size"
    assert len(actual) == 4


def masked_everywhere(source: Path, out: Path, name: str) -> Path:
    """The scene with alpha as masks, one of which leaves out every pixel."""
    shutil.copytree(source, out)
    for path in out.rglob("*.png"):
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:, :, :3]
        alpha = np.full(pixels.shape[:2], 0 if path.stem == name else 255, np.uint8)
        assert cv2.imwrite(str(path), np.dstack([pixels, alpha]))
    return out


def test_fully_masked_photograph_is_refused_before_training(tiny_scene, tmp_path):
    scene = masked_everywhere(tiny_scene, tmp_path / "scene", "r_003")
    with pytest.raises(DataError, match=r"masks exclude every pixel of 1 photo: .*003") as error:
        train(scene, tmp_path / "run", "scene.alpha=mask")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists(), "before training"
