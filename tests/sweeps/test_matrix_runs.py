"""Cells of a matrix run independently, and a dry run agrees with the run."""

import json
import logging
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from clsplat.core.errors import ClsplatError, ConfigError, DataError, InternalError, Interrupted, NumericError
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import load_experiment
from clsplat.runs import opening, runner
from clsplat.runs.state import RunState
from clsplat.sweeps import experiment
from tests.support.commands import clsplat
from tests.support.pipelines import SMALL, STAGES, names

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(tiny_scene, tmp_path_factory) -> tuple[str, Path]:
    """The file of a matrix that was run, and its folder."""
    folder = tmp_path_factory.mktemp("matrix")
    (folder / "x.yaml").write_text(
        f"name: sweep\nscene: {{path: '{tiny_scene}'}}\n" + SMALL.removeprefix("name: sweep\n")
    )
    actual = load_experiment(str(folder / "x.yaml"))
    assert actual is not None
    logging.getLogger("clsplat").setLevel(logging.INFO)
    experiment.run_matrix(actual, RunState.read(folder / "run"), None, "new")
    return str(folder / "x.yaml"), folder / "run"


def test_every_cell_is_a_separate_run(finished):
    _, out = finished
    folders = sorted(path.parent.name for path in out.glob("*/metrics.json"))
    assert folders == sorted(names(load_experiment(finished[0])))
    cell = out / "steps=6-opacity=0.1-seed=1"
    metrics = json.loads((cell / "metrics.json").read_text())
    assert (metrics["steps"], metrics["seed"]) == (6, 1)
    assert "step 6/6" in (cell / "log.txt").read_text()
    assert "step 6/6" not in (out / "steps=4-opacity=0.1-seed=1" / "log.txt").read_text(), "logs are apart"
    assert load(str(cell / "pipeline.yaml")).settings.stages[1].steps == 6
    status = json.loads((out / "status.json").read_text())
    assert (status["state"], status["cells"], status["failed"]) == ("done", 4, {})
    page = (out / "compare.html").read_text()
    assert "sweep: 4 runs" in page
    assert "2 variants on 1 scene" in page
    assert "<td>optimize.steps</td><td>4</td><td>6</td>" in page


def test_matrix_folder_is_accepted_for_its_cells(finished, tmp_path):
    clsplat("compare", finished[1], "--out", tmp_path / "c.html")
    assert "sweep: 4 runs" in (tmp_path / "c.html").read_text()
    (tmp_path / "empty").mkdir()
    shutil.copy(finished[1] / "pipeline.yaml", tmp_path / "empty")
    done = clsplat("compare", tmp_path / "empty", "--out", tmp_path / "d.html", expect=3)
    assert "no cell of this matrix has finished" in done.stderr


def test_dry_run_reads_each_distinct_scene_once(tiny_scene, tmp_path, monkeypatch):
    read, folders = opening.read_scene, []

    def counted(folder, holdout):
        folders.append(folder.name)
        return read(folder, holdout)

    monkeypatch.setattr(opening, "read_scene", counted)
    shutil.copytree(tiny_scene, tmp_path / "other")
    axes = f"scenes: ['{tiny_scene}', '{tmp_path / 'other'}'], seeds: [0, 1, 2], set: {{scene.downscale: [1, 2]}}"
    (tmp_path / "x.yaml").write_text(f"name: sweep\nmatrix: {{{axes}}}\n{STAGES}")
    actual = load_experiment(str(tmp_path / "x.yaml"))
    assert len(actual.cells) == 12
    assert "would run 12 cells" in experiment.describe_matrix(actual, RunState.read(tmp_path / "run"), None, "new")
    assert sorted(folders) == sorted([tiny_scene.name, "other"] * 2), "at each of two sizes"
    assert not (tmp_path / "run").exists()


def test_resume_runs_only_missing_cells(finished, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(finished[1], out)
    bits = {path.parent.name: path.read_bytes() for path in out.glob("*/point_cloud.ply")}
    missing, cut_short = "steps=4-opacity=0.1-seed=1", "steps=6-opacity=0.1-seed=0"
    shutil.rmtree(out / missing)
    for name in ("metrics.json", "point_cloud.ply", "checkpoints/step_000006.npz"):
        (out / cut_short / name).unlink(missing_ok=True)
    (out / cut_short / "status.json").write_text('{"state": "running"}')
    untouched = (out / "steps=4-opacity=0.1-seed=0" / "metrics.json").stat().st_mtime_ns
    done = clsplat("run", finished[0], "--out", out, "--resume")
    assert "cell 1 of 4: steps=4-opacity=0.1-seed=0 is done" in done.stdout
    assert "resumed at step 4" in done.stdout
    assert done.stdout.count("is done") == 2
    assert (out / "steps=4-opacity=0.1-seed=0" / "metrics.json").stat().st_mtime_ns == untouched
    assert {path.parent.name: path.read_bytes() for path in out.glob("*/point_cloud.ply")} == bits


def test_resumed_matrix_has_the_options_of_its_run(tiny_scene, tmp_path):
    """Of --set and --scene, which its file does not name."""
    (tmp_path / "x.yaml").write_text(f"name: sweep\nmatrix: {{seeds: [0, 1]}}\n{STAGES}")
    out = tmp_path / "run"
    experiment.Job.open(str(tmp_path / "x.yaml"), tiny_scene, out, ["optimize.steps=5", "optimize.steps=3"]).run()
    shutil.rmtree(out / "seed=1")
    experiment.Job.resume(out).run()
    assert json.loads((out / "status.json").read_text())["state"] == "done"
    assert json.loads((out / "seed=1" / "metrics.json").read_text())["steps"] == 3
    before = [(out / name).read_bytes() for name in ("pipeline.yaml", "status.json")]
    with pytest.raises(ConfigError, match=r"has a run with other settings: .*steps was 3, is 4"):
        experiment.Job.resume(out, ["optimize.steps=4"]).run()
    assert [(out / name).read_bytes() for name in ("pipeline.yaml", "status.json")] == before, (
        "plain resume still works"
    )
    options = load_experiment(str(out / "pipeline.yaml"), ["init.count=9"]).text.partition("options:")[2]
    assert options.count("optimize.steps") == options.count("init.count") == options.count("scene.path") == 1


def test_matrix_without_its_status_resumes(finished, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(finished[1], out)
    (out / "status.json").unlink()
    experiment.run_matrix(load_experiment(str(out / "pipeline.yaml")), RunState.read(out), None, "resume")
    assert json.loads((out / "status.json").read_text())["state"] == "done"
    mine = tmp_path / "mine"
    mine.mkdir()
    shutil.copy(finished[0], mine / "pipeline.yaml")
    with pytest.raises(ConfigError, match="was not written by a run"):
        experiment.run_matrix(load_experiment(finished[0]), RunState.read(mine), None, "restart")


def test_failing_cell_does_not_stop_other_cells(finished, tmp_path, monkeypatch):
    execute = runner.execute

    def failing(pipeline, run, start, show):
        if pipeline.settings.stages[1].steps == 4:
            raise NumericError("the loss is nan") if run.seed == 0 else DataError("no photo")
        execute(pipeline, run, start, show)

    monkeypatch.setattr(runner, "execute", failing)
    with pytest.raises(ClsplatError, match=r"2 of 4 cells failed; the first, steps=4-.*: the loss is nan") as error:
        experiment.run_matrix(load_experiment(finished[0]), RunState.read(tmp_path / "run"), None, "new")
    assert error.value.exit_code == NumericError.exit_code
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    assert (status["state"], status["exit_code"], status["done"]) == ("failed", 6, 4)
    assert status["message"] == str(error.value)
    assert len(status["failed"]) == 2
    page = (tmp_path / "run" / "compare.html").read_text()
    assert "sweep: 2 runs" in page
    assert "steps=4-opacity=0.1-seed=1 failed and is not shown: no photo" in page


def test_matrix_always_ends_with_a_status(finished, tmp_path, monkeypatch):
    def broken(*arguments):
        raise AssertionError

    monkeypatch.setattr(experiment, "write_comparison", broken)
    shutil.copytree(finished[1], tmp_path / "run")
    with pytest.raises(InternalError, match=r"a bug\): AssertionError; run with --debug") as error:
        experiment.run_matrix(load_experiment(finished[0]), RunState.read(tmp_path / "run"), None, "resume")
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    assert (status["state"], status["exit_code"], status["message"]) == ("failed", 1, str(error.value))


def test_interrupt_stops_the_matrix(finished, tmp_path, monkeypatch):
    cells = []

    def interrupted(pipeline, run, start, show):
        cells.append(run.out)
        raise Interrupted("stopped at step 2")

    monkeypatch.setattr(runner, "execute", interrupted)
    words = f"stopped in cell 1 of 4: steps=4-opacity=0.1-seed=0; `clsplat resume {tmp_path / 'run'}` continues it"
    with pytest.raises(Interrupted, match=re.escape(words)):
        experiment.run_matrix(load_experiment(finished[0]), RunState.read(tmp_path / "run"), None, "new")
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "interrupted"
    assert len(cells) == 1
    assert not cells[0].exists(), "it had not begun"
    assert not (tmp_path / "run" / "compare.html").exists()


def test_cells_with_other_settings_are_not_reused(finished, tmp_path):
    shutil.copytree(finished[1], tmp_path / "run")
    changed = tmp_path / "changed.yaml"
    changed.write_text(Path(finished[0]).read_text().replace("count: 300", "count: 301"))
    with pytest.raises(
        ConfigError, match=r"seed=0: has a run with other settings: stages\[0\].init.count was 300, is 301"
    ):
        experiment.run_matrix(load_experiment(str(changed)), RunState.read(tmp_path / "run"), None, "resume")


def test_folders_of_matrices_and_runs_are_not_mixed(finished, tiny_scene, tmp_path):
    with pytest.raises(ConfigError, match="already has a run"):
        experiment.run_matrix(load_experiment(finished[0]), RunState.read(finished[1]), None, "new")
    (tmp_path / "pipeline.yaml").write_text("name: single\nstages: []\n")
    with pytest.raises(ConfigError, match="has a single run"):
        experiment.run_matrix(load_experiment(finished[0]), RunState.read(tmp_path), None, "resume")


def test_check_and_dry_run_list_the_cells(finished, tmp_path):
    done = clsplat("check", finished[0])
    assert "x.yaml: valid; 4 cells: steps=4" in done.stdout
    assert json.loads(clsplat("check", finished[0], "--json").stdout)["cells"] == names(load_experiment(finished[0]))
    done = clsplat("run", finished[0], "--out", tmp_path / "new", "--dry-run")
    assert "would run 4 cells" in done.stdout
    assert re.findall(r"^  (\S+)$", done.stdout, re.MULTILINE) == names(load_experiment(finished[0]))
    assert not (tmp_path / "new").exists()
    assert "already has a run" in clsplat("run", finished[0], "--out", finished[1], "--dry-run", expect=2).stderr
    done = clsplat("run", finished[0], "--out", finished[1], "--resume", "--dry-run")
    assert done.stdout.count("  done") == 4


def _cut(scene: Path, out: Path) -> None:
    photograph = min((scene / "train").rglob("*.png"))
    photograph.write_bytes(photograph.read_bytes()[:200])


def _write_foreign_render(scene: Path, out: Path) -> None:
    (out / "seed=0" / "renders").mkdir(parents=True)
    (out / "seed=0" / "renders" / "mine.png").write_text("mine")


def _write_foreign_run(scene: Path, out: Path) -> None:
    (out / "seed=0").mkdir(parents=True)
    (out / "seed=0" / "pipeline.yaml").write_text("name: mine\n")


CAUSES: dict[str, tuple[int, str, str, Callable[[Path, Path], None] | None]] = {
    # name: (exit code, device, setting of every cell, what is done before)
    "a damaged photograph": (3, "", "", _cut),
    "no such device": (4, "nowhere", "", None),
    "a file that a stage needs": (3, "", "evaluate.lpips=missing.onnx", None),
    "files of somebody else": (2, "", "", _write_foreign_render),
    "another run": (2, "", "", _write_foreign_run),
}


@pytest.mark.parametrize("name", CAUSES)
def test_dry_run_is_refused_like_the_run(name, tiny_scene, tmp_path):
    code, asked, setting, damage = CAUSES[name]
    scene, out = shutil.copytree(tiny_scene, tmp_path / "scene"), tmp_path / "run"
    file = tmp_path / "x.yaml"
    file.write_text(f"name: sweep\nmatrix: {{seeds: [0]}}\nscene: {{path: '{scene}'}}\n{STAGES}")
    if damage:
        damage(scene, out)
    job = experiment.Job.open(str(file), None, out, [setting] if setting else [])
    said = {}
    for what in (job.describe, job.run):
        with pytest.raises(ClsplatError) as error:
            what(asked or None)
        assert error.value.exit_code == code
        said[what.__name__] = str(error.value).partition("; the first, ")[2]
    assert said["describe"] == said["run"] != ""
