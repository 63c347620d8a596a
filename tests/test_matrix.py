"""Files with `matrix:`: what they expand to, what is refused, and how their cells run."""

import json
import logging
import re
import shutil
from pathlib import Path

import pytest

from clsplat.errors import ClsplatError, ConfigError, DataError, InternalError, Interrupted, NumericError
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import Experiment, load_experiment
from clsplat.pipeline.schema import json_schema
from clsplat.runs import experiment, runner
from tests.test_cli import clsplat

pytestmark = pytest.mark.slow

STAGES = """\
stages:
  - init: {count: 300}
  - optimize:
      steps: 4
      losses: [{type: l1}]
      log_every: 2
      during:
        - checkpoint: {every: 2}
  - evaluate
  - export
  - render
"""
OWN = """\
name: sweep
matrix:
  seeds: [0, 1]
  set:
    optimize.steps: [4, 6]
    init.opacity: [0.1]
"""
SMALL = OWN + STAGES


@pytest.fixture
def write(tmp_path):
    def write(text: str, name: str = "x.yaml") -> str:
        path = tmp_path / name
        path.write_text(text)
        return str(path)

    return write


def names(found: Experiment | None) -> list[str]:
    assert found is not None
    return [cell.name for cell in found.cells]


def test_cells_of_a_file_with_stages(write):
    found = load_experiment(write(SMALL))
    assert names(found) == [
        "steps=4-opacity=0.1-seed=0",
        "steps=4-opacity=0.1-seed=1",
        "steps=6-opacity=0.1-seed=0",
        "steps=6-opacity=0.1-seed=1",
    ]
    settings = [cell.pipeline.settings for cell in found.cells]
    assert [(s.stages[1].steps, s.seed) for s in settings] == [(4, 0), (4, 1), (6, 0), (6, 1)]
    assert all(s.name == "sweep" for s in settings)


def test_cells_of_pipelines_and_scenes(write, tmp_path):
    other = write("name: other\n" + STAGES, "other.yaml")
    scenes = [str(tmp_path / "a" / "images"), str(tmp_path / "b" / "images")]
    found = load_experiment(
        write(f"name: both\nmatrix:\n  pipelines: [smoke, {other}]\n  scenes: {json.dumps(scenes)}\n")
    )
    assert names(found) == ["smoke-a-images", "smoke-b-images", "other-a-images", "other-b-images"]
    assert [cell.pipeline.settings.scene.path for cell in found.cells] == scenes * 2
    assert [cell.pipeline.settings.name for cell in found.cells] == ["smoke", "smoke", "other", "other"]


def test_cells_do_not_see_each_others_values(write):
    """Values inside nested lists and dicts of the file are not shared."""
    text = (
        "name: s\nmatrix: {set: {optimize.losses.0.weight: [0.1, 0.2], optimize.rates.quats: [0.5, 0.25]}}\n" + STAGES
    )
    text = text.replace("      log_every: 2\n", "      log_every: 2\n      rates: {quats: 0.125}\n")
    optimizes = [cell.pipeline.settings.stages[1] for cell in load_experiment(write(text)).cells]
    assert [(o.losses[0].weight, o.rates.quats) for o in optimizes] == [
        (0.1, 0.5),
        (0.1, 0.25),
        (0.2, 0.5),
        (0.2, 0.25),
    ]


def test_short_keys_are_told_apart(write):
    text = (
        "name: s\nmatrix: {set: {optimize.checkpoint.every: [2], optimize.log_every: [2], init.count: [9]}}\n" + STAGES
    )
    assert names(load_experiment(write(text))) == ["every=2-log_every=2-count=9"]
    text = "name: s\nmatrix: {set: {optimize.checkpoint.keep: [1], checkpoint.keep: [2]}}\n" + STAGES
    assert names(load_experiment(write(text))) == ["optimize.checkpoint.keep=1-checkpoint.keep=2".replace(".", "-")]


def test_values_that_are_lists_or_text(write):
    text = "name: s\nmatrix: {set: {evaluate.downscales: [[1], [1, 2]], init.source: [auto, random]}}\n" + STAGES
    found = load_experiment(write(text))
    assert names(found)[:2] == ["downscales=1-source=auto", "downscales=1-source=random"]
    assert names(found)[3] == "downscales=1+2-source=random"
    assert found.cells[3].pipeline.settings.stages[2].downscales == [1, 2]


def test_options_reach_every_cell(write):
    found = load_experiment(write(SMALL), ["optimize.log_every=3", "scene.downscale=2"])
    assert {cell.pipeline.settings.stages[1].log_every for cell in found.cells} == {3}
    assert {cell.pipeline.settings.scene.downscale for cell in found.cells} == {2}


def test_files_without_a_matrix_are_pipelines(write):
    assert load_experiment("smoke") is None
    assert load_experiment(write("- a\n")) is None


REFUSED = {
    "misspelt axis": (SMALL.replace("seeds:", "seds:"), r"x.yaml:3: matrix.seds: unknown key 'seds'; did you mean"),
    "no axis": ("name: s\nmatrix: {}\n" + STAGES, r"x.yaml:2: matrix: expected one of pipelines, scenes, seeds"),
    "empty axis": ("name: s\nmatrix: {set: {init.count: []}}\n" + STAGES, r"init.count: expected a list of at least 1"),
    "not a list": (SMALL.replace("[4, 6]", "4"), r"x.yaml:5: matrix.set.optimize.steps: expected a list, got 4"),
    "text for a seed": (SMALL.replace("[0, 1]", "[0, one]"), r"matrix.seeds\[1\]: expected a whole number, got 'one'"),
    "misspelt setting": (
        SMALL.replace("optimize.steps", "optimize.stps"),
        r"x.yaml:5: matrix.set.optimize.stps\[0\]: unknown key 'stps'; did you mean 'steps'",
    ),
    "misspelt stage": (
        SMALL.replace("optimize.steps", "optimise.steps"),
        r"x.yaml:5: matrix.set.optimise.steps\[0\]: no 'optimise' in this pipeline; did you mean optimize",
    ),
    "wrong value": (
        SMALL.replace("[4, 6]", "[4, 30k]"),
        r"x.yaml:5: matrix.set.optimize.steps\[1\]: .*expected a whole number, got '30k'",
    ),
    "twice": (SMALL.replace("[4, 6]", "[4, 4]"), r"x.yaml:2: matrix: the same value twice in \[4, 4\]"),
    "unknown pipeline": (
        "name: s\nmatrix:\n  pipelines: [smoke,\n    smokee]\n",
        r"x.yaml:4: matrix.pipelines\[1\]: no pipeline named 'smokee'; did you mean 'smoke'",
    ),
    "pipelines and stages": ("name: s\nmatrix: {pipelines: [smoke]}\n" + STAGES, r"x.yaml:3: stages: unknown key"),
    "no stages": (OWN, r"'stages' is missing"),
    "no name": ("matrix: {seeds: [1]}\n" + STAGES, r"'name' is missing"),
    "too many": (SMALL.replace("[0, 1]", str(list(range(600)))), r"x.yaml: the matrix has 1200 cells"),
    "base is wrong": (SMALL.replace("count: 300", "cuont: 300"), r"x.yaml:8: stages\[0\].init.cuont: unknown key"),
    "matrix is text": ("name: s\nmatrix: all\n" + STAGES, r"x.yaml:2: matrix: "),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(case, write):
    text, words = REFUSED[case]
    with pytest.raises(ConfigError, match=words) as error:
        load_experiment(write(text))
    assert "\n" not in str(error.value)


def test_an_option_cannot_contradict_the_matrix(write):
    with pytest.raises(ConfigError, match=r"the matrix lists values of optimize\.steps"):
        load_experiment(write(SMALL), ["optimize.steps=3"])


def test_the_same_name_twice_is_refused(write, tmp_path):
    (tmp_path / "sub").mkdir()
    paths = [write("name: p\n" + STAGES, "p.yaml"), write("name: p\n" + STAGES, "sub/p.yaml")]
    with pytest.raises(ConfigError, match="two cells of the matrix would be named 'p'"):
        load_experiment(write(f"name: s\nmatrix: {{pipelines: {json.dumps(paths)}}}\n"))


def test_schema_knows_the_matrix():
    schema = json_schema()
    assert set(schema["$defs"]["Matrix"]["properties"]) == {"pipelines", "scenes", "seeds", "set"}
    assert schema["properties"]["matrix"] == {"$ref": "#/$defs/Matrix"}
    assert "stages" not in schema["required"]


@pytest.fixture(scope="module")
def finished(tiny_scene, tmp_path_factory) -> tuple[str, Path]:
    """The file of a matrix that was run, and its folder."""
    folder = tmp_path_factory.mktemp("matrix")
    (folder / "x.yaml").write_text(
        f"name: sweep\nscene: {{path: '{tiny_scene}'}}\n" + SMALL.removeprefix("name: sweep\n")
    )
    found = load_experiment(str(folder / "x.yaml"))
    assert found is not None
    logging.getLogger("clsplat").setLevel(logging.INFO)
    experiment.run_matrix(found, folder / "run", None, "new")
    return str(folder / "x.yaml"), folder / "run"


def test_every_cell_is_a_run_of_its_own(finished):
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


def test_the_folder_of_a_matrix_stands_for_its_cells(finished, tmp_path):
    clsplat("compare", finished[1], "--out", tmp_path / "c.html")
    assert "sweep: 4 runs" in (tmp_path / "c.html").read_text()
    (tmp_path / "empty").mkdir()
    shutil.copy(finished[1] / "pipeline.yaml", tmp_path / "empty")
    done = clsplat("compare", tmp_path / "empty", "--out", tmp_path / "d.html", expect=3)
    assert "no cell of this matrix has finished" in done.stderr


def test_resume_runs_what_is_missing_only(finished, tmp_path):
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


def test_a_cell_that_fails_does_not_stop_the_others(finished, tmp_path, monkeypatch):
    execute = runner.execute

    def failing(pipeline, run, start, show):
        if pipeline.settings.stages[1].steps == 4:
            raise NumericError("the loss is nan") if run.seed == 0 else DataError("no photograph")
        execute(pipeline, run, start, show)

    monkeypatch.setattr(runner, "execute", failing)
    with pytest.raises(ClsplatError, match=r"2 of 4 cells failed; the first, steps=4-.*: the loss is nan") as error:
        experiment.run_matrix(load_experiment(finished[0]), tmp_path / "run", None, "new")
    assert error.value.exit_code == NumericError.exit_code
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    assert (status["state"], status["exit_code"], status["done"]) == ("failed", 6, 4)
    assert status["message"] == str(error.value)
    assert len(status["failed"]) == 2
    page = (tmp_path / "run" / "compare.html").read_text()
    assert "sweep: 2 runs" in page
    assert "steps=4-opacity=0.1-seed=1 failed and is not shown: no photograph" in page


def test_a_matrix_ends_in_a_status_whatever_happens(finished, tmp_path, monkeypatch):
    def broken(*arguments):
        raise AssertionError

    monkeypatch.setattr(experiment, "write_comparison", broken)
    shutil.copytree(finished[1], tmp_path / "run")
    with pytest.raises(InternalError, match=r"a defect\): AssertionError; run with --debug") as error:
        experiment.run_matrix(load_experiment(finished[0]), tmp_path / "run", None, "resume")
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    assert (status["state"], status["exit_code"], status["message"]) == ("failed", 1, str(error.value))


def test_an_interrupt_stops_the_whole(finished, tmp_path, monkeypatch):
    cells = []

    def interrupted(pipeline, run, start, show):
        cells.append(run.out)
        raise Interrupted("stopped at step 2")

    monkeypatch.setattr(runner, "execute", interrupted)
    with pytest.raises(Interrupted):
        experiment.run_matrix(load_experiment(finished[0]), tmp_path / "run", None, "new")
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "interrupted"
    assert len(cells) == 1
    assert not cells[0].exists(), "it had not begun"
    assert not (tmp_path / "run" / "compare.html").exists()


def test_cells_run_with_other_settings_are_not_taken_for_done(finished, write, tmp_path):
    shutil.copytree(finished[1], tmp_path / "run")
    changed = write(Path(finished[0]).read_text().replace("count: 300", "count: 301"))
    with pytest.raises(ClsplatError, match=r"4 of 4 cells failed.*stages\[0\].init.count was 300, is 301") as error:
        experiment.run_matrix(load_experiment(changed), tmp_path / "run", None, "resume")
    assert error.value.exit_code == 2


def test_folders_are_not_mixed(finished, tiny_scene, tmp_path):
    with pytest.raises(ConfigError, match="already holds a run"):
        experiment.run_matrix(load_experiment(finished[0]), finished[1], None, "new")
    (tmp_path / "pipeline.yaml").write_text("name: single\nstages: []\n")
    with pytest.raises(ConfigError, match="holds a single run"):
        experiment.run_matrix(load_experiment(finished[0]), tmp_path, None, "resume")


def test_check_and_dry_run_list_the_cells(finished, tmp_path):
    done = clsplat("check", finished[0])
    assert "x.yaml: valid; 4 cells: steps=4" in done.stdout
    assert json.loads(clsplat("check", finished[0], "--json").stdout)["cells"] == names(load_experiment(finished[0]))
    done = clsplat("run", finished[0], "--out", tmp_path / "new", "--dry-run")
    assert "would run 4 cells" in done.stdout
    assert re.findall(r"^  (\S+)$", done.stdout, re.MULTILINE) == names(load_experiment(finished[0]))
    assert not (tmp_path / "new").exists()
    assert "already holds a run" in clsplat("run", finished[0], "--out", finished[1], "--dry-run", expect=2).stderr
    done = clsplat("run", finished[0], "--out", finished[1], "--resume", "--dry-run")
    assert done.stdout.count("  done") == 4
