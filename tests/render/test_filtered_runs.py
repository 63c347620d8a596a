"""Runs with both filters of Mip-Splatting: their bits, their files, and metrics at several scales."""

import json
from pathlib import Path

import numpy as np
import pytest

from clsplat.conformance.scenes import add_world_filter, random_case
from clsplat.core.errors import Interrupted
from clsplat.core.progress import Progress
from clsplat.formats.ply import write_ply
from clsplat.formats.splats import PARAMETERS
from clsplat.formats.table import read as read_ply
from clsplat.gaussians.model import Model
from clsplat.metrics.views import render_view
from clsplat.photos.sampling import Sampler, StackOrder, ViewSettings
from clsplat.pipeline.loading import load
from clsplat.render.painter import SplatPainter
from clsplat.runs import opening, runner
from clsplat.runs.model_file import ModelFile
from clsplat.training.run import Run
from tests.support.runs import digest, train

pytestmark = pytest.mark.slow

RAW = "point_cloud_raw.ply"
MIP = (
    "model.world_filter.type=smoothing",
    "model.screen_filter={type: mip}",
    "optimize.raise_sh.every=5",
    "optimize.densify.start=5",
)
LEVELS = ("scene.levels=3", "optimize.views.order=stack", "evaluate.downscales=[1, 2, 4]")


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The smoke recipe with a refresh of the filter on a cadence of its own."""
    text = load("smoke").text()
    assert "  - checkpoint:" in text
    lines = text.splitlines()
    at = next(i for i, line in enumerate(lines) if line.strip().startswith("- checkpoint:"))
    indent = lines[at][: lines[at].index("-")]
    path = tmp_path_factory.mktemp("pipelines") / "smoke_mip.yaml"
    path.write_text("\n".join([*lines[:at], f"{indent}- refresh_filter: {{every: 4, stop: 47}}", *lines[at:]]))
    return str(path)


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, pipeline: str, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train(tiny_scene, tmp_path_factory.mktemp("runs") / "mip", *MIP, *LEVELS, pipeline=pipeline)


def test_filter_is_refreshed_and_then_frozen(finished):
    """At the end it is what the last refresh, before step 47, made of the means of then."""
    gaussians = finished.model.gaussians
    frozen = gaussians.get("filter_variance")
    assert (frozen > 0).all()
    finished.refresh_filter()
    now = gaussians.get("filter_variance")
    gaussians.set("filter_variance", frozen)
    assert (now != frozen).any()
    np.testing.assert_allclose(now, frozen, rtol=0.05)


def test_run_repeats_and_resumes_bit_for_bit(finished, tiny_scene, pipeline, tmp_path):
    """Stopped just after a density edit and just after a refresh."""
    checked = load(pipeline, [f"scene.path='{tiny_scene}'", *MIP, *LEVELS])
    stops = [21, 33]
    while stops:
        run = opening.open_run(checked, tmp_path, None)
        stop_at = stops.pop(0)

        def stop(progress: Progress, run: Run = run, stop_at: int = stop_at) -> None:
            run.interrupted = progress.step >= stop_at

        with pytest.raises(Interrupted):
            runner.execute(checked, run, "resume", stop)
    train(tiny_scene, tmp_path, *MIP, *LEVELS, pipeline=pipeline, resume=True)
    assert digest(tmp_path) == digest(finished.out)
    assert (tmp_path / RAW).read_bytes() == (finished.out / RAW).read_bytes()


def test_metrics_of_every_scale(finished):
    metrics = json.loads((finished.out / "metrics.json").read_text())
    assert list(metrics["test"]) == ["1", "2", "4"]
    lines = [json.loads(line) for line in (finished.out / "metrics.jsonl").read_text().splitlines()]
    for downscale in ("1", "2", "4"):
        last = [
            line
            for line in lines
            if line["kind"] == "view" and line["step"] == 50 and line["downscale"] == float(downscale)
        ]
        views = {line["view"]: line["psnr"] for line in last}
        assert len(views) == metrics["test"][downscale]["views"] == 2
        assert np.mean(list(views.values())) == pytest.approx(metrics["test"][downscale]["psnr"])


def test_training_uses_every_level(finished):
    assert finished.scene.downscales == (1, 2, 4)
    sampler = Sampler(finished.scene.split("train"), ViewSettings(order=StackOrder()), finished.seed)
    assert {sampler.at(step).view.downscale for step in range(1, 51)} == {1, 2, 4}


def test_models_are_evaluated_above_the_training_size(tiny_scene, tmp_path):
    """Trained at 1/4, tested up to the full size; factors are those of the photographs."""
    run = train(tiny_scene, tmp_path, "scene.downscale=4", "evaluate.downscales=[4, 2, 1]", "optimize.steps=5")
    assert run.scene.views[0].camera.width == 10
    assert list(run.metrics["test"]) == ["4", "2", "1"]
    default = train(tiny_scene, tmp_path / "default", "scene.downscale=4", "optimize.steps=5")
    assert default.metrics["test"] == {"4": run.metrics["test"]["4"]}


def test_both_files_have_the_mip_mark(finished):
    raw, fused = (read_ply(finished.out / name) for name in (RAW, "point_cloud.ply"))
    assert raw.mode == fused.mode == "mip"
    assert b"\ncomment SplatRenderMode: mip\n" in (finished.out / "point_cloud.ply").read_bytes()[:2000]
    assert raw.rendering == fused.rendering
    assert (raw.rendering["screen_variance"], raw.rendering["compensate"]) == (0.1, 1)
    assert "filter_variance" not in fused.parameters
    gaussians = finished.model.gaussians
    for name in PARAMETERS:
        np.testing.assert_array_equal(raw.parameters[name], gaussians.get(name))
    np.testing.assert_allclose(raw.parameters["filter_variance"], gaussians.get("filter_variance"), rtol=3e-7)


@pytest.mark.parametrize("name", [RAW, "point_cloud.ply"])
def test_files_render_like_the_run(finished, tiny_scene, name):
    """To rounding: floats differ by less than 2e-5, but for a pixel now and then that rounding moves across 1/255."""
    opened = ModelFile(finished.out / name, tiny_scene, None)
    for view in finished.scene.downscaled(1).split("test"):
        camera = finished.photographs.camera(view)
        images = [
            finished.rasterizer.forward(model, camera, finished.photographs.background).image.get()
            for model in (finished.model, on_device(finished, opened))
        ]
        difference = np.abs(images[0] - images[1])
        assert np.quantile(difference, 0.999) < 2e-5
        assert difference.max() < 2 / 255
        eight_bits = render_view(
            SplatPainter(finished.rasterizer, finished.model, finished.photographs.background), camera
        )
        other = render_view(
            SplatPainter(finished.rasterizer, on_device(finished, opened), finished.photographs.background), camera
        )
        assert np.abs(eight_bits.astype(int) - other).max() <= 1
    measured = opened.evaluate([1, 2, 4])["test"]
    for scale, values in finished.metrics["test"].items():
        assert measured[scale]["psnr"] == pytest.approx(values["psnr"], abs=1e-3)
        assert measured[scale]["ssim"] == pytest.approx(values["ssim"], abs=1e-5)


def on_device(run: Run, opened: ModelFile):
    """The opened model with its tables on the run's device."""
    model = opened.gaussians.upload(opened.device)
    tables = {name: model.gaussians.get(name) for name in (*PARAMETERS, "filter_variance")}
    return type(model)(
        type(model.gaussians)(run.device, tables), model.degree, model.near, model.screen_variance, model.compensate
    )


def test_baking_is_the_filter(rng):
    case = add_world_filter(random_case(rng, 200), rng)
    parameters = {name: table.copy() for name, table in case.parameters.items()}
    parameters["filter_variance"][0] = 0
    parameters["filter_variance"][1] = 1e30  # spreads the Gaussian out to nothing
    fused = Model(**parameters).baked().tables()
    double = {name: table.astype(np.float64) for name, table in parameters.items()}
    raw, variance = np.exp(double["log_scales"]), double["filter_variance"]
    scale = np.sqrt(raw**2 + variance)
    opacity = np.prod(raw / scale, axis=1) / (1 + np.exp(-double["logit_opacity"][:, 0]))
    np.testing.assert_allclose(np.exp(fused["log_scales"].astype(np.float64)), scale, rtol=2e-6)
    drawn = 1 / (1 + np.exp(-fused["logit_opacity"][:, 0].astype(np.float64)))
    np.testing.assert_allclose(drawn, opacity, rtol=1e-5, atol=1e-30)
    for name in ("means", "quats", "sh_base", "sh_rest"):
        np.testing.assert_array_equal(fused[name], parameters[name])
    np.testing.assert_array_equal(fused["log_scales"][0], parameters["log_scales"][0])


def test_run_without_a_world_filter_writes_one_file(tiny_scene, tmp_path):
    train(tiny_scene, tmp_path, "optimize.steps=3", "model.screen_filter.type=ewa")
    assert not (tmp_path / RAW).exists()
    assert read_ply(tmp_path / "point_cloud.ply").mode == "mip", "opacities keep the energy of the screen filter"


def test_files_of_other_programs_with_a_filter_render_with_mip(tmp_path, rng, tiny_scene):
    """Mip-Splatting's own files have `filter_3D` and no comment; other trainers write the comment alone."""
    case = add_world_filter(random_case(rng, 5), rng)
    for keep_filter in (True, False):
        path = tmp_path / f"{keep_filter}.ply"
        names = [*PARAMETERS, *(["filter_variance"] if keep_filter else [])]
        write_ply(path, {name: case.parameters[name] for name in names}, {})
        data = path.read_bytes().replace(b"comment clsplat {}\n", b"")
        mode = b"" if keep_filter else b"comment SplatRenderMode: mip\n"
        path.write_bytes(data.replace(b"comment SplatRenderMode: default\n", mode))
        opened = ModelFile(path, tiny_scene, None)
        model = opened.gaussians.upload(opened.device)
        assert (model.screen_variance, model.compensate) == (0.1, 1)
        assert model.gaussians.get("filter_variance").any() == keep_filter
