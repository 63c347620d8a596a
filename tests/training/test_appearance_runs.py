"""Whole runs with a color correction per photograph."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.api.commands import evaluate
from clsplat.core.errors import DataError
from clsplat.photos.exposure_estimate import UNKNOWN, Exposures
from clsplat.pipeline.loading import load, without_auto
from clsplat.runs import opening, run_folder
from clsplat.runs.state import RunState
from clsplat.sweeps.compare.comparison import RunComparison
from clsplat.sweeps.compare.page import main_table
from clsplat.sweeps.experiment import run_pipeline
from clsplat.training import checkpoint
from clsplat.training.modules.base import read_color_model
from clsplat.training.modules.exposure import Exposure
from tests.support.exposed_wall import Wall
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow
GAIN = (*FEW, "optimize.modules.exposure={}")


@pytest.fixture(scope="module")
def with_gains(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of twelve steps with an exposure of each photograph; nothing is changed in it."""
    out = tmp_path_factory.mktemp("runs") / "gains"
    train(tiny_scene, out, *GAIN)
    return out


def test_visits_are_counted_per_image_and_the_mean_is_zero(tiny_scene, tmp_path, few_steps):
    run = train(tiny_scene, tmp_path / "run", *GAIN)
    names = [view.name for view in run.scene.split("train")]
    scalars = run.modules["exposure"].scalars
    updates = [scalars.get(f"colors/{name}/exposure/updates", 0) for name in names]
    assert sum(updates) == 12
    assert len(set(updates)) > 1, "eight photos, twelve steps"
    for column in ("exposure", "red", "blue"):
        values = [scalars[f"colors/{name}/{column}"] for name in names]
        assert sum(values) == pytest.approx(0, abs=1e-12)
        assert max(map(abs, values)) > 1e-3
    assert digest(tmp_path / "run") != digest(few_steps)


def test_color_table_and_metrics_are_written(with_gains, few_steps):
    data = json.loads((with_gains / "view_colors.json").read_text())
    assert (data["type"], data["model"]) == ("exposure", "gain")
    assert len(data["photographs"]) == 8
    for row in data["photographs"].values():
        luminance = np.log(np.diag(row["matrix"])) @ [0.299, 0.587, 0.114]
        assert luminance == pytest.approx(row["exposure"])
    measured = json.loads((with_gains / "metrics.json").read_text())["test"]["1"]
    assert {"psnr_color", "psnr_affine"} < measured.keys()
    pages = [(out / "report.html").read_text() for out in (with_gains, few_steps)]
    assert [f"{measured['psnr_color']:.2f} dB" in page and "colors fitted" in page for page in pages] == [True, False]
    assert "view_colors.json" in json.loads((with_gains / "checksums.json").read_text())
    assert not (few_steps / "view_colors.json").exists()
    assert "psnr_color" not in json.loads((few_steps / "metrics.json").read_text())["test"]["1"]


def test_comparison_has_a_color_column(with_gains, few_steps):
    tables = [
        main_table(next(iter(RunComparison.read(folders).scenes.values()))) for folders in ([with_gains], [few_steps])
    ]
    headings = [[column.heading for group in table.groups for column in group.columns] for table in tables]
    assert ["PSNR, colors fitted ↑" in heading for heading in headings] == [True, False]


def test_run_folder_is_also_measured_in_image_colors(with_gains, few_steps, tmp_path):
    measured = json.loads((with_gains / "metrics.json").read_text())["test"]["1"]
    again = evaluate(with_gains)["test"]["1"]
    assert again["psnr_color"] == pytest.approx(measured["psnr_color"], abs=1e-6)
    assert "psnr_color" not in evaluate(few_steps)["test"]["1"]
    for damage in ("[]", '{"type": "lens"}'):
        (tmp_path / "view_colors.json").write_text(damage)
        with pytest.raises(DataError, match=r"unknown color type .* expected \w+"):
            read_color_model(tmp_path / "point_cloud.ply")


def test_color_start_step_is_saved(rng, tmp_path):
    """The rate depends on it, also where the file that told it is gone."""
    wall = Wall(rng)
    wall.write(tmp_path / "scene")
    gain = (*FEW, "scene.holdout=0", "optimize.modules.exposure={}")
    run = train(tmp_path / "scene", tmp_path / "run", *gain)
    last = tmp_path / "run" / "checkpoints" / "step_000012.npz"
    last.unlink()
    for name in ("point_cloud.ply", "metrics.json", "checksums.json"):
        (tmp_path / "run" / name).unlink()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("clsplat.training.modules.exposure.estimate_exposures", lambda run: UNKNOWN)
        again = train(tmp_path / "scene", tmp_path / "run", *gain, resume=True)
    assert again.modules["exposure"].scalars == run.modules["exposure"].scalars


def test_best_model_has_the_colors_of_its_step(tiny_scene, tmp_path):
    wild = "optimize.rates.means=[[8, 1.0e-3], [9, 0.9]]"
    kept = (
        "scene.validation=2",
        "optimize.keep=best",
        "optimize.evaluate.split=validation",
        "optimize.evaluate.every=4",
    )
    run = train(tiny_scene, tmp_path / "run", *GAIN, *kept, wild)
    assert run.best.measured.step == 8, "the last steps ruin it"
    then, _ = checkpoint.load(tmp_path / "run" / "checkpoints" / "step_000008.npz")
    assert run.modules["exposure"].scalars == then.modules["exposure"]
    (row, *_) = json.loads((tmp_path / "run" / "view_colors.json").read_text())["photographs"].items()
    assert row[1]["exposure"] == then.modules["exposure"][f"colors/{row[0]}/exposure"]


def test_decision_is_recorded_and_off_keeps_the_bits(tiny_scene, tmp_path, few_steps):
    """The synthetic scene has points without tracks."""
    pipeline = load("smoke", [f"scene.path='{tiny_scene}'", *FEW, "optimize.modules.exposure.when=auto"])
    run_pipeline(pipeline, RunState.read(tmp_path / "run"), None, "new")
    actual = load(str(tmp_path / "run" / "pipeline.yaml")).settings.training.modules[0]
    assert actual.chosen == "off"
    assert actual.reason == "neither tracks nor EXIF gives exposures"
    assert f"optimize.modules.exposure: off, since {actual.reason}" in (tmp_path / "run" / "log.txt").read_text()
    assert digest(tmp_path / "run") == digest(few_steps)
    assert RunState.read(tmp_path / "run").is_complete(pipeline), "the same command finds it up to date"


def test_run_enables_colors_if_exposures_differ(rng, tmp_path):
    wall = Wall(rng)
    wall.write(tmp_path / "scene")
    settings = [f"scene.path='{tmp_path / 'scene'}'", "scene.holdout=0", *FEW, "optimize.modules.exposure.when=auto"]
    run_pipeline(load("smoke", settings), RunState.read(tmp_path / "run"), None, "new")
    actual = load(str(tmp_path / "run" / "pipeline.yaml")).settings.training.modules[0]
    assert actual.chosen == "on"
    assert "exposures of 8 photos differ by" in actual.reason
    photographs = json.loads((tmp_path / "run" / "view_colors.json").read_text())["photographs"]
    gains = np.log([np.diag(photographs[view.name]["matrix"]) for view in wall.views])
    assert gains == pytest.approx(wall.log_gains, abs=0.06), "twelve steps do not move them far"
    with run_folder.open_run_folder(RunState.read(tmp_path / "run"), "resume", step=0) as status:
        run = opening.open_run(load(str(tmp_path / "run" / "pipeline.yaml")), tmp_path / "run", None, "resume", status)
    assert run.settings.training.modules == [actual], "who goes on takes the choice"


@pytest.mark.parametrize(
    ("spread", "explained", "chosen", "said"),
    [
        (0.133, 0.32, "off", "; not more than 33% of the variance"),
        (0.02, 0.9, "off", "; not more than 3.0%"),
        (0.02, 0.1, "off", "; not more than 3.0% or 33% of the variance"),
        (0.133, 0.7, "on", "; more than 3.0% and 33% of the variance"),
    ],
)
def test_reason_names_the_deciding_bound(spread, explained, chosen, said):
    exposures = Exposures({"a": np.full(3, spread), "b": np.full(3, -spread)}, "at 9 points", explained)
    run = SimpleNamespace(scene=SimpleNamespace(split=lambda _: []), cache={("colors", ()): exposures})
    result = Exposure(when="auto").resolve_auto(run)
    assert (result.chosen, result.reason) == (chosen, exposures.summary + said)


def test_decision_is_not_written_as_a_setting():
    asked = load("smoke", ["optimize.modules.exposure.when=auto"]).resolved_settings()
    chosen = load(
        "smoke", ["optimize.modules.exposure={when: auto, chosen: on, reason: they differ}"]
    ).resolved_settings()
    assert asked != chosen
    assert without_auto(asked) == without_auto(chosen)
    assert without_auto(asked) != without_auto(load("smoke").resolved_settings())
