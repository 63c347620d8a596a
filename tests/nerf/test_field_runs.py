"""Runs that train a field instead of Gaussians: outputs, bits, and refusals."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

import clsplat
from clsplat.core.errors import ConfigError, DataError, NotFiniteError
from clsplat.gaussians.model import Rendering
from clsplat.nerf.field import Field
from clsplat.nerf.shape import FieldShape
from clsplat.nerf.training import LearnedField
from clsplat.opencl.device import open_device
from clsplat.photos.sampling import ViewPool
from clsplat.pipeline.loading import load
from clsplat.render.camera import upload_camera
from clsplat.runs.model_file import require_model
from clsplat.runs.state import RunState
from clsplat.runs.status import summarize_run
from clsplat.runs.time_budget import Rehearsal
from clsplat.runs.verify import verify
from clsplat.scene.camera import Camera
from clsplat.scene.images import read_image
from clsplat.scene.view import View
from clsplat.stages.train_field import TrainField
from clsplat.sweeps.compare.page import write_comparison
from clsplat.training import archive, checkpoint
from tests.support.commands import clsplat as clsplat_command
from tests.support.fields import PIPELINE, bits, resumed, train_single_threaded
from tests.support.runs import train

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> str:
    file = tmp_path_factory.mktemp("pipelines") / "field.yaml"
    file.write_text(PIPELINE)
    return str(file)


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory, pipeline: str) -> Path:
    out = tmp_path_factory.mktemp("runs") / "field"
    train(tiny_scene, out, pipeline=pipeline)
    return out


def test_field_run_writes_the_usual_outputs(finished):
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["gaussians"] is None
    assert metrics["parameters"] == FieldShape(depth=2, width=32, skip=0, color_width=16).parameter_count
    assert set(metrics["test"]) == {"1", "2", "4"}
    assert all(value["views"] == 2 for value in metrics["test"].values())
    assert json.loads((finished / "status.json").read_text())["state"] == "done"
    assert len(list((finished / "renders").rglob("*.png"))) == 2
    page = (finished / "report.html").read_text()
    assert f"{metrics['parameters']:,} parameters" in page
    assert "Gaussians" not in page.partition("<h2>Settings")[0]
    kinds = [json.loads(line)["kind"] for line in (finished / "metrics.jsonl").read_text().splitlines()]
    assert {"train", "evaluate", "view"} == set(kinds)


def test_renders_match_the_field(finished, tiny_scene, pipeline):
    """A checkpoint alone gives the picture, to the bit."""
    run = train(tiny_scene, finished, pipeline=pipeline, resume=True)
    view = run.scene.downscaled(1).split("test")[0]
    planes = run.painter().paint(upload_camera(run.device, view)).get()[:, :40, :40]
    (png,) = (finished / "renders").rglob(f"{Path(view.name).stem}.png")
    np.testing.assert_array_equal(read_image(png), np.rint(255 * planes.clip(0, 1)).astype(np.uint8).transpose(1, 2, 0))


def test_field_trains_longer_with_more_steps(finished, tmp_path):
    assert RunState.read(finished).steps_key == "train_field.steps"
    assert RunState.read(tmp_path).steps_key == "optimize.steps"
    output = clsplat_command("resume", finished, "--steps", "14", "--dry-run").stdout
    assert "14 steps" in output
    assert f"`clsplat resume {finished} --steps 24` trains longer" in "\n".join(summarize_run(finished))


def test_training_lowers_the_loss(tiny_scene, tmp_path, pipeline):
    train(tiny_scene, tmp_path / "run", "train_field.steps=40", "train_field.log_every=1", pipeline=pipeline)
    lines = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    losses = [line["loss"] for line in lines if line["kind"] == "train"]
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:3])


def test_images_of_all_sizes_count_equally(finished, tiny_scene, pipeline):
    """A ray of a small photograph stands for more area, and as many rays come from each."""
    run = train(tiny_scene, finished, pipeline=pipeline, resume=True)
    (stage, *_) = load(pipeline).stages
    assert isinstance(stage, TrainField)
    pool = ViewPool(run.scene.split("train"), run.seed)
    shown = [item for step in range(1, 5) for item in stage._sample(run, pool, step)]
    assert {item.camera.width for item in shown} == {40, 20}
    assert {(item.rays, item.weight) for item in shown} == {(32, 1600)}


def test_killed_run_resumes_to_the_same_bits(finished, tiny_scene, tmp_path, pipeline):
    assert bits(resumed(finished, tiny_scene, tmp_path / "run", pipeline)) == bits(finished)


def test_one_thread_gives_the_bits_of_several(finished, tiny_scene, tmp_path, pipeline):
    assert bits(train_single_threaded(tiny_scene, tmp_path / "run", pipeline)) == bits(finished)


def test_comparison_accepts_fields_and_gaussians(finished, few_steps, tmp_path):
    assert write_comparison([finished, few_steps], tmp_path / "compare.html") == 2
    page = (tmp_path / "compare.html").read_text()
    assert "parameters" in page
    assert "Gaussians" in page


def test_files_of_a_field_run_are_verified(finished):
    result = verify(RunState.read(finished))
    assert result["whole"]
    details = [item["detail"] for item in result["objects"]]
    assert [text for text in details if text.startswith("step 12, ") and text.endswith(" parameters")]


def test_model_commands_refuse_field_runs(finished):
    for path in (finished, finished / "field.npz"):
        with pytest.raises(DataError, match=r"is a field, which has a network instead of Gaussians; .*ren"):
            require_model(path)
    with pytest.raises(DataError, match="is a field"):
        clsplat.convert(finished, finished / "a.ply")
    assert clsplat.check(finished / "field.npz")["parameters"] == clsplat.load_field(finished).shape.parameter_count


def test_field_file_gives_the_metrics_and_images_of_its_run(finished, tmp_path):
    """To the bit, from the run folder and from the file, which knows its run."""
    recorded = json.loads((finished / "metrics.json").read_text())
    result = clsplat.evaluate(finished / "field.npz", downscales=[1, 2])
    assert {size: result["test"][size] for size in ("1", "2")} == {size: recorded["test"][size] for size in ("1", "2")}
    assert (result["gaussians"], result["parameters"]) == (None, recorded["parameters"])
    assert clsplat.render_views(finished, out=tmp_path / "images", depth=True) == 4
    for path in (finished / "renders").rglob("*.png"):
        assert next((tmp_path / "images").rglob(path.name)).read_bytes() == path.read_bytes()


def test_dry_run_estimates_the_training_time(tiny_scene, tmp_path, pipeline):
    text = clsplat.describe_run(pipeline, tiny_scene, tmp_path / "run")
    assert re.search(r"expected: 0\.1 min, .*\n  train_field +0\.1 min: 12 steps of .* ms, of 128 rays", text)


def test_field_trains_for_a_time_budget(tiny_scene, tmp_path, pipeline, monkeypatch):
    """Schedules of the rate are stretched as those of Gaussians, and the pipeline that is written repeats the bits."""
    rehearsal = Rehearsal(12, [0.01], overhead=0.0, after=0.0)
    monkeypatch.setattr("clsplat.runs.time_budget.rehearse_enough", lambda *given: rehearsal)
    monkeypatch.setattr(Rehearsal, "steps_in", lambda *given: 24)
    out = clsplat.run(pipeline, tiny_scene, tmp_path / "run", minutes=0.002)
    (stage, *_) = load(str(out / "pipeline.yaml")).stages
    assert stage.warm_up == 4
    assert stage.steps == json.loads((out / "metrics.json").read_text())["steps"] >= 10
    again = clsplat.run(out / "pipeline.yaml", tiny_scene, tmp_path / "again")
    assert (again / "field.npz").read_bytes() == (out / "field.npz").read_bytes()


def test_video_of_a_field(finished, tmp_path):
    made = clsplat.render_path(finished, video=tmp_path / "a.webm", frames=2, size="16x16", path="orbit")
    assert (made["frames"], made["size"]) == (2, [16, 16])


def test_video_stage_renders_a_field(tiny_scene, tmp_path):
    film = "  - timelapse\n  - video: {frames: 2, size: 16x16}\n"
    snapshot = '        - snapshot: {every: 2, size: "16x16"}\n'
    training, *_ = PIPELINE.split("        - evaluate")
    (tmp_path / "film.yaml").write_text(training + snapshot + film)
    out = clsplat.run(tmp_path / "film.yaml", tiny_scene, tmp_path / "run", set={"train_field.steps": 4})
    assert len(list((out / "timelapse").glob("*.png"))) == 2
    assert (out / "video.webm").stat().st_size > 0


def test_field_renders_from_python(finished, tiny_scene, device):
    view = clsplat.read_scene(tiny_scene).split("test")[0]
    field = clsplat.load_field(finished)
    picture = clsplat.FieldRenderer(field, device).render(view, depth=True)
    assert picture.image.shape == (*picture.alpha.shape, 3) == (*picture.depth.shape, 3)
    assert 0 <= picture.alpha.min() <= picture.alpha.max() <= 1
    covered = picture.depth[picture.alpha > 0]
    assert field.shape.near <= covered.min() <= covered.max() <= field.shape.far


def test_field_background_shows_where_uncovered(finished, tiny_scene, device):
    """Coverage and picture belong together: 1 - alpha of the background shows."""
    view = clsplat.read_scene(tiny_scene).split("test")[0]
    field = clsplat.load_field(finished)
    black, white = (
        clsplat.FieldRenderer(replace(field, rendering=Rendering(background=name)), device).render(view)
        for name in ("black", "white")
    )
    np.testing.assert_allclose(white.image - black.image, np.repeat(1 - white.alpha[..., None], 3, 2), atol=1e-5)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"format": 2}, "it is not a field, or has an unknown format, '2'"),
        ({"shape": {"width": 64}}, r"parameters are not \[\d+, 1\] float32"),
        ({"background": "pink"}, "metadata background: "),
        ({"shape": {"width": None}}, "metadata shape.width: "),
        ({"shape": {"width": 63}}, r"metadata shape\.width: .*multiple of 4"),
    ],
)
def test_invalid_field_file_is_refused_in_one_line(finished, tmp_path, change, complaint):
    notes, arrays = archive.read(finished / "field.npz")
    changed = {key: {**notes[key], **value} if isinstance(value, dict) else value for key, value in change.items()}
    with (tmp_path / "field.npz").open("wb") as file:
        archive.write(file, {**notes, **changed}, arrays.items())
    with pytest.raises(DataError, match=f"field.npz: {complaint}.*; expected an intact file of the stage export_field"):
        clsplat.load_field(tmp_path / "field.npz")


def test_missing_or_nonfinite_field_file_is_refused(finished, tmp_path):
    with pytest.raises(DataError, match="not found"):
        clsplat.load_field(tmp_path / "field.npz")
    field = clsplat.load_field(finished)
    field.parameters[3] = np.inf
    field.save(tmp_path / "field.npz")
    with pytest.raises(DataError, match="contain values that are not finite"):
        clsplat.load_field(tmp_path / "field.npz")


def test_nonfinite_field_stops_the_run_and_is_quarantined(tiny_scene, tmp_path, pipeline):
    with pytest.raises(NotFiniteError, match=r"not finite: .*train_field\.rate="):
        train(tiny_scene, tmp_path / "run", "train_field.rate=1e30", pipeline=pipeline)
    assert [path.name for path in (tmp_path / "run/checkpoints").glob("failed_*")]


def test_checkpoint_of_another_shape_is_refused(finished):
    """What a file says of its shape, and the tables that it holds, belong together."""
    state, tables = checkpoint.load(checkpoint.list_files(finished)[-1])
    assert state.field is not None
    other = state.model_copy(update={"field": state.field | {"shape": state.field["shape"] | {"width": 64}}})
    with pytest.raises(DataError, match="the table 'parameters' of its field is not"):
        checkpoint.check_run_tables(other, tables)
    with pytest.raises(DataError, match="does not have the tables"):
        checkpoint.check_run_tables(state, {"field/parameters": tables["field/parameters"]})
    tables["field/moment1"] = np.full_like(tables["field/moment1"], np.nan)
    with pytest.raises(DataError, match="the table 'moment1' of its field contains values that are not finite"):
        checkpoint.check_run_tables(state, tables)


@pytest.mark.parametrize("stage", ["export", "viewer", "densify: {rules: []}"])
def test_stages_of_gaussians_are_refused_after_a_field(tmp_path, stage):
    file = tmp_path / "wrong.yaml"
    file.write_text(PIPELINE + f"  - {stage}\n")
    with pytest.raises(ConfigError, match="needs 'model'"):
        load(str(file))


@pytest.mark.parametrize(
    ("keys", "complaint"),
    [
        ({"near": 3.0, "far": 2.0}, "'far' must be larger than 'near'"),
        ({"skip": 7}, "'skip' must be null or less than 7"),
        ({"width": 30}, "multiple of 4"),
        ({"coarse_samples": 20}, "multiple of 16"),
    ],
)
def test_invalid_shape_is_refused(keys, complaint):
    with pytest.raises(ValidationError, match=complaint):
        FieldShape(**keys)


def test_rays_are_divided_evenly():
    with pytest.raises(ValidationError, match="must be a multiple of 'photographs', 3"):
        TrainField(steps=1, rays=100, photographs=3)


def test_published_recipe_has_the_published_network_and_rates():
    (stage, *_) = load("mip_nerf").stages
    assert isinstance(stage, TrainField)
    assert stage.field == FieldShape()
    width, position, direction = 256, 6 * 16, 3 + 6 * 4
    trunk = (position + 1) * width + 6 * (width + 1) * width + (width + position + 1) * width
    assert stage.field.parameter_count == trunk + (width + 1) * (1 + width) + (width + direction + 1) * 128 + 129 * 3
    assert stage.rate_at(1) == pytest.approx(5e-4 * (0.01 + 0.99 * math.sin(math.pi / 5000)), rel=1e-4)
    assert stage.rate_at(1_000_000) == pytest.approx(5e-6)


def paint(field: Field, view: View) -> np.ndarray:
    planes = field.paint(upload_camera(field.workspace.device, view)).get()
    return planes[:, : view.camera.height, : view.camera.width]


@pytest.fixture(scope="module")
def small_field() -> Field:
    device = open_device()
    shape = FieldShape(
        unit=1.0, coarse_samples=16, fine_samples=16, depth=1, skip=None, width=4, color_width=4, degrees=2
    )
    return Field.initial(shape, 1, device.upload(np.array([1.0, 0.5, 0.0], np.float32)))


@pytest.mark.parametrize("size", [(1, 1), (64, 1), (65, 1), (97, 11)])
def test_images_of_all_sizes_render_completely(small_field, size):
    """Around tiles of samples, and around the rays that are rendered at a time; a pixel has its own ray."""
    camera = Camera(*size, 50.0, 50.0, size[0] / 2, size[1] / 2)
    view = View.looking_at([0, -4, 1], [0, 0, 0], [0, 0, 1], camera)
    image = paint(small_field, view)
    assert np.isfinite(image).all()
    assert image.min() > -0.01
    right = View(view.name, Camera(1, 1, 50.0, 50.0, camera.cx - size[0] + 1, camera.cy), view.world_to_camera)
    np.testing.assert_array_equal(paint(small_field, right)[:, 0, 0], image[:, 0, -1])


def test_zero_rays_give_no_pixels(small_field):
    camera = upload_camera(small_field.workspace.device, View("v", Camera(4, 4, 9.0, 9.0, 2.0, 2.0), np.eye(3, 4)))
    rays = small_field.ray_renderer.cast(camera, small_field.workspace.device.upload(np.zeros(0, np.uint32)))
    levels = list(small_field.ray_renderer.render(small_field.parameters, rays))
    assert [level.colors.shape for level in levels] == [(0, 3), (0, 3)]


def test_nan_parameter_shows_in_the_render(small_field):
    """A ReLU hides none, and neither does a limit: the run that trains it stops."""
    for layer in small_field.shape.layers:
        parameters = small_field.parameters.get()
        parameters[layer.first_bias] = np.nan
        device, shape = small_field.workspace.device, small_field.shape
        broken = Field(shape, device.upload(parameters), small_field.ray_renderer.background)
        view = View.looking_at([0, -4, 1], [0, 0, 0], [0, 0, 1], Camera(5, 3, 9.0, 9.0, 2.5, 1.5))
        assert np.isnan(paint(broken, view)).any(), layer.name


def test_distant_space_is_encoded_as_zero(small_field):
    """Distances of a million: the features vanish, and the picture stays finite."""
    view = View.looking_at([1e6, 0, 0], [0, 0, 0], [0, 0, 1], Camera(5, 3, 9.0, 9.0, 2.5, 1.5))
    assert np.isfinite(paint(small_field, view)).all()


def test_continued_training_keeps_adam_moments(tiny_scene, tmp_path, pipeline):
    """Two stages of one shape are one training; one of another shape begins anew, in a run that goes on too."""
    two = tmp_path / "two.yaml"
    (stage, *_) = PIPELINE.split("  - evaluate: {split: test, downscales")
    training = stage.partition("stages:\n")[2]
    two.write_text(stage + training)
    run = train(tiny_scene, tmp_path / "same", "stages.0.steps=4", "stages.1.steps=4", pipeline=str(two))
    assert isinstance(run.learned_field, LearnedField)
    assert run.learned_field.updates == 8
    two.write_text(stage + training.replace("width: 32", "width: 16"))
    run = train(tiny_scene, tmp_path / "other", "stages.0.steps=4", "stages.1.steps=4", pipeline=str(two))
    assert isinstance(run.learned_field, LearnedField)
    assert (run.learned_field.updates, run.learned_field.field.shape.width) == (4, 16)
    state, _ = checkpoint.load(checkpoint.list_files(tmp_path / "other")[-1])
    assert (state.step, state.updates) == (8, {"field": 4})
