"""Files that are not settings or not YAML: one sentence with file and line, and nothing is executed."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml.composer import Composer

from clsplat.core.errors import ConfigError
from clsplat.core.resources import resource_dir
from clsplat.pipeline.loading import load
from clsplat.pipeline.yaml_file import parse_value, read_yaml

REFUSED = {  # text: (line, words)
    "name: !!python/object/apply:os.system ['x']\nstages: []\n": (
        1,
        "the tag !!python/object/apply:os.system is not allowed",
    ),
    "name: x\nstages: !!python/tuple []\n": (2, "the tag !!python/tuple is not allowed"),
    "--- !mine\nname: x\n": (1, "the tag !mine is not allowed"),
    "name: x\nseed: !!float x\n": (2, "'x' cannot be read as float"),
    "name: x\nseed: !!binary aGk=\n": (2, "the tag !!binary is not allowed"),
    "name: x\nseed: " + "9" * 5000: (2, "cannot be read as int"),
    "name: x\nseed: 0x" + "f" * 5000: (2, "is too large; expected a whole number of at most 64 bits"),
    "name: x\nseed: 9223372036854775808": (2, "is too large"),
    "name: x\nseed: !" + "t" * 5000 + " 3": (2, "is not allowed"),
    "name: x\n" + "k" * 900 + ": 1\n" + "k" * 900 + ": 2": (3, "duplicate key"),
    "name: x\nseed: *" + "a" * 5000: (2, "undefined alias"),
    "name: x\n? [a, b]\n: 1\n": (2, "expected text as a key"),
    "name: x\n1: 2\n": (2, "expected text as a key"),
    "name: x\n~: 2\n": (2, "expected text as a key"),
    "name: x\nseed: 1\nseed: 2\n": (3, "duplicate key 'seed'"),
    "name: &a [*a]\n": (1, "nested too deeply"),
    "name: &a {<<: *a}\n": (1, "nested too deeply"),
    "name: x\n<<: 3\n": (2, "expected a map after '<<'"),
    "name: x\n--- \nname: y\n": (2, "another document"),
    "name: x\nseed: \0\n": (2, "U+0000 is not allowed"),
    "name: x\nseed: " + "[" * 60 + "]" * 60: (2, "nested too deeply"),
    "name: x\nstages: [" + "1," * 20_001 + "]": (2, "more than 20000 values"),
    "[" * 5000: (1, "nested too deeply"),
    "name: 'x\nseed: 3": (2, "unexpected end"),
    "name: x\n\tseed: 3": (2, "cannot start any token"),
}


@pytest.mark.parametrize("text", REFUSED, ids=[text[:30] for text in REFUSED])
def test_non_plain_data_is_refused_with_its_line(text, tmp_path):
    line, words = REFUSED[text]
    path = tmp_path / "x.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load(str(path))
    message = str(error.value)
    assert words in message
    assert message.startswith(f"{path}:{line}: ")
    assert "\n" not in message
    assert len(message) < len(str(path)) + 300


def test_invalid_utf8_is_refused_with_its_line(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"name: x\nscene: {path: caf\xe9}\n")
    with pytest.raises(ConfigError, match=r"x.yaml:2: expected UTF-8 text, found 0xe9"):
        read_yaml(path)
    path.write_bytes("\ufeffname: x\n".encode())
    assert read_yaml(path).data == {"name": "x"}


def test_anchors_aliases_and_merge_keys_are_plain_data(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("a: &a {x: 1, y: [2]}\nb:\n  <<: *a\n  x: 3\nc: {<<: [{x: 4}, *a], z: 5}\nd: *a\n")
    document = read_yaml(path)
    assert document.data == {
        "a": {"x": 1, "y": [2]},
        "b": {"x": 3, "y": [2]},
        "c": {"x": 4, "y": [2], "z": 5},
        "d": {"x": 1, "y": [2]},
    }
    assert document.data["a"]["y"] is not document.data["d"]["y"]
    assert document.line(("b", "x")) == 4


def test_reused_anchor_gives_no_warning(recwarn):
    assert parse_value("[&a 1, &a 2, *a]") == [1, 2, 2]
    assert not recwarn.list


def test_deep_nesting_is_refused_early(monkeypatch):
    """The time of the parser grows with the square of the depth."""
    composed = []
    monkeypatch.setattr(Composer, "compose_node", counted(Composer.compose_node, composed))
    with pytest.raises(ConfigError, match="nested too deeply"):
        parse_value("- " * 9000)
    assert len(composed) < 60


def counted(function: Callable[..., object], calls: list[int]) -> Callable[..., object]:
    def call(*arguments: object) -> object:
        calls.append(1)
        return function(*arguments)

    return call


def test_dates_and_standard_tags_are_parsed():
    values = {"2024-01-01": "2024-01-01", "!!str 5": "5", "!!float 5": 5.0, "=": "=", "": None, "12:30": "12:30"}
    for text, value in values.items():
        assert parse_value(text) == value
        assert type(parse_value(text)) is type(value)


def complaint(read: Callable[[str], object], text: str) -> str:
    """What is said against it, if anything; any other exception fails the test."""
    try:
        read(text)
    except ConfigError as error:
        return str(error)
    return ""


@given(st.text(alphabet="ab1: -[]{},#&*!|>'\"%@`?~<=.\n\t\0é\ud800", max_size=60))
def test_any_text_is_data_or_one_error_sentence(text):
    assert "\n" not in complaint(parse_value, text)


SMOKE = resource_dir("pipelines").joinpath("smoke.yaml").read_text()


@given(
    st.integers(0, len(SMOKE)),
    st.sampled_from(["!!set ", "&a ", "*a", "? ", ": ", "[", "}", "- ", "\0", "1: 2\n", "<<: "]),
)
def test_pipeline_with_an_insertion_is_valid_or_refused(tmp_path_factory, place, what):
    path = tmp_path_factory.getbasetemp() / "fuzzed.yaml"
    path.write_text(SMOKE[:place] + what + SMOKE[place:])
    message = complaint(load, str(path))
    assert not message or message.startswith(f"{path}:")
    assert "\n" not in message
