"""Read YAML as plain data, with the line of each value; a file cannot run code.

Text, numbers, true, false, null, lists, and maps with text keys are allowed, and so are anchors, aliases, and merge
keys (`<<`).  Every other tag is an error.
"""

import io
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from clsplat.core.errors import ConfigError, quote, shorten
from clsplat.core.reading import read_text
from clsplat.pipeline.files import VARIANT_SUFFIXES, origin, variant_key

SIZE_LIMIT = 1 << 20  # bytes
NODE_LIMIT = 20_000  # values after aliases are expanded, so that nested aliases cannot fill the memory
DEPTH_LIMIT = 50  # nested lists and maps
INTEGER_LIMIT = 1 << 63
CORE_TAG_PREFIX = "tag:yaml.org,2002:"
MERGE = f"{CORE_TAG_PREFIX}merge"
SCALAR_TAGS = tuple(CORE_TAG_PREFIX + name for name in ("null", "bool", "int", "float", "str"))
PLAIN_TYPES = (bool, int, float, str)  # types of scalars, whose subclasses in ruamel also store the notation of a value
TEXT_TAGS = tuple(CORE_TAG_PREFIX + name for name in ("timestamp", "value"))  # dates and `=` are text
KeyPath = tuple[str | int, ...]


@dataclass
class Document:
    """Plain dicts, lists, and scalars, and the line number of each value, counted from 1."""

    data: Any
    lines: dict[KeyPath, int] = field(default_factory=dict)

    def line(self, key_path: KeyPath) -> int:
        """Return the line of a value, or of the innermost list or map around it."""
        while key_path and key_path not in self.lines:
            key_path = key_path[:-1]
        return self.lines.get(key_path, 1)


class _BadValue(Exception):
    """Raised for a value that is not allowed in a file of settings; `line` is its line number."""

    def __init__(self, node: Any, problem: str) -> None:
        super().__init__(problem)
        self.line = node.start_mark.line + 1


class _BoundedComposer(Composer):
    """A composer that fails as soon as a limit is exceeded; parsing time grows with the square of the depth."""

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader=loader)
        self.warn_double_anchors = False
        self._depth = self._count = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        self._count += 1
        if self._depth > DEPTH_LIMIT or self._count > NODE_LIMIT:
            depth, count = "lists and maps are nested too deeply", f"more than {NODE_LIMIT} values"
            raise _BadValue(self.parser.peek_event(), depth if self._depth > DEPTH_LIMIT else count)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


def read_yaml(path: Path) -> Document:
    """Read a file with one YAML document.  Raises ConfigError with the file and line."""
    return _parse(read_pipeline(path), str(path))


def read_pipeline(path: Path) -> str:
    """Return the text of a pipeline; the text of NAME_7k is created from NAME.yaml and its key `short`.

    Raises ConfigError.
    """
    file, key = origin(path), variant_key(path)
    text = read_text(file, "a pipeline file", ConfigError, SIZE_LIMIT)
    return text if file == path or key is None else _apply_variant(text, path, file, key)


# The text of NAME_7k.yaml is that of NAME.yaml with the values of `short`, and with the comment above that key.


def _apply_variant(text: str, path: Path, file: Path, name: str) -> str:
    document = _parse(text, str(file))
    if not isinstance(document.data, dict) or not isinstance(document.data.get(name), dict):
        raise ConfigError(
            f"{file}: expected a mapping '{name}' with values for {path.name}; add one, or run {file.name}"
        )
    root = YAML(typ="safe", pure=True).compose(text)
    summary, settings, edits = "", {}, []
    for key, variant in [pair for pair in root.value if pair[0].value in VARIANT_SUFFIXES]:
        root.value.remove((key, variant))  # the keys inside it cannot be set
        comment = re.findall(r"(?:^#.*\n)*\Z", text[: key.start_mark.index], re.MULTILINE)[0]
        edits.append((key.start_mark.index - len(comment), variant.end_mark.index, ""))
        if key.value == name:
            summary = comment
            settings = {k.value: text[v.start_mark.index : v.end_mark.index] for k, v in variant.value}
    for key_path, value in {"name": path.stem, **settings}.items():
        if not (node := _node(root, key_path)):
            line = f"{file}:{document.line((name, key_path))}: {name}"
            raise ConfigError(
                f"{line}: the pipeline has no key {quote(key_path)}; use the path of an existing key, as for --set, "
                "such as optimize.steps"
            )
        edits.append((node.start_mark.index, node.end_mark.index, value))
    next_start = len(text)  # start of the next edit: the end mark of a map is after the comments that follow it
    for start, stop, new_text in sorted(edits, reverse=True):
        text = text[:start] + new_text + text[min(stop, next_start) :]
        next_start = start
    return f"{summary}#\n{text}"


def _node(root: Node, key_path: str) -> Node | None:
    """Return the node of a key path in the syntax of --set, or None if there is none."""
    first, *names = key_path.split(".")
    if not names:
        return _children(root).get(first)
    level = [root]
    while level and not (matches := [_children(node)[first] for node in level if first in _children(node)]):
        level = [inner for node in level for inner in _children(node).values()]
    result = matches[0] if level and len(matches) == 1 else None
    for name in names:
        parent, result = result, _children(result).get(name)
        if isinstance(parent, SequenceNode) and len(_children(result)) == 1:  # a stage
            (result,) = _children(result).values()
    return result


def _children(node: Node | None) -> dict[str, Node]:
    """Return the nodes in a map by key, or in a list by index."""
    if isinstance(node, MappingNode):
        return {str(key.value): value for key, value in node.value}
    return {str(i): item for i, item in enumerate(node.value)} if isinstance(node, SequenceNode) else {}


def parse_value(text: str) -> Any:
    """Parse a value in the syntax of a file: a number, true, false, null, a [list], a {map}, or text.

    Raises ConfigError.
    """
    return _parse(text, "").data


def yaml_text(data: Any) -> str:
    """Return plain data as YAML."""
    stream = io.StringIO()
    yaml = YAML(typ="safe")
    yaml.default_flow_style = None
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.width = 120
    yaml.dump(data, stream)
    return stream.getvalue()


def _parse(text: str, name: str) -> Document:
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = _BoundedComposer
    try:
        root = yaml.compose(text)
        return _Reader(yaml).document(root)
    except _BadValue as error:
        line, problem = error.line, str(error)
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 1
        problem = shorten((error.problem or error.context or "this is not YAML").splitlines()[0], 200)
    except ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        problem = f"the character U+{ord(text[error.position]):04X} is not allowed in YAML"
    except RecursionError:
        line, problem = 1, "lists and maps are nested too deeply"
    except (YAMLError, ValueError, IndexError, AttributeError, TypeError) as error:
        line, problem = 1, f"this is not YAML ({type(error).__name__})"
    raise ConfigError(f"{name}:{line}: {problem}" if name else problem)


class _Reader:
    """A converter of the nodes of one document to plain data."""

    def __init__(self, yaml: YAML) -> None:
        self._scalars = yaml.constructor
        self._remaining = NODE_LIMIT
        self._lines: dict[KeyPath, int] = {}

    def document(self, root: Node | None) -> Document:
        return Document(None if root is None else self._plain(root, ()), self._lines)

    def _plain(self, node: Node, key_path: KeyPath) -> Any:
        self._remaining -= 1
        if self._remaining < 0:
            raise _BadValue(node, f"more than {NODE_LIMIT} values")
        if isinstance(node, MappingNode) and node.tag == f"{CORE_TAG_PREFIX}map":
            return self._map(node, key_path)
        if isinstance(node, SequenceNode) and node.tag == f"{CORE_TAG_PREFIX}seq":
            self._lines |= {(*key_path, i): item.start_mark.line + 1 for i, item in enumerate(node.value)}
            return [self._plain(item, (*key_path, i)) for i, item in enumerate(node.value)]
        if isinstance(node, ScalarNode) and node.tag in TEXT_TAGS:
            return str(node.value)
        if isinstance(node, ScalarNode) and node.tag in SCALAR_TAGS:
            return self._scalar(node)
        tag = shorten(str(node.tag).replace(CORE_TAG_PREFIX, "!!"))
        raise _BadValue(node, f"the tag {tag} is not allowed; expected text, a number, a list or keys and values")

    def _map(self, node: MappingNode, key_path: KeyPath) -> dict[str, Any]:
        data: dict[str, Any] = {}
        merge_nodes: list[Node] = []
        for key_node, value in node.value:
            if key_node.tag == MERGE:
                merge_nodes += value.value if isinstance(value, SequenceNode) else [value]
                continue
            key = self._plain(key_node, key_path) if isinstance(key_node, ScalarNode) else None
            if not isinstance(key, str):
                raise _BadValue(
                    key_node, "expected text as a key; put a number, a date or a word such as true in quotes"
                )
            if key in data:
                raise _BadValue(key_node, f"duplicate key {quote(key)}")
            self._lines[*key_path, key] = key_node.start_mark.line + 1
            data[key] = self._plain(value, (*key_path, key))
        for merge_node in merge_nodes:
            data = {**self._merge(merge_node, key_path), **data}
        return data

    def _merge(self, node: Node, key_path: KeyPath) -> dict[str, Any]:
        """Return the map to which `<<` refers.  Keys that the outer map also has keep their line numbers."""
        if not isinstance(node, MappingNode):
            raise _BadValue(node, "expected a map after '<<'")
        outer_lines, self._lines = self._lines, {}
        data: dict[str, Any] = self._plain(node, key_path)
        self._lines, inner_lines = outer_lines, self._lines
        for inner_path, line in inner_lines.items():
            self._lines.setdefault(inner_path, line)
        return data

    def _scalar(self, node: ScalarNode) -> Any:
        try:
            value = self._scalars.construct_object(node)
        except (ValueError, KeyError, IndexError):
            type_name = str(node.tag).removeprefix(CORE_TAG_PREFIX)
            raise _BadValue(node, f"{quote(node.value)} cannot be read as {type_name}") from None
        if isinstance(value, int) and abs(value) >= INTEGER_LIMIT:
            raise _BadValue(node, f"{quote(node.value)} is too large; expected a whole number of at most 64 bits")
        return next((type_(value) for type_ in PLAIN_TYPES if isinstance(value, type_)), None)
