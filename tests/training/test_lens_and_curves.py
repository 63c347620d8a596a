"""A plug-in training module, examples/lens_and_curves.py, against finite differences."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import clsplat
from clsplat.core.settings import variants
from clsplat.losses.image import L2
from clsplat.training.modules.base import TrainingModule
from tests.support.device_images import trainer_of
from tests.support.devices import on_devices
from tests.support.lines import other_lines, python_lines

EXAMPLE = Path(__file__).parents[2] / "examples" / "lens_and_curves.py"


class Case:
    """A trainer of a random scene, whose photograph was taken by a camera with vignetting and curves."""

    def __init__(self, device, rng) -> None:
        clsplat.load_plugin(EXAMPLE)
        kind = variants(TrainingModule)["lens_and_curves"]
        self.trainer, photograph = trainer_of(device, rng, [L2()])
        self.photograph = replace(photograph, camera=replace(photograph.camera, view_index=0))
        self.example, view = sys.modules[kind.__module__], SimpleNamespace(name="a")
        run = SimpleNamespace(
            scene=SimpleNamespace(split=lambda name: [view]), original=SimpleNamespace(cameras={"a": "b"})
        )
        self.state = kind(weight=0.1).create_state(run)
        self.keys, self.trainer.modules = self.example.TABLE.keys("b"), [self.state]
        self.state.scalars = dict(zip(self.keys, rng.normal(0, 0.2, 17), strict=True))

    def loss(self) -> float:
        return self.trainer.compare(self.photograph, 1).loss


@on_devices("seed", [(0,), (1,)])
@pytest.mark.usefixtures("without_plugins")
def test_the_gradients_of_a_step_are_those_of_its_losses(device, rng, seed):
    case, change = Case(device, rng), 2e-3
    view = case.trainer.differentiate(case.photograph, 1)
    _, row, of_weight, (wait,) = view.step.saved_value(case.state)
    actual, numeric = case.example.row_gradient(row, wait()) + of_weight, []
    gradients = case.trainer.rasterizer.gradients(case.trainer.model, view.frame, view.pixel_sums)["sh_base"].get()
    for key in case.keys:
        ends, value = [], case.state.scalars[key]
        for end in (value + change, value - change):
            case.state.scalars[key] = end
            ends.append(case.loss())
        case.state.scalars[key] = value
        numeric.append((ends[0] - ends[1]) / (2 * change))
    assert actual == pytest.approx(np.array(numeric), rel=0.02, abs=2e-4)
    gaussians, ends = case.trainer.model.gaussians, []
    colors, direction = gaussians.get("sh_base"), rng.normal(size=(gaussians.count, 3)).astype(np.float32)
    for sign in (1, -1):
        gaussians.set("sh_base", colors + np.float32(sign * change) * direction)
        ends.append(case.loss())
    along = float((gradients[:, : gaussians.count].T * direction).sum(dtype=np.float64))
    assert along == pytest.approx((ends[0] - ends[1]) / (2 * change), rel=0.02, abs=2e-5)


@on_devices("seed", [(0,)])
@pytest.mark.usefixtures("without_plugins")
def test_module_starts_at_identity_and_learns(device, rng, seed):
    case, images = Case(device, rng), []
    case.state.scalars = {}
    for modules in ([], [case.state]):
        case.trainer.modules = modules
        images.append(case.trainer.compare(case.photograph, 1).comparison.image.get())
    np.testing.assert_allclose(*images, atol=1e-6)
    case.trainer.step(case.photograph, 1)
    changed = [key for key in case.keys if case.state.scalars[key]]
    assert len(changed) == 15, "without a falloff its center has no gradient"


def test_example_is_short():
    text = EXAMPLE.read_text("utf-8")
    assert python_lines(text) + other_lines(EXAMPLE.with_suffix(".cl").read_text("utf-8")) <= 120
    assert "from clsplat." not in text.replace("from clsplat.plugin import", "")
