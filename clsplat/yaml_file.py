"""Reading YAML as plain data, with the line of every value; nothing in a file can run code."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from clsplat.errors import ConfigError

SIZE_LIMIT = 1 << 20  # bytes
NODE_LIMIT = 20_000  # values after aliases are expanded: a file of aliases to aliases cannot fill the memory
Place = tuple[str | int, ...]


@dataclass
class Document:
    """Plain dicts, lists and scalars, and the line on which each value stands, counted from 1."""

    data: Any
    lines: dict[Place, int] = field(default_factory=dict)

    def line(self, place: Place) -> int:
        """The line of a value, or of the nearest thing around it."""
        while place and place not in self.lines:
            place = place[:-1]
        return self.lines.get(place, 1)


def read_yaml(path: Path) -> Document:
    """Read one document.  Raises ConfigError with file and line."""
    try:
        if path.stat().st_size > SIZE_LIMIT:
            raise ConfigError(f"{path}: larger than {SIZE_LIMIT} bytes; this is not a pipeline file")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    try:
        document = Document(None)
        document.data = _plain(YAML(typ="rt").load(text), document, (), [NODE_LIMIT])
        return document
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        raise ConfigError(f"{path}:{line}: {(error.problem or 'not YAML').splitlines()[0]}") from error
    except (YAMLError, RecursionError, ValueError) as error:
        raise ConfigError(f"{path}: not YAML ({str(error).splitlines()[0]})") from error


def parse_scalar(text: str) -> Any:
    """Read one value as a file would: numbers, true, false, null, [lists] or text."""
    document = Document(None)
    try:
        return _plain(YAML(typ="rt").load(text), document, (), [NODE_LIMIT])
    except YAMLError as error:
        raise ConfigError(f"cannot read the value '{text}'") from error


def _plain(node: Any, document: Document, place: Place, left: list[int]) -> Any:
    left[0] -= 1
    if left[0] < 0:
        raise ValueError("too many values")
    if isinstance(node, CommentedMap):
        for key in node:
            document.lines[(*place, key)] = node.lc.key(key)[0] + 1 if key in (node.lc.data or {}) else 1
        return {key: _plain(value, document, (*place, key), left) for key, value in node.items()}
    if isinstance(node, CommentedSeq):
        for i in range(len(node)):
            document.lines[(*place, i)] = node.lc.item(i)[0] + 1
        return [_plain(value, document, (*place, i), left) for i, value in enumerate(node)]
    for kind in (bool, int, float, str):
        if isinstance(node, kind):
            return kind(node)
    if node is None:
        return None
    raise ValueError(f"values of type {type(node).__name__} are not allowed")
