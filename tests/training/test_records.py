"""metrics.jsonl: a resumed run has the same lines as an uninterrupted one, each once."""

import json
from pathlib import Path

import pytest

from clsplat.core.errors import DataError, Interrupted
from clsplat.metrics import views
from clsplat.pipeline.loading import load
from clsplat.runs import opening, runner
from clsplat.training.records import Records
from tests.support.runs import records, train

pytestmark = pytest.mark.slow

FEW = ("optimize.steps=6", "init.count=60", "optimize.log_every=3", "checkpoint.every=2", "optimize.evaluate.every=4")
FEW += ("optimize.evaluate.downscales=[1, 2]", "evaluate.downscales=[1, 2]")
FEW += ("densify.every=4", "densify.start=3", "reset_opacity.every=100")


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "few"
    train(tiny_scene, out, *FEW)
    assert len([line for line in records(out) if line["kind"] == "evaluate"]) == 4
    return out


@pytest.mark.parametrize("rendered", [3, 7], ids=["during", "after"])  # of two views: at 1/2, after 1/1 was measured
@pytest.mark.parametrize("way", ["stopped", "failed"])
def test_interrupted_evaluate_leaves_no_duplicate_line(way, rendered, finished, tiny_scene, tmp_path, monkeypatch):
    checked = load("smoke", [f"scene.path='{tiny_scene}'", *FEW])
    run = opening.open_run(checked, tmp_path / "run", None)
    render, count = views.render_floats, []

    def counted(*arguments):
        count.append(1)
        if len(count) == rendered and way == "stopped":
            run.interrupted = True
        elif len(count) == rendered:
            raise DataError("cut")
        return render(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(views, "render_floats", counted)
        with pytest.raises(Interrupted if way == "stopped" else DataError):
            runner.execute(checked, run, "new", lambda progress: None)
    saved = sorted(path.name for path in (tmp_path / "run" / "checkpoints").iterdir())
    assert saved[-1] == ("step_000004.npz" if rendered == 3 else "step_000006.npz")
    train(tiny_scene, tmp_path / "run", *FEW, resume=True)
    assert records(tmp_path / "run") == records(finished)


@pytest.mark.parametrize(("damage", "left"), [("missing", 0), ("cut", 2), ("changed", 1)])
def test_unreadable_lines_are_reported(damage, left, tmp_path, caplog):
    records = Records(tmp_path)
    lines = [json.dumps({"step": step, "kind": "train"}) + "\n" for step in range(5)]
    text = {"missing": "", "cut": "".join(lines[:2]), "changed": lines[0] + "x" + "".join(lines[1:])}[damage]
    records.path.write_text(text)
    records.line_count = 4
    with caplog.at_level("WARNING"):
        records.start()
    assert f"{left} of 4 lines can be read" in caplog.text
    assert records.read() == [json.loads(line) for line in lines[:left]]
    assert records.line_count == left


def test_lines_of_plugins_without_the_fields_are_left_out(tmp_path):
    kept = Records(tmp_path)
    kept.add(1, "evaluate", split="test", downscale=1, psnr=20.0)
    kept.add(2, "evaluate", score=3.0)
    kept.add(2, "evaluate", split="test", downscale=1, psnr="high")
    kept.add(2, "theirs", score=3.0)
    kept.write()
    assert [line["step"] for line in kept.read("evaluate")] == [1]
    assert len(kept.read("theirs")) == 1
    assert len(kept.read()) == 4
