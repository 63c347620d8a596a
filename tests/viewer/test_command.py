"""The stage, the command, and the function write the same pages, and errors are one line."""

import json
import re
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

import clsplat
from clsplat.cli import app
from clsplat.core.errors import ConfigError, OutputError
from clsplat.core.progress import listening
from clsplat.pipeline.files import shipped_pipelines
from clsplat.pipeline.loading import load
from clsplat.runs.video import model_names
from clsplat.scene.detect import read_scene
from clsplat.stages.render import Viewer
from clsplat.viewer import page as module
from tests.support.commands import ran
from tests.support.html_page import Page

pytestmark = pytest.mark.slow
SHORT = {"optimize.steps": 20}


@pytest.fixture(scope="module")
def run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return clsplat.run("smoke", tiny_scene, tmp_path_factory.mktemp("viewer") / "run", set=SHORT)


def command(*arguments: str | Path) -> str:
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_run_writes_a_viewer_and_its_report_links_to_it(run):
    viewer, report = ((run / name).read_text() for name in ("viewer.html", "report.html"))
    assert Page(viewer).elements["canvas"] == 2
    assert viewer.count('"split":"test"') == 2
    assert viewer.count('"split":"train"') == 8
    assert viewer.count('"photograph":null') == 8, "training views have a thumbnail alone"
    assert '<a class="viewer" href="viewer.html">' in report
    assert Page(report).elements["a"] == 2, "the viewer and the model"


def test_too_many_splats_for_smooth_display_get_advice(run, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("clsplat.runs.video.MANY_SPLATS", 10)
    heard = []
    with listening(lambda *what, seconds_left: heard.append(what)):
        clsplat.view(run, out=tmp_path / "a.html")
    assert "browsers show only 10 smoothly; --splats 10 keeps" in caplog.text
    assert heard == [("models read", i, 1) for i in (0, 1)] + [("models packed", i, 1) for i in (0, 1)]
    caplog.clear()
    clsplat.view(run, out=tmp_path / "a.html", splats=10)
    assert "smoothly" not in caplog.text


def test_titles_name_the_given_folder(run, tiny_scene, tmp_path, monkeypatch):
    """Not that of the prepared photographs, whose name is a hash."""
    prepared = shutil.copytree(tiny_scene, tmp_path / "undistort-f22e16004ac0")
    copy = shutil.copytree(run, tmp_path / "castle_run")
    (copy / "prepared.json").write_text(json.dumps({"inputs": "f22e", "folder": str(prepared)}))
    assert f"<title>castle_run · {tiny_scene.name}</title>" in clsplat.view(copy, out=tmp_path / "a.html").read_text()
    given = clsplat.view(copy, scene=prepared, out=tmp_path / "b.html").read_text()
    assert f"<title>castle_run · {prepared.name}</title>" in given, "what is given is what is named"
    monkeypatch.setattr("clsplat.runs.opening.read_scene", lambda folder, holdout: read_scene(prepared, holdout))
    out = clsplat.run("smoke", tiny_scene, tmp_path / "run", set=SHORT)
    assert f"<title>smoke · {tiny_scene.name}</title>" in (out / "viewer.html").read_text()
    assert f"<title>{tiny_scene.name}</title>" in (out / "report.html").read_text()


def test_report_links_files_of_one_name_in_several_folders(tiny_scene, tmp_path):
    steps = [stage for stage in load("smoke").resolved_settings()["stages"] if "render" not in stage]
    at = next(i for i, stage in enumerate(steps) if "export" in stage)
    steps[at : at + 1] = [{"export": {"file": f"{folder}/model.ply"}} for folder in ("a", "b")]
    (tmp_path / "two.yaml").write_text(json.dumps({"name": "two", "stages": steps}))
    report = (clsplat.run(tmp_path / "two.yaml", tiny_scene, tmp_path / "run", set=SHORT) / "report.html").read_text()
    assert re.findall(r'<a href="([^"]*)">([^<]*)</a>', report) == [
        (f"{at}/model.ply", f"{at}/model.ply") for at in "ab"
    ]


def test_stage_and_command_write_the_same_page(run, tmp_path):
    """But for the name and the digits of a PLY that is read."""
    command("view", run, "--out", tmp_path / "a.html")
    sizes = [len(text.read_text()) for text in (run / "viewer.html", tmp_path / "a.html")]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.01)


def test_every_shipped_pipeline_ends_with_a_viewer_and_a_report():
    for name in shipped_pipelines().keys() - {"blocks_coarse"}:  # a model to cut, which is not for looking at
        checked = load(name)
        if "train_field" in checked.names:  # a field has no splats
            assert checked.names[-1] == "report"
            continue
        assert checked.names[-2:] == ["viewer", "report"], name
        assert isinstance(checked.stages[-2], Viewer)


def test_stage_does_not_change_the_model(run, tiny_scene, tmp_path):
    text = Path(load("smoke").path).read_text().replace("  - viewer: {file: viewer.html, photographs: test}\n", "")
    (tmp_path / "plain.yaml").write_text(text)
    plain = clsplat.run(tmp_path / "plain.yaml", tiny_scene, tmp_path / "plain", set=SHORT)
    assert not (plain / "viewer.html").exists()
    assert 'class="viewer"' not in (plain / "report.html").read_text()
    assert (plain / "point_cloud.ply").read_bytes() == (run / "point_cloud.ply").read_bytes()


def test_link_is_relative_from_another_folder(tiny_scene, tmp_path):
    places = {**SHORT, "viewer.file": "pages/my scene.html", "report.file": "more/report.html"}
    out = clsplat.run("smoke", tiny_scene, tmp_path / "run", set=places)
    (address,) = re.findall(r'<a class="viewer" href="([^"]*)"', (out / "more" / "report.html").read_text())
    assert address == "../pages/my%20scene.html"
    assert (out / "pages" / "my scene.html").is_file()


def test_run_with_too_many_splats_shows_the_most_important(tiny_scene, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(module, "MAX_SIZE", 0.25)
    monkeypatch.setattr("clsplat.stages.render.MAX_SIZE", 0.25)
    out = clsplat.run("smoke", tiny_scene, tmp_path / "run", set={**SHORT, "init.count": 8000})
    assert (out / "viewer.html").stat().st_size < 250_000
    assert any("most important splats of" in record.message for record in caplog.records)


def test_command_and_the_function_write_the_same_bytes(run, tiny_scene, tmp_path):
    pairs = [
        ([run], {}),
        ([Path(shutil.copy(run / "point_cloud.ply", tmp_path))], {}),
        ([run / "point_cloud.ply"], {"scene": tiny_scene, "photographs": "all"}),
        ([run], {"photographs": "none", "splats": 500}),
        ([run, run / "point_cloud.ply"], {}),
    ]
    for i, (models, options) in enumerate(pairs):
        a, b = tmp_path / f"a{i}.html", tmp_path / f"b{i}.html"
        given = [part for name, value in options.items() for part in (f"--{name}", value)]
        assert f"{a}: 0." in command("view", *models, "--out", a, *given)
        assert clsplat.view(*models, out=b, **options) == b
        assert a.read_bytes() == b.read_bytes()
    lengths = [len((tmp_path / f"a{i}.html").read_bytes()) for i in range(5)]
    assert len(set(lengths)) == 5
    assert (tmp_path / "a1.html").read_text().count('"split":') == 0, "a file alone has no views"
    assert (tmp_path / "a2.html").read_text().count('"photograph":null') == 0


def test_replacing_a_page_is_logged(run, tmp_path):
    words = ["view", run, "--out", tmp_path / "a.html"]
    assert "replaced" not in command(*words)
    assert "a.html: replaced; 0." in command(*words)


def test_models_of_different_scenes_are_reported(run, tiny_scene, tmp_path):
    other, same = (shutil.copytree(run, tmp_path / name) for name in ("other", "same"))
    text = (other / "pipeline.yaml").read_text()
    (other / "pipeline.yaml").write_text(text.replace(str(tiny_scene), str(tmp_path / "kitchen")))
    for_all = ["--out", tmp_path / "a.html"]
    done = CliRunner().invoke(app, [str(word) for word in ("view", run, other, *for_all)])
    warning = (
        f"run shows {tiny_scene}, other shows {tmp_path / 'kitchen'}; the page has the cameras of {tiny_scene.name}"
    )
    assert warning in done.output.replace("\n", ""), done.output
    for models in ([run, same], [run]):
        assert "both stand" not in CliRunner().invoke(app, [str(word) for word in ("view", *models, *for_all)]).output


def test_page_replaces_no_other_file_of_a_run(run, tmp_path):
    copy = shutil.copytree(run, tmp_path / "copy")
    before = (copy / "report.html").read_bytes()
    with pytest.raises(ConfigError, match=r"report\.html: is a file of a run; use another name"):
        clsplat.view(copy, out=copy / "report.html")
    assert (copy / "report.html").read_bytes() == before
    for name in ("viewer.html", "new.html", "new.html"):
        clsplat.view(copy, out=copy / name, photographs="none")
    assert (copy / "viewer.html").read_bytes() != (run / "viewer.html").read_bytes()


def test_assumed_up_direction_is_reported(run, tmp_path):
    for_all = ["--out", tmp_path / "a.html"]
    assert "up is -y; add --scene" in command("view", shutil.copy(run / "point_cloud.ply", tmp_path), *for_all)
    assert "-y" not in command("view", run, *for_all)


def test_no_device_is_opened(run, tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.opencl.device.Device.__init__", lambda *_: pytest.fail("opens a device"))
    clsplat.view(run, out=tmp_path / "a.html")


def test_models_of_one_name_are_named_by_folder(tmp_path):
    for name in ("a/run", "b/run", "other"):
        (tmp_path / name).mkdir(parents=True)
    assert model_names([tmp_path / "a" / "run", tmp_path / "other"]) == ["run", "other"]
    assert model_names([tmp_path / "a" / "run", tmp_path / "b" / "run"]) == ["a/run", "b/run"]
    assert model_names([tmp_path / "x" / "point_cloud.ply", tmp_path / "y" / "point_cloud.ply"]) == [
        "x/point_cloud",
        "y/point_cloud",
    ]
    assert (
        model_names([tmp_path / "other", tmp_path / "other"])[0]
        != model_names([tmp_path / "other", tmp_path / "other"])[1]
    )


def test_help_describes_what_is_shown():
    assert "Model files or run folders" in command("view", "--help")


def test_errors_are_one_line(run, tmp_path):
    for arguments, code in (
        (["view", run, run, run], 2),
        (["view", run, "--out", tmp_path / "page.txt"], 2),
        (["view", tmp_path / "none.ply"], 3),
        (["view", run, "--scene", tmp_path / "nowhere"], 3),
    ):
        done = ran(*arguments)
        assert (done.returncode, done.stderr.count("error: ")) == (code, 1)


def test_errors_of_the_function(run, tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match="one model or two, got 0"):
        clsplat.view()
    with pytest.raises(ConfigError, match="--photographs: expected none, test, or all, got 'some'"):
        clsplat.view(run, out=tmp_path / "a.html", photographs="some")
    for budget in (float("inf"), float("nan"), -1.0):
        with pytest.raises(ConfigError, match=rf"--photograph-budget {budget:g}: expected a finite number of MB"):
            clsplat.view(run, out=tmp_path / "a.html", photograph_budget=budget)
    alone = shutil.copy(run / "point_cloud.ply", tmp_path)
    with pytest.raises(ConfigError, match="--photographs all needs the photos of a scene; add --scene"):
        clsplat.view(alone, out=tmp_path / "a.html", photographs="all")
    Path(alone).unlink()
    monkeypatch.setattr(module, "MAX_SIZE", 0.15)
    with pytest.raises(OutputError, match=r"browsers open at most .*; show only the [\d,]+ most important splats"):
        clsplat.view(run, out=tmp_path / "a.html")
    assert list(tmp_path.iterdir()) == []
