"""Distractors, the private Gaussians of each photograph: their effect on a step, and their absence from outputs."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance.scenes import random_case
from clsplat.core.errors import DataError
from clsplat.formats.table import read as read_model
from clsplat.gaussians.gaussians import DeviceModel, Gaussians
from clsplat.photos.photographs import Photograph
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer
from clsplat.training import checkpoint
from clsplat.training.archive import split
from clsplat.training.modules.base import TrainingStep
from clsplat.training.modules.distractors import NEAR_FRACTION, Distractors, DistractorsState, initial_tables
from tests.support.runs import FEW, ONE_CORE, digest, train

ON = (*FEW, "optimize.modules.distractors={count: 30, start: 4}")
SCALE = 1e-2  # scene units of their first depth, where they are put into a scene


class Pair:
    """Two photographs of a random scene, each with Gaussians of its own."""

    def __init__(self, device, rng, cover=0.0) -> None:
        self.case, self.device, self.rng = random_case(rng, 40, 50, 36, degree=0), device, rng
        self.views = [self.case.view, replace(self.case.view, name="other")]
        pixels = rng.integers(0, 256, (36, 50, 3), np.uint8)
        self.tables = initial_tables(20, [(view, pixels) for view in self.views])
        self.tables["logit_opacity"] = rng.normal(0, 1, (40, 1)).astype(np.float32)
        self.tables["sh_base"] = rng.normal(0, 0.7, (40, 3)).astype(np.float32)
        self.tables["log_scales"] += rng.normal(0, 0.3, (40, 3)).astype(np.float32)
        self.tables["means"] *= rng.uniform(0.8, 1.5, (40, 1)).astype(np.float32)  # depths apart: an order of their own
        self.own = DistractorsState(Distractors(cover=cover), self.views, Rasterizer(device, "radix"))
        self.own.load({}, self.tables)
        self.model, self.rasterizer = self.case.model(device), Rasterizer(device, "radix")
        self.black = device.zeros(3)

    def camera(self, number):
        return replace(self.case.device_camera(self.device), view_index=number)

    def layer(self, number, at=1):
        """The step with what the photograph has in front of it."""
        camera = self.camera(number)
        pixels = self.device.upload(np.zeros((3, 36, 50), np.uint8))
        while True:
            step = TrainingStep(at, self.rasterizer, Photograph(camera, pixels), self.model, self.black, (), ())
            step.frame = self.rasterizer.forward(self.model, camera, self.black)
            step.image = step.frame.image
            self.own.after_render(step)
            if step.is_complete:
                return step

    def joined(self) -> DeviceModel:
        """One model of the scene's Gaussians, and those of the first photograph just before its camera."""
        pose = self.case.view.world_to_camera
        parameters = {name: table.copy() for name, table in self.case.parameters.items()}
        own = {name: self.tables[name][:20] for name in ("means", "quats", "log_scales", "logit_opacity", "sh_base")}
        own["means"] = (SCALE * own["means"] - pose[:, 3]) @ pose[:, :3]
        trace = np.sqrt(1 + np.trace(pose[:, :3])) / 2  # of the camera's axes, as a quaternion
        across = [pose[1, 2] - pose[2, 1], pose[2, 0] - pose[0, 2], pose[0, 1] - pose[1, 0]]
        own["quats"] = np.tile([trace, *(np.array(across) / (4 * trace))], (20, 1))
        own["log_scales"] = own["log_scales"] + np.log(SCALE)
        own["sh_rest"] = np.zeros((20, 45))
        all_rows = {name: np.concatenate([own[name], table]).astype(np.float32) for name, table in parameters.items()}
        return replace(self.model, gaussians=Gaussians(self.device, all_rows), near=SCALE * NEAR_FRACTION)


@pytest.mark.parametrize("cover", [0.0, 3.0])
def test_layer_equals_its_gaussians_in_front_of_the_scene(device, rng, cover):
    """The image and the derivatives of both are those of one model with all of them."""
    pair = Pair(device, rng, cover)
    step = pair.layer(0)
    joined = pair.joined()
    expected = Rasterizer(device, "radix").forward(joined, pair.camera(None), pair.black)
    np.testing.assert_allclose(step.image.get(), expected.image.get(), atol=2e-5)
    gradient = rng.normal(size=step.image.shape).astype(np.float32)
    gradient[:, 36:], gradient[:, :, 50:] = 0, 0
    by_both, whole = device.upload(gradient), Rasterizer(device, "radix")
    expected = whole.forward(joined, pair.camera(None), pair.black)
    sums = whole.pixel_sums(joined, expected, by_both).get()
    means = {number: adam.gaussians.get("means") for number, adam in enumerate(pair.own.adams)}
    step.gradient = by_both
    pair.own.backward(step)
    of_scene = pair.rasterizer.pixel_sums(pair.model, step.frame, by_both).get()
    expected_scene, largest = sums[:PIXEL_SUMS, 20:60], np.abs(sums[:PIXEL_SUMS, 20:60]).max(axis=1, keepdims=True)
    assert (np.abs(of_scene[:PIXEL_SUMS, :40] - expected_scene) / largest).max() < 2e-3
    if cover == 0:
        of_layer = pair.own.rasterizer.workspace.array("pixel_sums", (PIXEL_SUMS, 64)).get()[:, :20]
        largest = np.abs(sums[:PIXEL_SUMS, :20]).max(axis=1, keepdims=True)
        assert (np.abs(of_layer - sums[:PIXEL_SUMS, :20]) / largest).max() < 2e-3
    pair.own.update(step)
    assert (pair.own.adams[0].gaussians.get("means") != means[0]).any()
    np.testing.assert_array_equal(pair.own.adams[1].gaussians.get("means"), means[1])


def test_distractors_appear_only_in_their_image(device, rng):
    pair = Pair(device, rng)
    images = [pair.layer(number).image.get() for number in (0, 1)]
    assert (images[0] != images[1]).any()
    pair.own.adams[1].gaussians.set("sh_base", np.zeros((20, 3), np.float32))
    assert (pair.layer(1).image.get() != images[1]).any()
    np.testing.assert_array_equal(pair.layer(0).image.get(), images[0])
    for step in (pair.layer(None), pair.layer(0, at=0)):  # another picture; before their start
        assert step.image is step.frame.image


def test_unhelpful_distractors_fade(device, rng):
    pair = Pair(device, rng, cover=1.0)
    before = pair.tables["logit_opacity"][:20]
    for _ in range(3):
        step = pair.layer(0)
        assert 0 < step.module_losses[0].value() < 1
        step.gradient = device.zeros(step.image.shape)
        pair.own.backward(step)
        pair.own.update(step)
    seen = pair.own.adams[0].gaussians.get("logit_opacity")
    assert (seen <= before).all()
    assert (seen < before).mean() > 0.8


@pytest.mark.slow
def test_distractors_change_no_bits_before_their_start(tiny_scene, tmp_path, few_steps):
    train(tiny_scene, tmp_path / "run", *FEW, "optimize.modules.distractors={count: 30, start: 12}")
    assert digest(tmp_path / "run") == digest(few_steps)


@pytest.mark.slow
def test_distractors_are_in_no_output_and_bits_repeat(tiny_scene, tmp_path, few_steps):
    run = train(tiny_scene, tmp_path / "run", *ON)
    expected = digest(tmp_path / "run")
    assert expected != digest(few_steps)
    assert "distractors" not in run.modules
    model = read_model(tmp_path / "run" / "point_cloud.ply")
    assert len(model.parameters["means"]) == run.model.gaussians.count == run.records.read("densify")[-1]["after"]
    command = [sys.executable, "-m", "clsplat", "run", "smoke", "--scene", str(tiny_scene)]
    command += [word for one in ON for word in ("--set", one)] + ["--out", str(tmp_path / "one")]
    subprocess.run(command, check=True, env={**os.environ, **ONE_CORE}, capture_output=True)
    assert digest(tmp_path / "one") == expected
    (one, two) = (checkpoint.load(checkpoint.list_files(tmp_path / name)[-1])[1] for name in ("one", "run"))
    own = split(one, "modules/distractors/")[0]
    assert own["means"].shape == (8 * 30, 3)
    assert own["updates"].sum() == 12 - 4
    for name, table in own.items():
        np.testing.assert_array_equal(table, split(two, "modules/distractors/")[0][name])


@pytest.mark.slow
@pytest.mark.parametrize(
    "others",
    [
        (
            "optimize.modules.transients={start: 4, outlier_ratio: 1, tail_ratio: 0}",
            "optimize.modules.exposure={}",
            "optimize.modules.camera_optimizer={start: 4}",
        ),
        ("model.background=envmap", "optimize.update=deferred", "model.screen_filter=box", "scene.levels=2"),
        ("scene.validation=auto", "optimize.keep=best", "optimize.refit=true", "rasterizer.harmonics=host"),
    ],
)
def test_distractors_combine_with_other_modules(tiny_scene, tmp_path, others):
    run = train(tiny_scene, tmp_path / "run", *ON, *others)
    assert "distractors" not in run.modules
    assert not run.find_nonfinite()
    tables = checkpoint.load(checkpoint.list_files(tmp_path / "run")[-1])[1]
    assert split(tables, "modules/distractors/")[0]["updates"].sum() == 12 - 4


def test_foreign_distractor_tables_are_refused(device, rng):
    tables = Pair(device, rng).own.tables()
    Distractors.check_saved({}, tables)
    damaged = [
        ({"means": tables["means"][:-1]}, "the same number of rows for every photo"),
        ({"updates": tables["updates"][:0]}, "the same number of rows for every photo"),
        ({"sh_base": tables["sh_base"][:, :2]}, "the same number of rows for every photo"),
        ({"quats": np.full_like(tables["quats"], np.nan)}, "quats of its Distractors has values that are not finite"),
        ({"sh_rest": tables["means"]}, "the same number of rows for every photo"),
    ]
    for change, message in damaged:
        with pytest.raises(DataError, match=message):
            Distractors.check_saved({}, {**tables, **change})
