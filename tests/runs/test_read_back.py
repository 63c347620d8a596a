"""Output names are reserved, and outputs are read back at the end: a changed file is a failure."""

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest

from clsplat.core import files as names
from clsplat.core.errors import InternalError, OutputError
from clsplat.core.settings import rebuild_models
from clsplat.gaussians.model import Model
from clsplat.pipeline.loading import load
from clsplat.runs import opening, outputs, runner
from clsplat.stages.render import image_paths
from clsplat.stages.report import HtmlReport
from clsplat.sweeps.experiment import Job
from clsplat.training.run import Run
from clsplat.training.stage import Stage
from clsplat.training.status import read_status

pytestmark = pytest.mark.slow

SETTINGS = ["optimize.steps=3", "optimize.during=[{stage: export, every: 2, file: early.ply}]"]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def change_a_value(path: Path) -> None:
    """Change a byte of the last Gaussian: the file still has its header and its size."""
    data = bytearray(path.read_bytes())
    data[-2] ^= 1
    path.write_bytes(data)


DAMAGE: dict[str, tuple[str, Callable[[Path], None]]] = {
    "the report is missing": ("report.html", Path.unlink),
    "the metrics are missing": ("metrics.json", Path.unlink),
    "the model is missing": ("point_cloud.ply", Path.unlink),
    "a value of the model is another": ("point_cloud.ply", change_a_value),
    "a model made during the training is missing": ("early.ply", Path.unlink),
    "a value of a model made during the training is another": ("early.ply", change_a_value),
}


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Run]:
    out = tmp_path_factory.mktemp("outputs") / "run"
    checked = load("smoke", [f"scene.path='{tiny_scene}'", *SETTINGS])
    run = opening.open_run(checked, out, None)
    runner.execute(checked, run, "new", lambda progress: None)
    return checked, run


@pytest.mark.slow
def test_files_of_a_run_have_reserved_names(finished):
    pipeline, run = finished
    chosen = {path for stage in pipeline.stages for path in stage.outputs(run.out)}
    made = {path.name for path in run.out.iterdir()} - {path.relative_to(run.out).parts[0] for path in chosen}
    assert {"status.json", "metrics.jsonl", "checksums.json"} <= made
    assert made <= names.RESERVED_NAMES


def test_run_file_names_are_listed_and_reserved():
    table = {value for name, value in vars(names).items() if name.isupper() and isinstance(value, str)}
    table -= {names.SYSTEM, names.MODULE_FILE_PREFIX, names.STORE}  # the last is a key, too
    assert {"pipeline.yaml", "run.lock", "compare.html", "undistorted"} < table <= names.RESERVED_NAMES
    faults = []
    for file in Path(names.__file__).parents[1].rglob("*.py"):
        if file.parent.name in ("api", "cli") or file == Path(names.__file__):  # of a page that is no run's
            continue
        text = file.read_text()
        nodes = ast.walk(ast.parse(text)) if any(name in text for name in table) else ()
        texts = {node.value for node in nodes if isinstance(node, ast.Constant)}
        faults += [f"{file}: {text!r}" for text in texts & table]
    assert not faults, "\n".join(faults)


def test_views_that_differ_in_suffix_get_separate_renders():
    names = ["a.jpg", "a.png", "b/a.jpg", "c.jpg", "d"]
    files = [path.as_posix() for path in image_paths(Path("r"), names)]
    assert files == ["r/a.jpg.png", "r/a.png.png", "r/b/a.png", "r/c.png", "r/d.png"]


@pytest.mark.parametrize("name", DAMAGE)
def test_unreadable_output_is_a_failure(name, finished):
    pipeline, run = finished
    place, damage = DAMAGE[name]
    file = run.out / place
    before = file.read_bytes()
    try:
        damage(file)
        with pytest.raises(OutputError, match=f"{file.name}: is missing, or changed .*; see .*log.txt"):
            outputs.check_outputs(pipeline, run)
    finally:
        file.write_bytes(before)
    outputs.check_outputs(pipeline, run)


@pytest.mark.parametrize("damage", [Path.unlink, change_a_value])
def test_model_damaged_after_a_kill_is_detected_or_rewritten(damage, tiny_scene, tmp_path, monkeypatch):
    out, few = tmp_path / "run", [*SETTINGS, "init.count=50"]

    def fail(*arguments):
        raise ZeroDivisionError

    with monkeypatch.context() as patch:
        patch.setattr(HtmlReport, "run", fail)
        with pytest.raises(InternalError):
            Job.open("smoke", tiny_scene, out, few).run()
    whole = {name: (out / name).read_bytes() for name in ("early.ply", "point_cloud.ply")}
    damage(out / "early.ply")  # its model has been trained further
    with pytest.raises(OutputError, match=r"early\.ply: is missing, or changed"):
        Job.resume(out).run()
    assert not (out / names.CHECKSUMS).exists()
    (out / "early.ply").write_bytes(whole["early.ply"])
    damage(out / "point_cloud.ply")
    Job.resume(out).run()
    assert {name: (out / name).read_bytes() for name in whole} == whole


def test_model_of_a_cadence_not_reached_is_not_expected(finished):
    _, run = finished
    late = load("smoke", [*SETTINGS[:1], SETTINGS[1].replace("every: 2, file: early", "every: 4, file: late")])
    outputs.check_outputs(late, run)


def test_checksums_include_models_made_during_training(finished):
    _, run = finished
    assert '"early.ply"' in (run.out / names.CHECKSUMS).read_text()


def test_later_stage_that_damages_the_model_is_an_error(tiny_scene, tmp_path, without_plugins):
    class Spoil(Stage):
        """Changes the file of another stage."""

        stage: Literal["spoil"] = "spoil"

        def run(self, run: Run) -> None:
            change_a_value(run.out / "point_cloud.ply")

    rebuild_models()
    file = tmp_path / "pipeline.yaml"
    file.write_text(
        "name: spoilt\nstages: [{init: {count: 50, source: random}}, {optimize: {steps: 1, losses: [l1]}}, "
        "export, spoil]\n"
    )
    with pytest.raises(OutputError, match=r"point_cloud\.ply: is missing, or changed"):
        Job.open(str(file), tiny_scene, tmp_path / "run").run()
    assert read_status(tmp_path / "run")["exit_code"] == OutputError.exit_code


def test_truncated_write_is_detected_at_once(tiny_scene, tmp_path, monkeypatch):
    save = Model.save

    def saved_and_cut(model: Model, path: Path, *more: Any) -> Any:
        result = save(model, path, *more)
        truncate(Path(path))
        return result

    monkeypatch.setattr(Model, "save", saved_and_cut)
    with pytest.raises(OutputError, match=r"early\.ply: .*truncated.*just written"):
        Job.open("smoke", tiny_scene, tmp_path / "run", SETTINGS).run()
