"""Whole runs with a sky, a learned environment map."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import clsplat
from clsplat.api.commands import evaluate
from clsplat.core.errors import DataError
from clsplat.core.reading import sha256
from clsplat.gaussians.conversion import convert, with_sky_splats
from clsplat.gaussians.sky import Sky, read_sky_file, sample_texels, texel_directions, write_sky_file
from clsplat.metrics.images import psnr
from clsplat.photos.sky_detection import SkyEvidence, build_sky_map, detect_sky
from clsplat.pipeline.loading import load, without_auto
from clsplat.render.backdrops import Auto
from clsplat.runs.state import RunState
from clsplat.runs.status import summarize_run
from clsplat.scene.camera import Camera
from clsplat.scene.colmap_writer import write_model
from clsplat.scene.images import write_image
from clsplat.scene.view import View
from clsplat.sweeps.experiment import run_pipeline
from clsplat.training import checkpoint
from clsplat.training.archive import split
from clsplat.training.modules.sky import SkyModule
from tests.support.outdoor_scene import Yard, painted
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow
CAMERA, UP = Camera(64, 48, 60.0, 60.0, 32.0, 24.0), np.array([0.0, -1.0, 0.0])
SKY = (*FEW, "model.background={type: envmap, side: 16}")
LONGER = ("optimize.steps=300", "reset_opacity.every=1000", "optimize.evaluate.every=1000", "scene.holdout=4")


@pytest.fixture(scope="module")
def with_sky(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of twelve steps with a sky; nothing is changed in it."""
    out = tmp_path_factory.mktemp("runs") / "sky"
    train(tiny_scene, out, *SKY)
    return out


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> tuple[Yard, Path]:
    result = Yard(np.random.default_rng(3))
    return result, result.write(tmp_path_factory.mktemp("yard") / "scene")


@pytest.fixture(scope="module")
def sky_run(yard, tmp_path_factory) -> Path:
    """A run that detects the sky automatically."""
    out = tmp_path_factory.mktemp("runs") / "yard"
    pipeline = load("smoke", [f"scene.path='{yard[1]}'", *LONGER, "model.background=auto"])
    run_pipeline(pipeline, RunState.read(out), None, "new")
    assert RunState.read(out).is_complete(pipeline), "the same command finds it up to date"
    return out


# ---- the oracle


def test_painted_sky_is_recovered(yard, sky_run):
    """From places that no photograph was taken from, where no Gaussian covers it.

    The sky is infinitely far: there is no distance that Gaussians could be nearer than. Alpha finds those before it at
    any distance, and each as much as it shows.
    """
    capture, model = yard[0], clsplat.load(sky_run)
    renderer = clsplat.Renderer(model)
    view = capture.views[4]  # held out
    picture, above = renderer.render(view), capture.rays(view)[..., 1] < -0.05
    assert above.mean() > 0.4
    rendered, truth = (np.rint(255 * np.clip(image, 0, 1)) for image in (picture.image, painted(capture.rays(view))))
    error = np.mean((rendered[above] - truth[above]) ** 2)
    assert 10 * np.log10(255**2 / error) > 35
    assert picture.alpha[above].mean() < 0.02
    without = evaluate_without(sky_run, model)
    assert evaluate(sky_run)["test"]["1"]["psnr"] > without + 3


def evaluate_without(out: Path, model) -> float:
    """PSNR of test views on black."""
    renderer = clsplat.Renderer(model)
    settings = load(str(out / "pipeline.yaml")).settings.scene
    views = settings.read(settings.folder)[0].split("test")
    actual = [np.rint(255 * np.clip(renderer.render(view, 0.0).image, 0, 1)).astype(np.uint8) for view in views]
    photographs = [np.rint(255 * view.photograph()).astype(np.uint8) for view in views]
    return float(np.mean([psnr(a, b) for a, b in zip(actual, photographs, strict=True)]))


@pytest.mark.parametrize(
    ("pitch", "rows", "share"),
    [(0, 9, 0), (0, 8, 1), (45, 12, 1), (-45, 6, 0), (45, 0, 0)],
)
def test_sky_ends_at_the_horizon(pitch, rows, share):
    """Level, looking up at something narrow, and down at something on white; upper rows that are bright, of 12."""
    mask = np.repeat(np.arange(12)[:, None] < rows, 16, axis=1)
    down = np.sin(np.radians(-pitch))
    view = View.looking_at(np.zeros(3), np.array([0, down, np.cos(np.radians(pitch))]), UP, CAMERA)
    assert SkyEvidence(view, np.zeros((12, 16, 3), np.uint8), mask, np.ones_like(mask), UP).sky_fraction == share


def test_decision_is_recorded_with_its_reason(sky_run):
    actual = load(str(sky_run / "pipeline.yaml")).settings.model.background
    assert isinstance(actual, Auto)
    assert actual.chosen == "on"
    assert actual.reason.startswith("9 of 9 photos show bright or blue regions above the horizon, without points")
    assert "in 15% or more" in actual.reason
    assert f"model.background: on, since {actual.reason}" in (sky_run / "log.txt").read_text()


def test_key_changes_no_bits_without_visible_sky(tiny_scene, tmp_path, few_steps, rng):
    pipeline = load("smoke", [f"scene.path='{tiny_scene}'", *FEW, "model.background=auto"])
    run_pipeline(pipeline, RunState.read(tmp_path / "run"), None, "new")
    actual = load(str(tmp_path / "run" / "pipeline.yaml")).settings.model.background
    assert (actual.chosen, actual.reason) == ("off", "the photos have transparency")
    assert digest(tmp_path / "run") == digest(few_steps)
    assert not (tmp_path / "run" / "point_cloud_sky.json").exists()
    folder = Yard(rng, clear=False).write(tmp_path / "wall")
    run = train(folder, tmp_path / "walled", *FEW, "model.background=auto")
    assert "sky" not in run.modules


@pytest.mark.parametrize(
    ("alpha", "masked", "size", "chosen", "why"),
    [
        (255, None, 1, "on", "9 of 9 photos show"),
        (254, None, 1, "off", "the photos have transparency"),
        (254, "below", 1, "off", "the photos have transparency"),
        (255, "sky", 1, "off", "0 of 9 photos show"),
        (255, "edge", 1, "on", "9 of 9 photos show"),
        (255, "edge", 8, "on", "9 of 9 photos show"),
    ],
)
def test_counted_opaque_pixels_can_show_sky(tmp_path, rng, alpha, masked, size, chosen, why):
    """alpha: of one pixel of photographs but one, opaque elsewhere; masked: what is left out, an edge that is dark."""
    yard, masks = Yard(rng), tmp_path / "masks"
    folder = yard.write(tmp_path / "scene")
    for view in yard.views:
        pixels, counted = yard.photograph(view), np.ones((48, 64), bool)
        if masked == "edge":
            counted[:8], pixels[:8] = False, 40
        elif masked:
            counted = (yard.rays(view)[..., 1] > 0) == (masked == "sky")
            counted[20, 30] = True
        layer = np.full((48, 64, 1), 255, np.uint8)
        layer[20, 30] = 255 if view.name == "1.png" else alpha
        file = np.concatenate([pixels[..., ::-1], layer], axis=2).repeat(size, axis=0).repeat(size, axis=1)
        cv2.imwrite(str(folder / "images" / view.name), file)
        mask = (255 * counted.astype(np.uint8)).repeat(size, axis=0).repeat(size, axis=1)
        write_image(masks / view.name, np.repeat(mask[..., None], 3, axis=2))
    if size > 1:
        views = [replace(view, camera=view.camera.downscaled(1 / size)) for view in yard.views]
        write_model(folder / "sparse" / "0", views, yard.points, None)
    more = [f"scene.masks={masks}"] if masked else []
    settings = [f"scene.path='{folder}'", *FEW, "optimize.steps=1", "scene.holdout=4", "model.background=auto", *more]
    run_pipeline(load("smoke", settings), RunState.read(tmp_path / "run"), None, "new")
    actual = load(str(tmp_path / "run" / "pipeline.yaml")).settings.model.background
    assert (actual.chosen, actual.reason.startswith(why)) == (chosen, True), actual.reason


def test_decision_is_not_written_as_a_setting():
    asked = load("smoke", ["model.background=auto"]).resolved_settings()
    chosen = load("smoke", ["model.background={type: auto, chosen: on, reason: it is blue}"]).resolved_settings()
    assert asked != chosen
    assert without_auto(asked) == without_auto(chosen)


def test_directions_without_visible_sky_are_left_to_gaussians(yard):
    """The sky starts with the colors of the photographs."""
    _, folder = yard
    scene = clsplat.read_scene(folder)
    photographs = [(view, np.rint(255 * view.photograph()).astype(np.uint8), None) for view in scene.views]
    texels, free = build_sky_map(list(detect_sky(scene, photographs)), 32)
    directions = texel_directions(32)
    looked = np.abs(directions[:, 1]) < 0.4
    assert not free[looked & (directions[:, 1] > 0.35)].any()
    assert np.ptp(texels[~free], axis=0).max() == 0, "one color, which stays"
    sky = looked & (directions[:, 1] < -0.2)
    assert free[sky].all()
    np.testing.assert_allclose(texels[sky], painted(directions[sky]), atol=0.1)


# ---- bits


def test_best_model_has_the_sky_of_its_step(tiny_scene, tmp_path):
    wild = "model.background={type: envmap, side: 16, rate: {points: [[0, 0.005], [9, 5.0]], between: steps}}"
    kept = (
        "scene.validation=2",
        "optimize.keep=best",
        "optimize.evaluate.split=validation",
        "optimize.evaluate.every=4",
    )
    run = train(tiny_scene, tmp_path / "run", *FEW, *kept, wild)
    assert run.best.measured.step == 8, "the last steps ruin it"
    _, then = checkpoint.load(tmp_path / "run" / "checkpoints" / "step_000008.npz")
    np.testing.assert_array_equal(
        read_sky_file(tmp_path / "run" / "point_cloud_without_sky.ply").texels, then["modules/sky/texels"]
    )


# ---- where it goes


def test_run_folder_is_rendered_and_measured_with_its_sky(sky_run):
    measured = json.loads((sky_run / "metrics.json").read_text())["test"]["1"]
    assert evaluate(sky_run)["test"]["1"]["psnr"] == measured["psnr"]
    assert "point_cloud_sky.json" in json.loads((sky_run / "checksums.json").read_text())


def test_model_file_without_its_sky_is_reported(sky_run, tmp_path, caplog):
    shutil.copy(sky_run / "point_cloud_without_sky.ply", tmp_path / "alone.ply")
    assert clsplat.load(tmp_path / "alone.ply").sky is None
    assert "was trained with a sky; put alone_sky.json next to it" in caplog.text
    model = clsplat.load(sky_run)
    model.save(tmp_path / "moved.ply")
    np.testing.assert_array_equal(clsplat.load(tmp_path / "moved.ply").sky.texels, model.sky.texels)


def test_other_model_of_the_same_name_ignores_the_sky(sky_run, tmp_path, caplog):
    """Not by a file that another program wrote there, nor by our own of a model without one."""
    model = clsplat.load(sky_run)
    model.save(tmp_path / "scene.ply")
    model.save(tmp_path / "scene.spz")
    assert all(clsplat.load(tmp_path / name).sky for name in ("scene.ply", "scene.spz")), "they share it"
    (tmp_path / "elsewhere").mkdir()
    model[::2].save(tmp_path / "elsewhere" / "other.spz")
    shutil.copy(tmp_path / "elsewhere" / "other.spz", tmp_path / "scene.spz")
    assert clsplat.load(tmp_path / "scene.spz").sky is None
    assert "the sky does not belong to scene.spz" in caplog.text
    replace(model, sky=None).save(tmp_path / "scene.ply")
    assert clsplat.load(tmp_path / "scene.ply").sky is None, "its bytes are those of the model with the sky"


def test_exported_splats_show_the_sky_without_its_file(yard, sky_run, tmp_path, caplog):
    """At training views as the map, in the run folder and elsewhere; all counts have both."""
    moved = tmp_path / "moved.ply"
    shutil.copy(sky_run / "point_cloud.ply", moved)
    trained = clsplat.load(sky_run)
    for file in (sky_run / "point_cloud.ply", moved):
        model = clsplat.load(file)
        assert (len(model), model.sky) == (len(trained) + 10_000, None)
        np.testing.assert_array_equal(model.scene_means, trained.means)
    assert not caplog.text
    scores = []
    for view in yard[0].views:
        splats, pixels = (clsplat.Renderer(item).render(view) for item in (model, trained))
        above = pixels.alpha < 0.05
        images = (np.clip(item.image[above], 0, 1) for item in (splats, pixels))
        scores.append(-10 * np.log10(np.mean(np.subtract(*images) ** 2)))
    assert np.mean(scores) > 36
    count = f"{len(trained):,} Gaussians and 10,000 of the sky"
    assert json.loads((sky_run / "metrics.json").read_text())["sky_gaussians"] == 10_000
    assert count in summarize_run(sky_run)[0]
    assert count in (sky_run / "report.html").read_text()
    convert([sky_run], tmp_path / "other.ply")
    assert len(clsplat.load(tmp_path / "other.ply")) == len(trained) + 10_000
    clsplat.convert(sky_run, tmp_path / "plain.ply", sky="none")
    plain = clsplat.load(tmp_path / "plain.ply")
    np.testing.assert_array_equal(plain.means, trained.means)
    assert plain.sky is None


def test_finished_run_exports_its_sky_again(sky_run, tmp_path):
    """As a file next to the model, and as Gaussians again, with equal bits and without training."""
    out = tmp_path / "run"
    shutil.copytree(sky_run, out)
    for sky in ("sidecar", "splats"):
        run_pipeline(load(str(out / "pipeline.yaml"), [f"export.sky={sky}"]), RunState.read(out), None, "resume")
        assert sorted(path.name for path in out.glob("*.ply")) == [
            "point_cloud.ply",
            *(["point_cloud_without_sky.ply"] if sky == "splats" else []),
        ]
        assert ("of the sky" in summarize_run(out)[0]) == (sky == "splats")
        np.testing.assert_array_equal(clsplat.load(out).sky.texels, clsplat.load(sky_run).sky.texels)
    for name in ("point_cloud.ply", "point_cloud_without_sky.ply", "point_cloud_sky.json"):
        assert sha256(out / name) == sha256(sky_run / name)


def test_sky_gaussians_match_its_colors_in_all_directions(rng, sky_run):
    model = clsplat.load(sky_run)
    baked = with_sky_splats(model, 500)
    added = baked[len(model) :]
    directions = added.means - np.median(model.means, axis=0)
    expected = np.clip(sample_texels(model.sky.texels, directions), 0, 1)
    np.testing.assert_allclose(added.colors, expected, atol=2e-3)
    assert with_sky_splats(baked) is baked


def test_sky_of_transparent_photographs_is_warned_of(tiny_scene, yard, tmp_path, caplog):
    transparent = "the photos have transparent pixels, so the sky would learn the color that clsplat puts behind them"
    few = ("optimize.steps=2", "init.count=60", "optimize.during=[]", "model.background={type: envmap, side: 8}")
    for scene, is_warned in ((tiny_scene, True), (yard[1], False)):
        caplog.clear()
        train(scene, tmp_path / f"run{is_warned}", *few)
        assert (transparent in caplog.text) == is_warned


def test_rotated_model_has_a_rotated_sky(rng, sky_run):
    model = clsplat.load(sky_run)
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    direction = np.array([0.3, -0.8, 0.2])
    result = sample_texels(model.transformed(rotation=turn).sky.texels, turn @ direction)
    np.testing.assert_allclose(result, sample_texels(model.sky.texels, direction), atol=0.02)
    assert model.transformed(scale=2.0).sky is model.sky


@pytest.mark.parametrize(
    "damage",
    [
        "[]",
        '{"side": 8}',
        '{"side": 8, "texels": [[1, 2]]}',
        '{"side": true, "texels": []}',
        '{"side": 8, "texels": 1}',
    ],
)
def test_damaged_sky_is_refused(tmp_path, damage):
    (tmp_path / "point_cloud_sky.json").write_text(damage)
    with pytest.raises(DataError, match=r"point_cloud_sky\.json: expected"):
        read_sky_file(tmp_path / "point_cloud.ply")


def test_damaged_sky_in_a_checkpoint_is_refused(with_sky):
    _, tables = checkpoint.archive.read(with_sky / "checkpoints" / "step_000012.npz")
    behind, _ = split(tables, "modules/sky/")
    SkyModule.check_saved({}, behind)
    for name, table in {"texels": behind["texels"][:-1], "biases": behind["moment1"]}.items():
        with pytest.raises(DataError, match=f"{name} of its sky"):
            SkyModule.check_saved({}, {**behind, name: table})
    with pytest.raises(DataError, match="not finite float32 numbers"):
        SkyModule.check_saved({}, {**behind, "moment2": behind["moment2"] * np.nan})
    with pytest.raises(DataError, match="its sky has tables texels, biases; expected texels, moment1"):
        SkyModule.check_saved({}, {"texels": behind["texels"], "biases": behind["biases"]})


def test_sky_file_keeps_every_bit(rng, tmp_path):
    sky = Sky(rng.normal(size=(64, 3)).astype(np.float32))
    (tmp_path / "model.ply").write_bytes(b"a model")
    write_sky_file(sky, tmp_path / "model.ply", sha256(tmp_path / "model.ply"))
    np.testing.assert_array_equal(read_sky_file(tmp_path / "model.ply").texels, sky.texels)
    assert replace(sky).side == 8
