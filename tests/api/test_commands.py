"""Commands and API functions write equal bytes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import clsplat
from clsplat.cli import app
from clsplat.core import terminal
from clsplat.core.errors import ConfigError, DataError
from tests.support.commands import process

pytestmark = pytest.mark.slow

SET = {"optimize.steps": 12, "seed": 3}
SETS = [part for place, value in SET.items() for part in ("--set", f"{place}={value}")]


@pytest.fixture(scope="module")
def runs(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same run by the command and by the function."""
    folder = tmp_path_factory.mktemp("both")
    process("run", "smoke", "--scene", tiny_scene, "--out", folder / "command", *SETS)
    assert clsplat.run("smoke", tiny_scene, folder / "function", set=SET) == folder / "function"
    return folder / "command", folder / "function"


def command(*arguments: str | Path) -> str:
    """What a command prints on stdout, in this process."""
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def without_times(text: bytes | str) -> str:
    text = text if isinstance(text, str) else text.decode()
    return re.sub(r'"(train_seconds|cpu_seconds|ms)": [\d.e-]+|"(stages|seconds)": \{[^}]*\}', "", text)


def test_run_function_writes_the_files_of_the_command(runs):
    by_command, by_function = map(contents, runs)
    assert by_command.keys() == by_function.keys()
    exact = [name for name in by_command if name.endswith((".ply", ".png", "pipeline.yaml"))]
    assert len(exact) == 4
    for name in exact:
        assert by_command[name] == by_function[name], name
    for name in ("metrics.json", "metrics.jsonl"):
        assert without_times(by_command[name]) == without_times(by_function[name])


def test_function_logs_what_the_command_logs(runs):
    logs = [(folder / "log.txt").read_text() for folder in runs]
    lines = [re.findall(r"^\S+ \S+ \w+ (?!checking)(\w+)", log, re.MULTILINE) for log in logs]  # devices: once only
    assert lines[0] == lines[1]
    assert {"device", "scene", "step"} <= set(lines[1])


def test_run_restores_the_log_level(tmp_path):
    log = terminal.LOG
    before = log.level
    try:
        log.setLevel("ERROR")
        with terminal.logging_to(tmp_path / "log.txt"):
            log.debug("fine points")
        assert log.getEffectiveLevel() == 40
    finally:
        log.setLevel(before)
    assert (tmp_path / "log.txt").read_text().endswith("DEBUG fine points\n")


def test_resume_and_dry_run(runs, tiny_scene, tmp_path):
    assert clsplat.resume(runs[1]) == runs[1]
    assert contents(runs[1])["point_cloud.ply"] == contents(runs[0])["point_cloud.ply"]
    text = clsplat.describe_run("smoke", tiny_scene, tmp_path / "new", set=SET)
    shown = command("run", "smoke", "--scene", tiny_scene, "--out", tmp_path / "new", *SETS, "--dry-run")
    times = re.compile(r"\d[\d.]* (ms|min|to)\b")  # measured each time
    told, printed = ([times.sub("", line) for line in item.splitlines()] for item in (text, shown))
    assert printed[-len(told) :] == told
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("kind", ["png", "npy"])
def test_render_function_writes_the_files_of_the_command(runs, tmp_path, kind):
    command("render", runs[0], "--out", tmp_path / "command", "--format", kind, "--scale", 2)
    assert clsplat.render_views(runs[0], out=tmp_path / "function", format=kind, downscale=2) == 2
    assert sorted(contents(tmp_path / "command")) == [".renders.json", *(f"test/r_00{i}.{kind}" for i in (0, 1))]
    assert contents(tmp_path / "command") == contents(tmp_path / "function")


def test_rendered_files_match_the_renderer(runs, tiny_scene, tmp_path):
    clsplat.render_views(runs[0], out=tmp_path, format="npy")
    renderer = clsplat.Renderer(clsplat.load(runs[0]))
    for view in clsplat.read_scene(tiny_scene).split("test"):
        np.testing.assert_array_equal(np.load(tmp_path / f"{view.name}.npy"), renderer.render(view).image)


def test_functions_return_what_commands_print_as_json(runs, tiny_scene):
    pairs = {
        f"evaluate {runs[0]} --json --downscales 1,2": lambda: clsplat.evaluate(runs[0], downscales=[1, 2]),
        f"evaluate {runs[0]}/point_cloud.ply --json --scene {tiny_scene}": lambda: clsplat.evaluate(
            runs[0] / "point_cloud.ply", tiny_scene
        ),
        f"inspect {tiny_scene} --json": lambda: clsplat.inspect_scene(tiny_scene).data(),
        f"status {runs[0]} --json": lambda: clsplat.status(runs[0]),
        "check smoke --json": lambda: {**clsplat.check("smoke"), "valid": True},
        "check --schema": clsplat.pipeline_schema,
        "status --schema": clsplat.status_schema,
        "pipelines --json": clsplat.pipelines,
        "pipelines splat --json": lambda: clsplat.pipelines("splat"),
        "devices --json": clsplat.devices,
    }
    for arguments, function in pairs.items():
        assert command(*arguments.split()) == json.dumps(function(), indent=1) + "\n", arguments


def test_functions_write_the_pages_of_the_commands(runs, tiny_scene, tmp_path):
    command("compare", *runs, "--out", tmp_path / "a.html")
    assert clsplat.compare_runs(runs, tmp_path / "b.html") == 2
    command("inspect", tiny_scene, "--html", tmp_path / "c.html")
    assert clsplat.inspect_scene(tiny_scene, tmp_path / "d.html").is_trainable
    for one, other in ("ab", "cd"):
        assert (tmp_path / f"{one}.html").read_bytes() == (tmp_path / f"{other}.html").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"format": "jpg"}, "^format: expected one of png, npy, got 'jpg'$"),
        ({"split": "bogus"}, "^split: expected one of train, test, all, got 'bogus'$"),
    ],
)
def test_views_of_other_kinds_and_splits_are_refused(runs, tmp_path, arguments, message):
    with pytest.raises(ConfigError, match=message):
        clsplat.render_views(runs[0], out=tmp_path / "out", **arguments)
    assert not (tmp_path / "out").exists()


def test_comparison_without_runs_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"^no runs to compare; pass at least one run folder$"):
        clsplat.compare_runs([], tmp_path / "c.html")
    assert not (tmp_path / "c.html").exists()


def test_function_and_command_copy_the_same_pipeline(tmp_path):
    command("pipelines", "smoke", "--copy", tmp_path / "a.yaml")
    assert clsplat.copy_pipeline("smoke", tmp_path / "b.yaml") == tmp_path / "b.yaml"
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()


def test_speed_measurement_is_read_back_from_json(runs, tiny_scene, tmp_path):
    model = {"model": runs[0] / "point_cloud.ply", "scene": tiny_scene}
    measurement = clsplat.measure_speed([], **model, pipeline="smoke", repeats=1)
    (tmp_path / "bench.json").write_text(json.dumps(measurement.data()))
    assert clsplat.read_measurement(tmp_path / "bench.json", "smoke").keys() == measurement.data().keys()
    assert "point_cloud" in measurement.text({})


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: clsplat.run("smokee"), ConfigError, "no pipeline named 'smokee'; did you mean 'smoke'?"),
        (lambda: clsplat.describe_run("smoke", set={"optimze.steps": 3}), ConfigError, "optimze"),
        (lambda: clsplat.resume("nowhere"), DataError, "nowhere: has no pipeline.yaml"),
        (lambda: clsplat.status("nowhere"), DataError, "nowhere: has no readable status.json"),
        (lambda: clsplat.load("nowhere.ply"), DataError, "nowhere.ply: cannot be read"),
        (lambda: clsplat.evaluate("x.ply"), DataError, "x.ply: not found; expected a model file"),
        (lambda: clsplat.load_plugin("nowhere.py"), ConfigError, "no such file"),
    ],
)
def test_functions_raise_the_errors_of_the_commands(call, error, message):
    with pytest.raises(error) as raised:
        call()
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_render_of_size_zero_is_refused(few_steps, tmp_path):
    with pytest.raises(DataError, match="expected a downscale of at least 1"):
        clsplat.render_views(few_steps, out=tmp_path / "out", downscale=0)
