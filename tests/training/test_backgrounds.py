"""Random backgrounds for each training step."""

import numpy as np
import pytest

from clsplat.core.errors import ConfigError
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import choose_device
from clsplat.photos.photographs import Photographs
from clsplat.pipeline.loading import load
from clsplat.render.workspace import Workspace
from clsplat.runs.describe import describe
from clsplat.runs.state import RunState
from clsplat.scene.detect import read_scene
from clsplat.scene.view import load_image
from clsplat.training.modules.random_background import random_color
from tests.support.runs import digest, train

RANDOM = "optimize.modules.random_background={}"


def test_colors_depend_only_on_seed_and_step():
    drawn = [tuple(random_color(seed, step)) for seed, step in ((0, 1), (0, 2), (1, 1), (0, 1))]
    assert len(set(drawn)) == 3
    assert drawn[0] == drawn[3]


def test_transparent_pixels_get_the_drawn_color(tiny_scene):
    device, scene = Device(choose_device()), read_scene(tiny_scene)
    photographs, view = Photographs(device, "white"), scene.split("train")[0]
    behind = device.upload(random_color(0, 3))
    height, width = view.camera.height, view.camera.width

    def shown() -> np.ndarray:
        planes = photographs.get(view).planes(Workspace(device), backgrounds=(photographs.background, behind))
        return planes.colors.get()[:, :height, :width].transpose(1, 2, 0)

    on_white = load_image(view, (1.0, 1.0, 1.0)) / 255
    np.testing.assert_allclose(shown(), on_white, atol=1e-6)  # transparency is not kept unless it is asked for
    photographs.enable_transparency()
    expected = load_image(view, behind.get().astype(np.float64)) / 255
    assert np.abs(expected - on_white).max() > 0.3
    assert np.abs(shown() - expected).max() < 2.5 / 255


@pytest.mark.slow
def test_run_repeats_bit_for_bit(tiny_scene, tmp_path):
    steps = "optimize.steps=12", "init.count=60", "checkpoint.every=4", "checkpoint.keep=9"
    whole = digest(train(tiny_scene, tmp_path / "whole", *steps, RANDOM).out)
    assert digest(train(tiny_scene, tmp_path / "again", *steps, RANDOM).out) == whole
    assert digest(train(tiny_scene, tmp_path / "scene", *steps).out) != whole
    actual = train(
        tiny_scene, tmp_path / "transparent", *steps, "optimize.modules.random_background.when=transparent"
    ).out
    assert digest(actual) == whole
    opaque = [
        digest(
            train(
                tiny_scene,
                tmp_path / f"opaque {name}",
                *steps,
                "scene.alpha=mask",
                f"optimize.modules.random_background={value}",
            ).out
        )
        for name, value in (("transparent", "{when: transparent}"), ("scene", "null"))
    ]
    assert opaque[0] == opaque[1]


@pytest.mark.slow
def test_model_with_a_sky_is_refused(tiny_scene, tmp_path):
    with pytest.raises(ConfigError, match="cannot be combined with sky"):
        train(tiny_scene, tmp_path / "run", RANDOM, "model.background=envmap", "optimize.steps=2")
    pipeline = load(
        "smoke",
        [
            f"scene.path='{tiny_scene}'",
            "optimize.modules.random_background.when=transparent",
            "model.background=envmap",
        ],
    )
    with pytest.raises(ConfigError, match="cannot be combined with sky"):
        describe(pipeline, RunState.read(tmp_path / "other"), None, "new")
