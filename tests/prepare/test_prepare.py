"""Prepare steps: done once, redone if their inputs change, and never left incomplete."""

import json
import shutil
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
from typer.testing import CliRunner

from clsplat import cli
from clsplat.core import lock
from clsplat.core.errors import ConfigError, DataError, OutputError
from clsplat.core.settings import Settings
from clsplat.pipeline.loading import load
from clsplat.prepare import steps as prepare_steps
from clsplat.prepare.cache import fingerprint, place_photographs, plan, prepare
from clsplat.prepare.gather import link
from clsplat.prepare.steps import Step
from clsplat.runs import opening, runner
from tests.support.refusals import refusal


class Copy(Step):
    """Write what it read, followed by its letter."""

    calls: ClassVar[list[str]] = []

    stage: Literal["copy"] = "copy"
    letter: str = "a"
    fail: bool = False

    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        self.calls.append(self.letter)
        text = "".join(sorted(path.read_text() for path in source.glob("*.txt")))
        (out / "x.txt").write_text(text + self.letter)
        if self.fail:
            raise DataError("broken")
        return {"length": len(text)}


Settings.subclasses.remove(Copy)  # not a step in other tests


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    Copy.calls.clear()
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "p.txt").write_text("p")
    return tmp_path / "photos"


def run_steps(steps: list[Step], photos: Path, root: Path) -> tuple[str, list[str]]:
    """The text of the last result, and the letters of the steps that ran."""
    Copy.calls.clear()
    folder = prepare(plan(steps, photos, root), photos, root)
    return (folder / "x.txt").read_text(), list(Copy.calls)


def test_second_preparation_does_nothing(photos, tmp_path):
    root, steps = tmp_path / "runs" / "prepared", [Copy(letter="a"), Copy(letter="b")]
    assert run_steps(steps, photos, root) == ("pab", ["a", "b"])
    assert run_steps(steps, photos, root) == ("pab", [])


def test_left_out_photographs_are_reported_again(photos, tmp_path, monkeypatch, caplog):
    figures = {"photographs": 4, "damaged": {"b.jpg": "not an image"}, "registered": 3, "not_registered": ["c.jpg"]}
    for step in (prepare_steps.FindFeatures, prepare_steps.MapCameras):
        monkeypatch.setattr(step, "make", lambda *_: figures)
        monkeypatch.setattr(step, "summary", lambda *_: "")
    steps = [prepare_steps.FindFeatures(), prepare_steps.MapCameras()]
    prepare(plan(steps, photos, tmp_path / "prepared"), photos, tmp_path / "prepared")
    caplog.clear()
    prepare(plan(steps, photos, tmp_path / "prepared"), photos, tmp_path / "prepared")
    assert "1 of 5 photos cannot be read: b.jpg (not an image)" in caplog.text
    assert "1 of 4 photos could not be registered and are not used: c.jpg" in caplog.text


def test_steps_after_a_change_are_redone(photos, tmp_path):
    root, a, b, c = tmp_path / "runs" / "prepared", Copy(letter="a"), Copy(letter="b"), Copy(letter="c")
    run_steps([a, b, c], photos, root)
    assert run_steps([a, Copy(letter="x"), c], photos, root) == ("paxc", ["x", "c"])
    assert run_steps([a, b, c], photos, root) == ("pabc", [])  # the earlier result is still there
    (photos / "q.txt").write_text("q")
    assert run_steps([a, b, c], photos, root) == ("pqabc", ["a", "b", "c"])


def test_plan_gives_reasons(photos, tmp_path):
    root, steps = tmp_path / "runs" / "prepared", [Copy(letter="a"), Copy(letter="b")]
    assert [item.reason for item in plan(steps, photos, root)] == ["no result yet"] * 2
    run_steps(steps, photos, root)
    assert [item.reason for item in plan(steps, photos, root)] == ["", ""]
    changed = plan([steps[0], Copy(letter="z")], photos, root)
    assert [item.reason for item in changed] == ["", "letter changed from b to z"]
    (photos / "p.txt").write_text("P")
    assert plan(steps, photos, root)[0].reason == "letter changed from b to a"  # the newest of that step
    assert [item.reason for item in plan(steps[1:], photos, root)] == ["its input has changed"]


def test_missing_intermediate_results_are_not_redone(photos, tmp_path):
    root, steps = tmp_path / "runs" / "prepared", [Copy(letter="a"), Copy(letter="b")]
    run_steps(steps, photos, root)
    first = plan(steps, photos, root)[0].folder
    first.rename(tmp_path / "elsewhere")
    assert run_steps(steps, photos, root) == ("pab", [])


def test_failed_step_leaves_no_files(photos, tmp_path):
    root = tmp_path / "runs" / "prepared"
    assert refusal(run_steps, [Copy(letter="a"), Copy(letter="b", fail=True)], photos, root) == "broken"
    assert [path.name.split("-")[0] for path in root.iterdir()] == ["copy"]
    assert run_steps([Copy(letter="a"), Copy(letter="b")], photos, root) == ("pab", ["b"])


def test_error_names_the_users_photographs(photos, tmp_path, monkeypatch):
    """A step after the first one has links to them."""

    def refuse(step: Step, source: Path, out: Path, without: Path) -> dict[str, Any]:
        raise DataError(f"{source / 'images' / 'p.txt'}: broken; {source / 'x.txt'} too")

    root, steps = tmp_path / "runs" / "prepared", [Copy(letter="a"), prepare_steps.MapCameras()]
    monkeypatch.setattr(prepare_steps.MapCameras, "make", refuse)
    text = refusal(prepare, plan(steps, photos, root), photos, root)
    first = plan(steps, photos, root)[0].folder
    assert text == f"{photos / 'p.txt'}: broken; {first / 'x.txt'} too"
    text = refusal(prepare, plan(steps[1:], photos, root), photos, root)
    assert text == f"{photos / 'images' / 'p.txt'}: broken; {photos / 'x.txt'} too", "the first one reads them itself"


@pytest.mark.parametrize("fault", ["no record", "no JSON", "a list", "a file less", "an empty file", "a folder"])
def test_damaged_result_is_redone(photos, tmp_path, fault, caplog):
    caplog.set_level("INFO")
    root, steps = tmp_path / "runs" / "prepared", [Copy(letter="a"), Copy(letter="b")]
    run_steps(steps, photos, root)
    last = next(item.folder for item in plan(steps, photos, root) if item.step.letter == "b")
    damaged = "record.json" if fault in ("no record", "no JSON", "a list") else "x.txt"
    (last / damaged).unlink()
    if fault == "a folder":
        (last / damaged).mkdir()
    if fault in ("no JSON", "a list", "an empty file"):
        (last / damaged).write_text({"no JSON": "{", "a list": "[]"}.get(fault, ""))
    why = {"a file less": "x.txt is missing", "an empty file": "x.txt was changed", "a folder": "x.txt is missing"}
    why = f"{why.get(fault, 'record.json is missing or damaged')}; the result is recomputed"
    assert [item.reason for item in plan(steps, photos, root)] == ["", why]
    assert plan([steps[0], Copy(letter="z")], photos, root)[1].reason.startswith("letter changed")
    assert run_steps(steps, photos, root) == ("pab", ["b"])
    assert f"copy runs again: {why}" in caplog.messages
    assert run_steps(steps, photos, root) == ("pab", [])


class Linked(Copy):
    """Leaves the images of the step before where they are, as the matches and the cameras do."""

    stage: Literal["linked"] = "linked"

    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        self.calls.append(self.letter)
        if (source / "images").exists():
            link(source / "images", out / "images")
        else:
            (out / "images").mkdir()
            link(source / "p.txt", out / "images" / "p.txt")
        return {}


Settings.subclasses.remove(Linked)


def test_result_without_its_images_is_redone(photos, tmp_path):
    root, steps = tmp_path / "runs" / "prepared", [Linked(letter="a"), Linked(letter="b")]
    prepare(plan(steps, photos, root), photos, root)
    assert [item.reason for item in plan(steps, photos, root)] == ["", ""]
    shutil.rmtree(plan(steps, photos, root)[0].folder)
    planned = plan(steps, photos, root)
    assert [item.reason for item in planned] == [
        "letter changed from b to a",
        "images/p.txt is missing; the result is recomputed",
    ]
    assert (prepare(planned, photos, root) / "images" / "p.txt").read_text() == "p"
    assert Linked.calls == ["a", "b", "a"], "the link of the second leads to images again"


def test_results_moved_with_their_photographs_are_complete(tmp_path):
    photos, root = tmp_path / "work" / "photos", tmp_path / "work" / "runs" / "prepared"
    photos.mkdir(parents=True)
    (photos / "p.txt").write_text("p")
    steps = [Linked(letter="a"), Linked(letter="b"), Linked(letter="c")]
    prepare(plan(steps, photos, root), photos, root)
    (tmp_path / "work").rename(tmp_path / "moved")
    planned = plan(steps, tmp_path / "moved" / "photos", tmp_path / "moved" / "runs" / "prepared")
    assert [item.reason for item in planned] == ["", "", ""]
    assert (planned[-1].folder / "images" / "p.txt").read_text() == "p"


def test_leftovers_of_a_killed_run_are_removed(photos, tmp_path):
    root, steps = tmp_path / "runs" / "prepared", [Copy(letter="a")]
    folder = plan(steps, photos, root)[0].folder
    left = folder.with_name(f".{folder.name}")
    left.mkdir(parents=True)
    (left / "half.txt").write_text("half")
    assert run_steps(steps, photos, root) == ("pa", ["a"])
    assert [path.name for path in root.iterdir()] == [folder.name]
    assert not (folder / "half.txt").exists()


class Slow(Copy):
    """Writes a file for each of five photographs, and goes on with those that are there."""

    resumes: ClassVar[bool] = True
    stage: Literal["slow"] = "slow"
    stop_at: ClassVar[int] = 5
    error: ClassVar[BaseException] = KeyboardInterrupt()

    def make(self, source: Path, out: Path, without: Path) -> dict[str, Any]:
        for i in range(5):
            if i == self.stop_at:
                raise self.error
            if not (out / f"{i}.txt").exists():
                self.calls.append(str(i))
                (out / f"{i}.txt").write_text(self.letter)
        return {}


Settings.subclasses.remove(Slow)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(28, "No space left on device"), RuntimeError("defect")])
def test_resumable_step_keeps_partial_results(photos, tmp_path, monkeypatch, error):
    root, steps = tmp_path / "runs" / "prepared", [Slow()]
    monkeypatch.setattr(Slow, "stop_at", 3)
    monkeypatch.setattr(Slow, "error", error)
    with pytest.raises((type(error), OutputError)):
        prepare(plan(steps, photos, root), photos, root)
    (half,) = root.iterdir()
    assert half.name[0] == "."
    (half / ".3.txt.99999999-0.partial").write_text("what a killed process was writing")
    monkeypatch.setattr(Slow, "stop_at", 5)
    folder = prepare(plan(steps, photos, root), photos, root)
    assert Slow.calls == ["0", "1", "2", "3", "4"]
    assert sorted(path.name for path in folder.iterdir()) == [*(f"{i}.txt" for i in range(5)), "record.json"]
    assert [path.name for path in root.iterdir()] == [folder.name]


def test_record_left_by_a_killed_call_is_not_part_of_the_result(photos, tmp_path):
    root, steps = tmp_path / "runs" / "prepared", [Slow()]
    folder = plan(steps, photos, root)[0].folder
    left = folder.with_name(f".{folder.name}")
    left.mkdir(parents=True)
    (left / "record.json").write_text("{}")  # killed between the record and the renaming
    prepare(plan(steps, photos, root), photos, root)
    assert [item.reason for item in plan(steps, photos, root)] == [""]


def test_partial_results_of_other_photographs_are_discarded(photos, tmp_path, monkeypatch):
    root = tmp_path / "runs" / "prepared"
    for letter, text in (("a", "p"), ("b", "p"), ("a", "q")):
        (photos / "p.txt").write_text(text)
        monkeypatch.setattr(Slow, "stop_at", 2)
        with pytest.raises(KeyboardInterrupt):
            prepare(plan([Slow(letter=letter)], photos, root), photos, root)
    assert Slow.calls == ["0", "1"] * 3


def test_step_that_refuses_its_photographs_leaves_no_files(photos, tmp_path, monkeypatch):
    root = tmp_path / "runs" / "prepared"
    monkeypatch.setattr(Slow, "stop_at", 2)
    monkeypatch.setattr(Slow, "error", DataError("broken"))
    assert refusal(prepare, plan([Slow()], photos, root), photos, root) == "broken"
    assert list(root.iterdir()) == []


def test_runs_inside_the_folder_of_photographs_do_not_count(photos, tmp_path):
    root, steps = photos / "runs" / "prepared", [Copy(letter="a")]
    before = fingerprint(photos, photos / "runs")
    run_steps(steps, photos, root)
    assert fingerprint(photos, photos / "runs") == before != fingerprint(photos, tmp_path)
    assert run_steps(steps, photos, root) == ("pa", [])


# ---- as part of a pipeline


@pytest.fixture
def pipeline(photos: Path, tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recipe whose only step makes the tiny scene, whatever the photographs."""

    def make(step: Step, source: Path, out: Path, without: Path) -> dict[str, Any]:
        shutil.copytree(tiny_scene, out, dirs_exist_ok=True)
        return {"photographs": 3, "cameras": 1}

    text = Path(load("smoke").path).read_text()
    file = tmp_path / "p.yaml"
    file.write_text(text.replace("stages:", "prepare:\n  - find_features: {long_side: 99}\nstages:", 1))
    monkeypatch.setattr(prepare_steps.FindFeatures, "make", make)
    monkeypatch.setattr(prepare_steps.FindFeatures, "check", lambda step, source, without: None)
    monkeypatch.chdir(tmp_path)
    return file


def clsplat(*words: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli.app, list(words))
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def run(pipeline: Path, photos: Path, *words: str) -> str:
    return clsplat("run", str(pipeline), "--scene", str(photos), "--set", "optimize.steps=3", *words)[1]


def test_finished_pipeline_is_up_to_date(pipeline, photos, tmp_path):
    assert "find_features  no result yet" in run(pipeline, photos, "--dry-run")
    assert not (tmp_path / "runs").exists()
    run(pipeline, photos)
    model = (tmp_path / "runs" / "smoke" / "point_cloud.ply").stat().st_mtime_ns
    assert "up to date" in run(pipeline, photos, "--dry-run")
    assert "up to date" in run(pipeline, photos)
    assert (tmp_path / "runs" / "smoke" / "point_cloud.ply").stat().st_mtime_ns == model
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["prepared", "smoke"]
    (tmp_path / "runs" / "smoke" / "point_cloud.ply").unlink()
    run(pipeline, photos)
    assert (tmp_path / "runs" / "smoke" / "point_cloud.ply").exists(), "made again, in its place"
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["prepared", "smoke"]


def test_changed_setting_is_another_run(pipeline, photos, tmp_path):
    run(pipeline, photos)
    assert "find_features  done" in run(pipeline, photos, "--dry-run", "--set", "optimize.log_every=2")
    run(pipeline, photos, "--set", "optimize.log_every=2")
    assert (tmp_path / "runs" / "smoke-2" / "metrics.json").is_file()
    text = run(pipeline, photos, "--dry-run", "--set", "find_features.long_side=50")
    assert "long_side changed from 99 to 50" in text
    (photos / "p.txt").write_text("other")
    assert "its input has changed" in run(pipeline, photos, "--dry-run")


def test_run_does_not_resume_with_other_photographs(pipeline, photos, tmp_path):
    checked = load(str(pipeline), [f"scene.path='{photos}'", "optimize.steps=3"])
    out = tmp_path / "runs" / "a"
    runner.execute(checked, opening.open_run(checked, out, None), "new", lambda progress: None)
    (photos / "p.txt").write_text("other")
    with pytest.raises(ConfigError, match="other photos"):
        opening.open_run(checked, out, None)


def test_concurrent_processes_prepare_a_result_once(pipeline, photos, tmp_path):
    checked = load(str(pipeline), [f"scene.path='{photos}'", "optimize.steps=3"])
    (first,) = checked.preparation(tmp_path / "runs" / "a")
    other = load(str(pipeline), [f"scene.path='{photos}'", "optimize.steps=3", "find_features.long_side=50"])
    first.folder.parent.mkdir(parents=True)
    with lock.lock_folder(first.folder, first.folder.with_name(f".{first.folder.name}.lock")):
        with pytest.raises(OutputError, match=f"{first.folder.name}: is in use by this process"):
            opening.open_run(checked, tmp_path / "runs" / "a", None)
        opening.open_run(other, tmp_path / "runs" / "c", None)  # another result
    opening.open_run(checked, tmp_path / "runs" / "a", None)
    with lock.lock_folder(
        first.folder, first.folder.with_name(f".{first.folder.name}.lock")
    ):  # where all is there, nobody waits
        opening.open_run(checked, tmp_path / "runs" / "b", None)
    assert not list(first.folder.parent.glob(".*")), "no lock is left"


def test_runs_of_different_photographs_prepare_concurrently(pipeline, photos, tmp_path, monkeypatch):
    """One starts while the other is in the middle of its step."""
    (tmp_path / "others").mkdir()
    (tmp_path / "others" / "p.txt").write_text("others")
    make = prepare_steps.FindFeatures.make

    def begins_another(step: Step, source: Path, out: Path, without: Path) -> dict[str, Any]:
        if source.name == "photos":
            prepared("others")
        return make(step, source, out, without)

    def prepared(name: str) -> None:
        checked = load(str(pipeline), [f"scene.path='{tmp_path / name}'", "optimize.steps=3"])
        opening.open_run(checked, tmp_path / "runs" / name, None)

    monkeypatch.setattr(prepare_steps.FindFeatures, "make", begins_another)
    prepared("photos")
    assert len(list((tmp_path / "runs" / "prepared").glob("find_features-*/record.json"))) == 2


def test_restarted_run_may_have_other_photographs(pipeline, photos, tmp_path):
    words = ["run", str(pipeline), "--scene", str(photos), "--set", "optimize.steps=3", "--out", "runs/a"]
    assert clsplat(*words)[0] == 0
    (photos / "p.txt").write_text("other")
    assert "find_features  its input has changed" in clsplat(*words, "--restart", "--dry-run")[1]
    assert clsplat(*words, "--restart")[0] == 0


def test_folder_with_cameras_is_not_a_folder_of_photographs(tiny_scene, tmp_path):
    step = prepare_steps.FindFeatures()
    message = refusal(prepare, plan([step], tiny_scene, tmp_path / "r" / "p"), tiny_scene, tmp_path / "r" / "p")
    assert "already contains cameras" in message
    assert not list((tmp_path / "r" / "p").iterdir())


def test_scene_with_cameras_is_used_unprepared(pipeline, tiny_scene, tmp_path):
    """Its run folder is that of a pipeline without `prepare`, and goes on as such a one."""
    words = ["run", str(pipeline), "--scene", str(tiny_scene), "--set", "optimize.steps=3", "--out", "runs/a"]
    code, told = clsplat(*words, "--dry-run")
    assert code == 0
    assert f"{tiny_scene} has cameras; skipped: find_features\n" in told
    assert clsplat(*words)[0] == 0
    folder = tmp_path / "runs" / "a"
    assert f"# {tiny_scene} has cameras; skipped: find_features" in (folder / "pipeline.yaml").read_text()
    assert not (tmp_path / "runs" / "prepared").exists()
    assert clsplat("check", "runs/a")[0] == 0
    assert clsplat("resume", "runs/a", "--steps", "5")[0] == 0
    assert json.loads((folder / "metrics.json").read_text())["steps"] == 5


def test_note_of_a_run_names_its_photographs(pipeline, photos, tmp_path):
    run(pipeline, photos)
    note = json.loads((tmp_path / "runs" / "smoke" / "prepared.json").read_text())
    assert (Path(note["folder"]) / "transforms_train.json").is_file()


# ---- without a pipeline


@pytest.fixture
def recorded_steps(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The steps from photographs to cameras, replaced by ones that only write files and note that they ran."""
    ran: list[str] = []

    def make(step: Step, source: Path, out: Path, without: Path) -> dict[str, Any]:
        ran.append(step.stage)
        (out / "images").mkdir()
        if isinstance(step, prepare_steps.MapCameras):
            if step.mapper == "global":
                raise DataError("broken")
            (out / "sparse" / "0").mkdir(parents=True)
            (out / "sparse" / "0" / "cameras.bin").write_text(str(len(ran)))
        return {"photographs": 5, "cameras": 1, "pairs": 10, "registered": 5, "not_registered": [], "error_px": 0.5}

    for step in (prepare_steps.FindFeatures, prepare_steps.MatchFeatures, prepare_steps.MapCameras):
        monkeypatch.setattr(step, "make", make)
    return ran


def test_placing_resumes_from_a_stopped_run(photos, tmp_path, recorded_steps):
    out = tmp_path / "out"
    assert refusal(place_photographs, photos, out, 1600, "SIMPLE_RADIAL", "auto", "global") == "broken"
    assert not (out / "sparse").exists()
    assert place_photographs(photos, out) == 5
    assert recorded_steps == ["find_features", "match_features", "map_cameras", "map_cameras"]
    assert (out / "sparse" / "0" / "cameras.bin").read_text() == "4"
    assert (out / "images").is_dir()


def test_placing_does_not_resume_with_other_settings(photos, tmp_path, recorded_steps):
    out = tmp_path / "out"
    place_photographs(photos, out)
    assert "already contains a model" in refusal(place_photographs, photos, out)
    shutil.rmtree(out / "sparse")
    recorded_steps.clear()
    assert place_photographs(photos, out, matching="sequential") == 5
    assert recorded_steps == ["match_features", "map_cameras"]


def test_concurrent_placing_in_a_folder_is_refused(photos, tmp_path, recorded_steps, monkeypatch):
    make, refused = prepare_steps.MatchFeatures.make, []

    def begins_another(step: Step, source: Path, out: Path, without: Path) -> dict[str, Any]:
        with pytest.raises(OutputError) as error:
            place_photographs(photos, tmp_path / "out")
        refused.append(str(error.value))
        return make(step, source, out, without)

    monkeypatch.setattr(prepare_steps.MatchFeatures, "make", begins_another)
    assert place_photographs(photos, tmp_path / "out") == 5
    assert [message.partition(";")[0] for message in refused] == [f"{tmp_path / 'out'}: is in use by this process"]
    assert recorded_steps == ["find_features", "match_features", "map_cameras"]
    assert not (tmp_path / "out" / ".steps" / "run.lock").exists()


def test_user_images_are_not_overwritten(photos, tmp_path, recorded_steps):
    (tmp_path / "out" / "images").mkdir(parents=True)
    assert "already contains `images`" in refusal(place_photographs, photos, tmp_path / "out")
    assert recorded_steps == []
