"""Usability of the command line: help, completion, suggestions, option order, and pure JSON on stdout."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import ANY

import pytest

from clsplat.cli.app import ORDER, SYNONYMS
from clsplat.core.errors import DataError
from clsplat.core.resources import full_version
from clsplat.pipeline.files import shipped_pipelines
from clsplat.pipeline.loading import load
from clsplat.pipeline.overrides import list_keys
from clsplat.pipeline.recipes import copy, manual, summaries, summary
from clsplat.runs.state import RunState
from clsplat.runs.status import format_status, run_status
from clsplat.training.records import Records
from tests.support.commands import clsplat, process
from tests.support.runs import train, write_status

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("command_line") / "run"
    train(tiny_scene, out, "scene.downscale=2")
    return out


def test_version_option_prints_the_full_version():
    assert clsplat("--version").stdout == f"clsplat {full_version()}\n"


def test_missing_command_prints_help_and_an_error():
    done = clsplat(expect=2)
    assert "Usage: clsplat" in done.stdout
    assert "error: expected a command" in done.stderr
    assert "error: clsplat data: expected a command" in clsplat("data", expect=2).stderr


def test_help_fits_a_terminal_of_80_columns_and_shows_examples(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    faults = []
    for command in ORDER[:-1]:
        lines = clsplat(command, "--help").stdout.splitlines()
        if max(map(len, lines)) > 80:
            faults.append(f"{command}: {max(map(len, lines))} columns")
        _, _, examples = "\n".join(lines).partition("Examples:")
        shown = [line.strip() for line in examples.splitlines() if line.strip()]
        if not shown or not all(line.startswith(f"clsplat {command}") for line in shown):
            faults.append(f"{command}: no examples, or one wraps")
    assert not faults, "\n".join(faults)


def test_help_lists_every_kind_of_scene():
    texts = {name: " ".join(clsplat(name, "--help").stdout.replace("│", " ").split()) for name in ("run", "inspect")}
    assert all("COLMAP, Blender, nerfstudio" in text for text in texts.values())
    assert "for `photos`, a folder of photos" in texts["run"]


def test_completion_knows_commands_and_pipelines_without_opencl():
    def completed(words: str, number: int) -> list[str]:
        variables = {"_CLSPLAT_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(number)}
        command = [sys.executable, "-m", "clsplat"]
        done = subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True, timeout=60)
        return done.stdout.split()

    assert completed("clsplat pi", 1) == ["pipelines"]
    assert completed("clsplat run splat_7", 2) == ["splat_7k"]
    assert "synthetic" in completed("clsplat data s", 2)
    assert "--show-completion" in clsplat("--help").stdout
    heavy = """if True:
        import sys
        from clsplat.cli import main
        sys.argv[1:] = ["run", "--help"]
        try:
            main()
        finally:
            print([name for name in ("pyopencl", "numpy", "cv2") if name in sys.modules])
    """
    assert subprocess.run([sys.executable, "-c", heavy], capture_output=True, text=True).stdout.endswith("\n[]\n")


NEAR = {
    "train": "no command 'train'; did you mean 'run'?",
    "rendr": "no command 'rendr'; did you mean 'render'?",
    "synthetic": "no command 'synthetic'; did you mean 'data synthetic'?",
    "xyzzy": "no command 'xyzzy'; `clsplat --help` lists the commands",
    "run smoke --scen x": "clsplat run: no option --scen; did you mean --scene?",
    "run smoke --xyzzy": "clsplat run: no option --xyzzy; see `clsplat run --help`",
    "run": "clsplat run: missing argument 'PIPELINE'; see `clsplat run --help`",
    "--devise x run": "clsplat: no option --devise; did you mean --device?",
    "render x --split tset": "invalid value for '--split'",
    "check lodout": "no pipeline named 'lodout', and no such file or folder; `clsplat pipelines` lists pipelines",
    "run smoke --scene x --set steps=3": "--set steps=3: no key 'steps' at the top level of a pipeline; did you mean",
    "resume nowhere": "nowhere: has no pipeline.yaml; expected the folder of a started run",
    "status nowhere": "nowhere: has no readable status.json; expected a run folder",
    "pipelines --copy x": "--copy needs the name of a pipeline",
    "evaluate x.ply": "x.ply: not found; expected a model file or a run folder",
    "evaluate x.ply --scene y --downscales nan": "expected factors of at least 1, got nan",
}


@pytest.mark.parametrize("arguments", NEAR)
def test_misspelled_names_get_suggestions(arguments):
    code = 3 if arguments.startswith(("resume", "status")) or arguments == "evaluate x.ply" else 2
    assert NEAR[arguments] in clsplat(*arguments.split(), expect=code).stderr


def test_synonyms_map_to_existing_commands():
    assert not SYNONYMS.keys() & set(ORDER)
    assert {name for name in SYNONYMS.values() if name[0] != "-"} <= set(ORDER)


def test_device_option_works_before_and_after_the_command(finished):
    wrong = "no device matches 'no such chip'"
    assert wrong in clsplat("--device", "no such chip", "evaluate", finished, expect=4).stderr
    assert wrong in clsplat("evaluate", finished, "--device", "no such chip", expect=4).stderr
    clsplat("--device", "no such chip", "check", "smoke")
    name = json.loads(clsplat("devices", "--json").stdout)[0]["platform"]
    clsplat("--device", "no such chip", "evaluate", finished, "--device", name)
    assert "no device matches 'x:²'" in clsplat("--device", "x:²", "evaluate", finished, expect=4).stderr


JSON = ["check smoke --json", "check --schema", "pipelines --json", "pipelines splat --json", "status RUN --json",
        "inspect SCENE --json", "pipelines smoke --copy FILE --json", "evaluate RUN --json",
        "bench --scenes , --model RUN/point_cloud.ply --scene SCENE --repeats 1 --json"]  # fmt: skip


@pytest.mark.parametrize(
    ("run", "arguments"),
    [
        *((clsplat, line) for line in JSON),
        (process, "evaluate RUN/point_cloud.ply --scene SCENE --json"),
    ],  # runtimes print too
)
def test_stdout_holds_only_json(run, arguments, finished, tiny_scene, tmp_path):
    places = {"RUN": str(finished), "SCENE": str(tiny_scene), "FILE": str(tmp_path / "x.yaml")}
    for name, place in places.items():
        arguments = arguments.replace(name, place)
    assert json.loads(run(*arguments.split()).stdout)


def test_pipelines_lists_every_recipe_on_a_line():
    lines = clsplat("pipelines").stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(shipped_pipelines())
    assert all(line.endswith(".") for line in lines)
    assert summary(shipped_pipelines()["splat"]).endswith("the constants of the 2023 release.")
    assert summary(shipped_pipelines()["splat_7k"]).endswith("in 7,000 steps: a good scene in minutes.")


def test_pipelines_prints_keys_in_set_notation():
    lines = clsplat("pipelines", "splat_7k").stdout.splitlines()
    keys = [line.split("  ")[0] for line in lines[lines.index("Keys, as for --set:") + 1 :]]
    assert keys == [key.text for key in list_keys(load("splat_7k").settings)]
    assert {"optimize.steps=7000", "optimize.losses.0.weight=0.8", "densify.every=100"} <= set(keys)
    actual = manual("splat_7k")
    assert next(key for key in actual["keys"] if key["key_path"] == "optimize.steps") == {
        "key_path": "optimize.steps",
        "value": 7000,
        "description": ANY,
    }
    assert actual["stages"][:2] == ["init", "optimize"]


def test_copy_of_a_pipeline_never_replaces_a_file(tmp_path):
    clsplat("pipelines", "smoke", "--copy", tmp_path / "mine.yaml")
    assert (tmp_path / "mine.yaml").read_text() == shipped_pipelines()["smoke"].read_text()
    (tmp_path / "mine.yaml").write_text("mine")
    refused = clsplat("pipelines", "splat", "--copy", tmp_path / "mine.yaml", expect=2)
    assert "mine.yaml: exists; choose another name" in refused.stderr
    assert (tmp_path / "mine.yaml").read_text() == "mine"
    assert copy("smoke", tmp_path) == tmp_path / "smoke.yaml"


def test_run_folder_is_a_model_with_its_scene(finished, tiny_scene, tmp_path):
    measured = json.loads(clsplat("evaluate", finished, "--json").stdout)
    assert measured["test"]["2"] == json.loads((finished / "metrics.json").read_text())["test"]["2"]
    assert list(measured["test"]) == ["2"], "the run's own downscale"
    clsplat("render", finished, "--out", tmp_path / "renders")
    own = {path.name: path.read_bytes() for path in (finished / "renders").rglob("*.png")}
    assert {path.name: path.read_bytes() for path in (tmp_path / "renders").rglob("*.png")} == own
    again = json.loads(clsplat("evaluate", finished, "--scene", tiny_scene, "--downscales", "1", "--json").stdout)
    assert list(again["test"]) == ["1"]
    table = clsplat("evaluate", finished).stdout.splitlines()[-3:]
    assert table[0].split()[:4] == ["split", "size", "psnr", "ssim"]
    assert table[1].split()[:2] == ["test", "1/2"]


def test_run_folder_without_model_is_explained(finished, tmp_path):
    assert "expected a model file or a run folder" in clsplat("evaluate", tmp_path, expect=3).stderr
    (tmp_path / "a.JPG").touch()
    for command in ("evaluate", "view"):
        said = clsplat(command, tmp_path, expect=3).stderr
        assert f"to train a model on its photos, run `clsplat run photos --scene {tmp_path}` first" in said
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    text = (run / "pipeline.yaml").read_text()
    (run / "pipeline.yaml").write_text(text.replace(str(load(str(run / "pipeline.yaml")).settings.scene.path), "gone"))
    missing = clsplat("render", run, expect=3).stderr
    assert "the folder of its photos, gone, is missing; pass the folder of the scene" in missing
    (run / "point_cloud.ply").unlink()
    assert (
        f"has no point_cloud.ply; finish the run with `clsplat resume {run}`" in clsplat("render", run, expect=3).stderr
    )


def test_resume_gives_the_same_bits(finished, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    newest = max((run / "checkpoints").iterdir())
    for name in ("point_cloud.ply", "metrics.json", f"checkpoints/{newest.name}"):
        (run / name).unlink()
    done = clsplat("resume", run)
    assert "resumed at step 40" in done.stdout
    assert (run / "point_cloud.ply").read_bytes() == (finished / "point_cloud.ply").read_bytes()
    assert "saved with other settings" in clsplat("resume", run, "--set", "seed=9", expect=2).stderr


def test_plugin_option_works_after_the_command(tmp_path, without_plugins):
    plugin = Path(__file__).parents[2] / "examples" / "opacity_entropy.py"
    assert plugin.is_file()
    for option in (["--plugin", str(tmp_path / "x.py")], [f"--plugin={tmp_path / 'x.py'}"]):
        before = clsplat(*option, "check", "smoke", expect=2).stderr
        assert "x.py" in before
        assert clsplat("check", "smoke", *option, expect=2).stderr == before
        assert clsplat("check", *option, "smoke", "--plugin", str(plugin), expect=2).stderr == before
    assert clsplat("check", "smoke", "--plugin", str(plugin)).returncode == 0
    assert "--plugin" in clsplat("check", "smoke", "--plugin", expect=2).stderr


@pytest.mark.parametrize("text", ["[1]", '{"test": 5}', '{"test": {"1": 5}}', "{"])
def test_status_refuses_damaged_metrics(text, tmp_path):
    write_status(tmp_path, state="done", step=7)
    (tmp_path / "metrics.json").write_text(text)
    with pytest.raises(DataError, match=r"metrics.json: .*the file is damaged: run the pipeline again"):
        run_status(RunState.read(tmp_path))


@pytest.mark.parametrize("line", ["null", '{"step": null}', '{"step": 3}', '{"step": "3", "kind": "train"}'])
def test_damaged_records_are_reported_with_their_line(line, tmp_path, caplog):
    (tmp_path / "metrics.jsonl").write_text('{"step": 5, "kind": "train"}\n' + line + "\n")
    write_status(tmp_path, state="done", step=7)
    fault = r"metrics.jsonl:2: damaged; .*'step' and 'kind'; remove this line"
    with pytest.raises(DataError, match=fault):
        Records(tmp_path).read()
    status = run_status(RunState.read(tmp_path))
    assert (status["state"], status["step"], status["last"]) == ("done", 7, None), "the state is told all the same"
    assert re.search(fault, caplog.text)


def test_status_reads_only_files(finished, tmp_path):
    text = clsplat("status", finished).stdout
    assert f"{finished}: done at step 50\n" in text
    assert "test 1/2: psnr " in text
    data = json.loads(clsplat("status", finished, "--json").stdout)
    assert (data["state"], data["step"], data["exit_code"]) == ("done", 50, 0)
    assert data["metrics"] == json.loads((finished / "metrics.json").read_text())
    assert data["last"]["step"] == 50
    (tmp_path / "pipeline.yaml").write_text("")
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    write_status(tmp_path, state="running", step=7, steps=9, process=gone.pid)
    (tmp_path / "metrics.jsonl").write_text('{"step": 5, "kind": "train", "loss": 0.25, "psnr": 20.0}\ncut')
    assert format_status(run_status(RunState.read(tmp_path))) == (
        f"{tmp_path}: killed at step 7 of 9\n"
        f"  no checkpoint was saved; `clsplat resume {tmp_path}` starts it over\n"
        "  last report: step 5, loss 0.25, psnr 20"
    )
    matrix = {"state": "failed", "cells": 4, "done": 4, "failed": {"a": "no"}, "message": "1 of 4 cells failed"}
    write_status(tmp_path, **matrix)
    assert "failed, 4 of 4 cells, 1 of them failed\n  1 of 4 cells failed\n" in format_status(
        run_status(RunState.read(tmp_path))
    )


def test_recipe_descriptions_are_unique():
    described = [item["summary"] for item in summaries()]
    assert len(set(described)) == len(described)
    assert all("7,000 steps" in item["summary"] for item in summaries() if item["name"].endswith("_7k"))
