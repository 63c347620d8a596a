"""Training step by step: the bits of the command, resume, and custom losses."""

import gc
import inspect
import json
import textwrap
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.api.renderer import Renderer
from clsplat.conformance.scenes import random_case
from clsplat.core.errors import ConfigError, DataError
from clsplat.density.statistics import SplatStats
from clsplat.losses.base import Comparison
from clsplat.losses.host import HostLoss
from clsplat.losses.image import L1, Dssim
from clsplat.photos.photographs import Photographs
from clsplat.render.camera import upload_camera
from clsplat.render.workspace import Workspace
from clsplat.scene.images import read_image
from clsplat.training import trainer as steps
from tests.support.models import equal

pytestmark = pytest.mark.slow

MIP = {
    "model.world_filter.type": "smoothing",
    "model.screen_filter": {"type": "mip"},
    "optimize.raise_sh.every": 5,
    "optimize.densify.start": 5,
}


@pytest.mark.parametrize("name", ["smoke", "splat_7k"])
def test_trainer_gives_the_bits_of_the_command(name, tiny_scene, tmp_path):
    settings = {"optimize.steps": 40, "densify.start": 10} if name != "smoke" else {}
    out = clsplat.run(name, tiny_scene, tmp_path / "run", set=settings)
    trainer = clsplat.Trainer(clsplat.read_scene(tiny_scene), name, set=settings)
    last = trainer.run()
    trainer.model.save(tmp_path / "model.ply")
    assert (tmp_path / "model.ply").read_bytes() == (out / "point_cloud.ply").read_bytes()
    metrics = json.loads((out / "metrics.json").read_text())
    assert trainer.evaluate("test") == metrics["test"]["1"]
    assert (last.step, last.gaussians) == (metrics["steps"], metrics["gaussians"])
    assert repr(last) == f"Report(step {last.step}, {last.gaussians:,} Gaussians)"
    assert repr(trainer) == f"Trainer({name} on tiny, step {last.step})"


def in_memory(scene: clsplat.Scene) -> clsplat.Scene:
    """The scene from arrays, without its files."""
    views = [
        clsplat.View(view.name, view.camera, view.world_to_camera, image=read_image(view.image_path))
        for view in scene.views
    ]
    test = [view.name for view in scene.split("test")]
    return clsplat.Scene.from_views(views, scene.points, test, scene.background)


def test_scene_from_arrays_trains_to_the_bits_of_its_files(tiny_scene, tmp_path):
    scene = clsplat.read_scene(tiny_scene)
    arrays = in_memory(scene)
    np.testing.assert_array_equal(arrays.views[0].photograph(), scene.views[0].photograph())
    expected = clsplat.Trainer(scene, "smoke")
    expected.run()
    first = clsplat.Trainer(arrays, "smoke", out=tmp_path / "run")
    first.run(7)
    first.checkpoint()
    first.close()
    second = clsplat.Trainer(in_memory(scene), "smoke", out=tmp_path / "run", start="resume")
    second.run()
    assert equal(second.model, expected.model)
    other = replace(arrays.views[0], image=255 - arrays.views[0].image)
    changed = replace(arrays, views=(other, *arrays.views[1:]))
    with pytest.raises(ConfigError, match="the photo of 1 view"):
        clsplat.Trainer(changed, "smoke", out=tmp_path / "run", start="resume")


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 5)), "shape"),
        (np.full((4, 5, 3), 1.5), "values"),
        (np.full((4, 5, 3), np.nan), "values"),
        (np.zeros((4, 5, 3), int), "values"),
    ],
)
def test_array_that_is_not_an_image_is_refused(image, message):
    with pytest.raises(DataError, match=rf"^the image of 'a' has {message}"):
        clsplat.View("a", clsplat.Camera(5, 4, 5, 5, 2.5, 2), np.eye(4)[:3], image=image)


def test_float_image_keeps_the_levels_of_8_bits():
    levels = np.arange(240, dtype=np.uint8).reshape(8, 10, 3)
    view = clsplat.View("a", clsplat.Camera(10, 8, 5, 5, 5, 4), np.eye(4)[:3], image=levels / np.float32(255))
    np.testing.assert_array_equal(view.photograph(), levels / np.float32(255))


def test_unknown_test_view_is_refused():
    view = clsplat.View("a", clsplat.Camera(5, 4, 5, 5, 2.5, 2), np.eye(4)[:3])
    with pytest.raises(DataError, match="no view is named 'b'"):
        clsplat.Scene.from_views([view], test=["b"])


def test_threads_may_share_a_trainer(tiny_scene, tmp_path):
    expected = clsplat.Trainer(tiny_scene, "smoke")
    expected.run(12)
    trainer = clsplat.Trainer(tiny_scene, "smoke")
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(lambda _: trainer.step(), range(12)))
    assert equal(trainer.model, expected.model)


def test_world_filtered_model_matches_the_raw_file(tiny_scene, tmp_path):
    out = clsplat.run("smoke", tiny_scene, tmp_path / "run", set=MIP)
    trainer = clsplat.Trainer(tiny_scene, "smoke", set=MIP)
    trainer.run()
    model, raw = trainer.model, clsplat.load(out / "point_cloud_raw.ply")
    assert model.rendering == raw.rendering
    np.testing.assert_allclose(model.filter_variance, raw.filter_variance, rtol=3e-7)  # the file has its square root
    model.save(tmp_path / "model.ply")
    assert (tmp_path / "model.ply").read_bytes() == (out / "point_cloud_raw.ply").read_bytes()
    model.baked().save(tmp_path / "baked.ply")
    assert (tmp_path / "baked.ply").read_bytes() == (out / "point_cloud.ply").read_bytes()


def test_steps_are_counted_and_end(tiny_scene):
    trainer = clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 5})
    first = trainer.step()
    assert (first.step, first.loss > 0) == (1, True)
    assert [report.step for report in trainer.steps(2)] == [2, 3]
    assert trainer.run().step == 5
    assert trainer.run() is None
    with pytest.raises(StopIteration):
        trainer.step()
    assert trainer.evaluate("train")["views"] == 8
    with pytest.raises(ValueError, match="no split 'tset'"):
        trainer.evaluate("tset")


def test_trainer_resumes_its_checkpoint_or_the_commands(tiny_scene, tmp_path):
    whole = clsplat.Trainer(tiny_scene, "smoke")
    whole.run()
    part = clsplat.Trainer(tiny_scene, "smoke", out=tmp_path / "a")
    part.run(20)  # a density edit is due
    assert part.checkpoint() == tmp_path / "a" / "checkpoints" / "step_000020.npz"
    part.close()
    again = clsplat.Trainer(tiny_scene, "smoke", out=tmp_path / "a", start="resume")
    assert repr(again).endswith("step 20)")
    again.run()
    assert equal(again.model, whole.model)
    for file in (tmp_path / "a" / "checkpoints").iterdir():
        if file.name > "step_000040.npz":
            file.unlink()
    clsplat.resume(tmp_path / "a")
    assert equal(clsplat.load(tmp_path / "a"), whole.model)
    for file in (tmp_path / "a" / "checkpoints").iterdir():
        if file.name > "step_000040.npz":
            file.unlink()
    after_command = clsplat.Trainer(tiny_scene, "smoke", out=tmp_path / "a", start="resume")
    after_command.run()
    assert equal(after_command.model, whole.model)


def test_temporary_folder_is_removed_with_its_trainer(tiny_scene):
    trainer = clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 3})
    trainer.run(2)
    folder = trainer.out
    assert trainer.checkpoint().parent.parent == folder
    del trainer
    gc.collect()
    assert not folder.exists()


def test_custom_loss_matches_the_built_in_gradient(device, rng):
    workspace, camera = Workspace(device), upload_camera(device, random_case(rng, 1, 37, 21).view)
    planes = np.zeros((3, camera.rows, camera.stride), np.float32)
    inside = np.s_[:, : camera.height, : camera.width]
    images = [planes.copy() for _ in range(2)]
    for image in images:
        image[inside] = rng.uniform(size=(3, camera.height, camera.width))

    def l1(image, photograph):
        difference = image - photograph
        return np.abs(difference).mean(), np.sign(difference) / difference.size

    results = []
    for loss in (L1(weight=0.7), HostLoss(l1, 0.7)):
        gradient = device.zeros(planes.shape)
        comparison = Comparison(workspace, camera, *map(device.upload, images), gradient)
        before = Dssim(weight=0.3).add(comparison)  # a loss adds to what is there
        value = loss.add(comparison).value()
        results.append((value, gradient.get()[inside], before.value()))
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-6)
    np.testing.assert_allclose(results[0][1], results[1][1], atol=1e-6 * np.abs(results[0][1]).max())


def test_added_loss_acts_from_the_next_step(tiny_scene):
    seen = []

    def darkness(image, photograph):
        seen.append((image.shape, image.dtype, photograph.shape, photograph.max() <= 1))
        return image.mean(), np.full_like(image, 1 / image.size)

    plain, dark = (clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 12}) for _ in range(2))
    plain.run(2)
    dark.run(2)
    assert equal(plain.model, dark.model)
    dark.add_loss(darkness, weight=[[0, 5.0], [100, 5.0]])
    report = dark.run()
    assert seen == [((40, 40, 3), np.float32, (40, 40, 3), True)] * 10
    assert "darkness" in [loss.name for loss in report.view.losses]
    plain.run()
    images = [Renderer(item.model).render(item.scene.views[0]).image.mean() for item in (plain, dark)]
    assert images[1] < images[0] - 0.02


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (("smokee",), ConfigError, "no pipeline named 'smokee'"),
        (("smoke", {"optimize.step": 3}), ConfigError, "did you mean"),
        (("smoke", {"optimize.steps": np.zeros(2)}), ConfigError, "set: Object of type ndarray"),
        (("smoke", {}, None, "resume"), ConfigError, "start='resume': expected a run folder as `out`"),
    ],
)
def test_untrainable_input_is_refused_in_one_sentence(tiny_scene, arguments, error, message):
    pipeline, settings, out, start = (*arguments, *({}, None, "new")[len(arguments) - 1 :])
    with pytest.raises(error) as raised:
        clsplat.Trainer(tiny_scene, pipeline, set=settings, out=out, start=start)
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_recipes_that_prepare_scenes_are_refused(tiny_scene):
    with pytest.raises(ConfigError, match="has `prepare` steps; use clsplat"):
        clsplat.Trainer(tiny_scene / "train", "photos")


def test_missing_or_occupied_folders_are_refused(tiny_scene, tmp_path):
    with pytest.raises(DataError, match="nowhere"):
        clsplat.Trainer(tmp_path / "nowhere", "smoke")
    clsplat.Trainer(tiny_scene, "smoke", out=tmp_path / "run")
    with pytest.raises(ConfigError, match="already has a run"):
        clsplat.Trainer(tiny_scene, "smoke", out=tmp_path / "run")
    no_training = tmp_path / "no.yaml"
    no_training.write_text("name: no\nstages: [init, export]\n")
    with pytest.raises(ConfigError, match="has no 'optimize' stage; add one"):
        clsplat.Trainer(tiny_scene, no_training)


def test_documented_training_loop_runs(tiny_scene, device, capsys):
    lines = inspect.getdoc(steps.StepTrainer).split("clsplat.load`:\n\n")[1].split("\n\nBetween")[0]
    from clsplat.render.rasterizer import Rasterizer
    from clsplat.training.adam import Adam, Rates

    scene = clsplat.read_scene(tiny_scene)
    scene = replace(scene, train=scene.train[:1] * 8)  # the same view in each step
    names = {"Adam": Adam, "Rates": Rates, "Rasterizer": Rasterizer, "SplatStats": SplatStats, "L1": L1, "Dssim": Dssim}
    names |= {"Photographs": Photographs, "StepTrainer": steps.StepTrainer, "device": device, "scene": scene}
    names["model"] = clsplat.Trainer(scene, "smoke").model
    capsys.readouterr()
    exec(textwrap.dedent(lines), names)
    losses = [float(line) for line in capsys.readouterr().out.splitlines()]
    assert len(losses) == 8
    assert losses[-1] < losses[0]


def test_output_folder_is_a_run(tiny_scene, tmp_path):
    settings = {"optimize.steps": 10}
    trainer = clsplat.Trainer(tiny_scene, "smoke", set=settings, out=tmp_path / "run")
    trainer.run(9)
    trainer.checkpoint()
    assert clsplat.status(tmp_path / "run")["state"] in ("starting", "running")
    trainer.step()
    assert trainer.checkpoint().is_file()
    assert (clsplat.status(tmp_path / "run")["state"], clsplat.status(tmp_path / "run")["step"]) == ("done", 10)
    again = clsplat.Trainer(tiny_scene, "smoke", set=settings, out=tmp_path / "run", start="resume")
    assert clsplat.status(tmp_path / "run")["state"] == "done"
    assert again.run() is None
    assert Path(clsplat.check(tmp_path / "run" / "pipeline.yaml")["path"]).name == "pipeline.yaml"
