"""Messages are one line of limited length, with shortened input values."""

import re
import shlex
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import clsplat
import clsplat.data_tools
from clsplat import cli
from clsplat.core.errors import (
    MESSAGE_LIMIT,
    QUOTE_LIMIT,
    DataError,
    OverrideError,
    one_line,
    pluralize,
    quote,
    shell_quote,
    shorten,
)
from tests.support.commands import process

VALUES = [
    "x" * 10**6,
    b"x" * 10**6,
    [1] * 10**6,
    {"k" * 1000: ["v" * 1000]},
    {i: i for i in range(10**5)},
    1 << 100_000,
    "a\nb",
    [[[[[[[[1]]]]]]]],
]


@pytest.mark.parametrize("value", VALUES, ids=[type(value).__name__ for value in VALUES])
def test_value_in_a_message_is_one_short_line(value):
    assert 1 <= len(quote(value)) <= QUOTE_LIMIT
    assert "\n" not in quote(value)


def test_pluralize_keeps_the_singular_for_one():
    assert [pluralize(count, "view") for count in (0, 1, 2000)] == ["0 views", "1 view", "2,000 views"]


def test_short_value_in_a_message_is_not_cut():
    for value in (3, -0.5, "a b", None, True, ["a", 1], {"b": 1, "a": {"c": [2]}}, (1.0, 2.0), float("inf")):
        assert quote(value) == repr(value)


def test_recursive_list_can_be_shown():
    endless: list[object] = []
    endless.append(endless)
    assert len(quote(endless)) <= QUOTE_LIMIT


def test_text_is_cut_in_the_middle_to_the_limit():
    assert shorten("a" * 50 + "b" * 50, 21) == "a" * 9 + " … " + "b" * 9
    assert shorten("a" * 80) == "a" * 80


def test_message_is_one_line_without_control_characters():
    error = DataError("\x1b[31mred\x1b[0m\n\udcff \x00\u202e" + "x" * 5000)
    line = one_line(error)
    assert line.startswith(r"\x1b[31mred\x1b[0m \udcff \x00\u202exx")
    assert line.isprintable()
    assert len(line) == MESSAGE_LIMIT
    assert len(one_line(DataError("\0" * 5000))) <= MESSAGE_LIMIT


def test_long_override_is_cut():
    assert len(str(OverrideError("k" * 5000, "r" * 5000))) < 600
    assert str(OverrideError("a\n=\r1", "b\nc")) == "--set a = 1: b c"


@pytest.mark.slow
def test_plugin_that_exits_is_a_plugin_error(tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "quits.py").write_text(
        "import sys\n"
        "from clsplat.scene import Reader\n"
        "class Quits(Reader):\n"
        "    name = expects = 'quits'\n"
        "    def matches(self, path): return True\n"
        "    def read(self, path, holdout): sys.exit(0)\n"
    )
    done = process("--plugin", tmp_path / "quits.py", "inspect", tmp_path / "scene", expect=2)
    assert f"{tmp_path / 'quits.py'}:6: SystemExit: 0" in done.stderr


UNEXPECTED = [
    (RecursionError("maximum recursion depth exceeded"), 1),
    (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates not allowed"), 1),
    (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid start byte"), 1),
    (ValueError("Exceeds the limit (4300 digits) for integer string conversion"), 1),
    (EOFError(), 1),
    (SystemExit(0), 1),
    (SystemExit("a\nb"), 1),
    (GeneratorExit(), 1),
    (AssertionError("x" * 5000), 1),
    (MemoryError(), 5),
    (OSError(5, "Input/output error", "/x/y"), 7),
]


@pytest.mark.parametrize(
    ("raised", "in_thread"),
    [(raised, i % 2 == 1) for i, raised in enumerate(UNEXPECTED)],
    ids=[type(error).__name__ for error, _ in UNEXPECTED],
)
def test_every_exception_is_one_line_with_a_code(raised, in_thread, monkeypatch, capsys):
    error, code = raised

    def fail(*_: object) -> None:
        raise error

    def in_another_thread(*_: object) -> None:
        with ThreadPoolExecutor(1) as pool:
            pool.submit(fail).result()

    monkeypatch.setattr("clsplat.api.tools.devices", in_another_thread if in_thread else fail)
    monkeypatch.setattr(sys, "argv", ["clsplat", "devices"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == code
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert len(line) <= MESSAGE_LIMIT + len("error: ")
    assert ("run with --debug" in line) == (code == 1)


NO_PATHS = {"suggest_rate(run, broken)", "2 * state.stage_step", "2 * metrics['steps']", "pipeline"}


def test_path_in_a_command_is_one_shell_word():
    assert shell_quote("runs/a-1.b_2") == "runs/a-1.b_2", "no quotes where none are needed"
    for name in ("my ü/a 'b' $c", "(x)", "a;b"):
        assert shlex.split(f"clsplat resume {shell_quote(Path(name))} --steps 2") == [
            "clsplat",
            "resume",
            name,
            "--steps",
            "2",
        ]


def test_paths_in_suggested_commands_are_quoted():
    packages = [Path(package.__file__).parent for package in (clsplat, clsplat.data_tools)]
    sources = "".join(path.read_text() for folder in packages for path in folder.rglob("*.py"))
    commands = re.findall(r"`clsplat [^`\n]*`", sources)
    places = {place for command in commands for place in re.findall(r"\{([^{}]*)\}", command)}
    assert len(places) > 8
    assert {place for place in places if not place.startswith("shell_quote(")} <= NO_PATHS
