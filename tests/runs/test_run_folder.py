"""The run folder: never a folder of photographs, a user's file, or outside the given path."""

import sys
from pathlib import Path
from typing import get_args

import pytest

from clsplat import cli
from clsplat.core import files
from clsplat.core.errors import ConfigError
from clsplat.pipeline.files import shipped_pipelines
from clsplat.pipeline.loading import load
from clsplat.runs import outputs
from clsplat.runs.run_folder import Start, check_run_folder
from clsplat.runs.state import Phase, RunState
from clsplat.sweeps import experiment
from clsplat.sweeps.experiment import Job


def opened(scene: Path, out: Path, *changes: str) -> None:
    outputs.check_output_paths(load("smoke", [f"scene.path={str(scene)!r}", *changes]), RunState.read(out))


def test_photograph_folder_and_root_are_no_run_folders(tiny_scene, monkeypatch):
    for out in (tiny_scene, tiny_scene / "train" / ".."):
        with pytest.raises(ConfigError, match="is, or is inside, the folder of the photos"):
            opened(tiny_scene, out)
    monkeypatch.chdir(tiny_scene)
    with pytest.raises(ConfigError, match="is, or is inside, the folder of the photos"):
        opened(tiny_scene, Path())
    with pytest.raises(ConfigError, match="is the root of a file system"):
        opened(tiny_scene, Path(Path.cwd().anchor))
    opened(tiny_scene, tiny_scene / "runs" / "a")
    for out in (tiny_scene / "train", tiny_scene / "train" / "a" / "b"):
        with pytest.raises(ConfigError, match="is, or is inside, the folder of the photos"):
            opened(tiny_scene, out)
    photographs = tiny_scene / "train"
    with pytest.raises(ConfigError, match="is, or is inside, the folder of the photos"):
        outputs.check_output_paths(
            load("photos", [f"scene.path={str(photographs)!r}"]), RunState.read(photographs / "run")
        )


def test_link_that_leads_outside_is_not_followed(tiny_scene, tmp_path):
    for name in ("renders", "report.html", "point_cloud.ply", *files.RUN_FILES - {files.PIPELINE}):
        out = tmp_path / f"run of {name}"
        out.mkdir()
        (out / name).symlink_to(tmp_path / "elsewhere")
        for _ in ("new", "with a run"):
            with pytest.raises(ConfigError, match=f"{name}: links to a target outside of the run folder"):
                opened(tiny_scene, out)
            (out / "pipeline.yaml").touch()
        (out / name).unlink()
        (out / name).symlink_to(out / "inside")
        opened(tiny_scene, out)


def test_new_run_replaces_no_foreign_files(tiny_scene, tmp_path):
    (tmp_path / "holiday").mkdir()
    (tmp_path / "holiday" / "r_1.png").write_text("mine")
    (tmp_path / "report.html").write_text("mine")
    with pytest.raises(ConfigError, match=r"report.html: exists, and is not from a run"):
        opened(tiny_scene, tmp_path)
    with pytest.raises(ConfigError, match=r"holiday: exists, and is not from a run"):
        opened(tiny_scene, tmp_path, "render.folder=holiday", "report.file=other.html")
    for start in ("new", "resume", "restart"):
        with pytest.raises(ConfigError, match="is not from a run"):
            Job.open("smoke", tiny_scene, tmp_path, start=start).run()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["holiday", "report.html"]
    (tmp_path / "pipeline.yaml").touch()
    opened(tiny_scene, tmp_path)


def test_foreign_files_with_names_of_a_run_are_not_replaced(tiny_scene, tmp_path):
    for name in files.RUN_FILES - {files.PIPELINE, files.CHECKPOINTS, files.UNDISTORTED}:
        out = tmp_path / f"run of {name}"
        out.mkdir()
        (out / name).write_text('{"state": "mine"}')
        for start in ("new", "resume", "restart"):
            with pytest.raises(ConfigError, match=f"{name}: exists, and is not from a run"):
                Job.open("smoke", tiny_scene, out, start=start).run()
        assert [path.name for path in out.iterdir()] == [name]
        assert (out / name).read_text() == '{"state": "mine"}'


def test_foreign_files_with_names_of_a_matrix_are_not_replaced(tmp_path):
    for name in files.MATRIX_FILES - {files.PIPELINE}:
        (tmp_path / name).write_text("mine")
        with pytest.raises(ConfigError, match=f"{name}: exists, and is not from a run"):
            experiment.check_matrix_folder(RunState.read(tmp_path))
        (tmp_path / name).unlink()


def test_leftovers_of_a_refused_run_belong_to_the_run(tiny_scene, tmp_path):
    (tmp_path / "run.lock").touch()
    opened(tiny_scene, tmp_path)
    (tmp_path / "run.lock").write_text('{"process": 7}')
    opened(tiny_scene, tmp_path)
    (tmp_path / "status.json").write_text('{"state": "preparing", "process": 7}')
    (tmp_path / "log.txt").write_text("a line")
    opened(tiny_scene, tmp_path)


UNWRITABLE = {  # --out -> the exit code, and what the sentence says
    "FILE/run": (7, "cannot be written (Not a directory)"),
    "FILE": (7, "cannot be written (File exists)"),
    "x" * 300: (7, "File name too long"),
    "SCENE": (2, "is, or is inside, the folder of the photos"),
    "ROOT": (2, "is the root of a file system"),
    "not \udcff text": (0, ""),
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="names and faults of POSIX")
@pytest.mark.parametrize("out", UNWRITABLE)
def test_impossible_run_folder_is_refused_in_one_sentence(out, tiny_scene, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    place = out.replace("FILE", "file").replace("SCENE", str(tiny_scene)).replace("ROOT", "/")
    monkeypatch.chdir(tmp_path)
    quick = ["--set", "optimize.steps=2", "optimize.during=[]"]
    monkeypatch.setattr(sys, "argv", ["clsplat", "run", "smoke", "--scene", str(tiny_scene), "--out", place, *quick])
    code, words = UNWRITABLE[out]
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == code
    errors = [line for line in capsys.readouterr().err.splitlines() if "training views" not in line]
    assert len(errors) == (code != 0)
    assert words in "".join(errors)
    if code == 0:
        assert (Path(place) / "report.html").is_file()


@pytest.mark.parametrize("start", get_args(Start))
def test_run_does_not_replace_a_users_file(tiny_scene: Path, tmp_path: Path, start):
    own = tmp_path / "pipeline.yaml"
    own.write_bytes(shipped_pipelines()["smoke"].read_bytes())
    for act in (lambda job: job.describe(), lambda job: job.run()):
        with pytest.raises(ConfigError, match=r"pipeline.yaml: was not written by a run.*use another folder"):
            act(Job.open(str(own), tiny_scene, tmp_path, start=start))
    assert own.read_bytes() == shipped_pipelines()["smoke"].read_bytes()
    assert list(tmp_path.iterdir()) == [own]


@pytest.mark.parametrize("sign", ["status.json", "checkpoints/step_000004.npz", "its first line"])
def test_restart_replaces_files_of_the_run(tmp_path: Path, sign):
    (tmp_path / "pipeline.yaml").write_text("# resolved from x.yaml\n" if sign == "its first line" else "name: x\n")
    if sign != "its first line":
        (tmp_path / sign).parent.mkdir(exist_ok=True)
        (tmp_path / sign).write_bytes(b"{}")
    check_run_folder(RunState.read(tmp_path), "restart")


DONE = '{"state": "done", "process": 7}'
PHASES: dict[str, tuple[Phase, dict[str, str]]] = {
    "nothing": (Phase.EMPTY, {}),
    "a file of others": (Phase.EMPTY, {"inputs.json": "{}"}),
    "a status": (Phase.PREPARING, {"status.json": '{"state": "preparing"}'}),
    "a pipeline": (Phase.BEGUN, {"pipeline.yaml": ""}),
    "a checkpoint": (Phase.BEGUN, {"inputs.json": "{}", "checkpoints/step_000001.npz": ""}),
    "no state": (Phase.LOST_STATE, {"pipeline.yaml": "", "inputs.json": "{}"}),
    "a damaged status": (Phase.LOST_STATE, {"pipeline.yaml": "", "inputs.json": "{}", "status.json": "["}),
    "an end": (Phase.DONE, {"status.json": DONE}),
}


@pytest.mark.parametrize("name", PHASES)
def test_run_state_follows_from_its_folder(name, tmp_path):
    phase, content = PHASES[name]
    for file, text in content.items():
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text(text)
    state = RunState.read(tmp_path)
    assert state.phase is phase
    assert state.bad_files == (["checksums.json"] if phase is Phase.DONE else [])
