"""Find an example of each class that a pipeline file can name: in a shipped file, on a page, or with all its keys."""

import functools
import io
import re
from collections.abc import Iterator
from typing import Any

from families import ROOT, Kind, family, tag
from ruamel.yaml import YAML

Node = dict[str, Any]
MAX_EXAMPLE = 10  # lines
MAX_WIDTH = 88  # characters that fit on a page without scrolling


def find_example(base: Kind, kind: Kind) -> tuple[str, str]:
    """Return an example, and the shipped file that has it, or "" if none does."""
    found = [
        (block(base, item), file)
        for file, item in shipped_items()
        if (kind_of_item(item) == tag(kind)) and set(fields_of(item)) <= {*kind.model_fields}
    ]
    if not found:  # no file uses it
        values = kind.model_construct().model_dump(mode="json", exclude={"stage", "every", "start", "stop"})
        values = {"type": values.pop("type"), **values} if "type" in values else values
        values = {key: value for key, value in values.items() if value is not None}
        found = [(block(base, {tag(kind): values} if "stage" in kind.model_fields else values), "")]
    short = [one for one in found if one[0].count("\n") <= MAX_EXAMPLE]
    short = [one for one in short if one[1] == short[0][1]]  # of the first file the most complete
    return max(short or [min(found, key=lambda one: len(one[0]))], key=lambda one: len(one[0]))


@functools.cache
def shipped_items() -> list[tuple[str, Node]]:
    """Return all mappings in shipped files, plain 3DGS first, and on the page about pipelines, with file names."""
    files = sorted((ROOT / "pipelines").glob("*.yaml"), key=lambda file: (not file.name.startswith("splat"), file.name))
    texts = [(file.name, file.read_text("utf-8")) for file in files]
    page = "".join((ROOT / "docs" / name).read_text("utf-8") for name in ("pipelines.md", "training.md"))
    texts += [("", text) for text in re.findall(r"^```yaml\n(.*?)^```", page, re.M | re.S)]
    return [(name, item) for name, text in texts for item in items(YAML(typ="safe").load(text))]


def items(node: Any) -> Iterator[Node]:
    """Yield all mappings in a document, and each plain name in a list as a stage without keys."""
    if isinstance(node, dict):
        yield node
    for inner in node.values() if isinstance(node, dict) else node if isinstance(node, list) else ():
        yield from [{inner: {}}] if isinstance(node, list) and isinstance(inner, str) else items(inner)


def kind_of_item(item: Node) -> str:
    """Return the name in {type: name, …} or {name: {…}}."""
    return str(item["type"]) if "type" in item else str(next(iter(item))) if len(item) == 1 else ""


def fields_of(item: Node) -> Node:
    """Return the keys in {type: name, …} or {name: {…}}."""
    inner = next(iter(item.values()))
    return item if "type" in item else inner if isinstance(inner, dict) else {}


def block(base: Kind, item: Node) -> str:
    """Return an item as YAML, under the key that holds it."""
    fields = fields_of(item)
    key = "during" if "every" in fields else family(base).key
    one = item if fields.keys() - {"type"} else kind_of_item(item)
    data = {key: [one] if family(base).listed else one}
    text = to_yaml(data, None if isinstance(data[key], list | dict) else False)
    return text if max(map(len, text.splitlines())) <= MAX_WIDTH else to_yaml(data, False)


def to_yaml(data: Node, flow_style: bool | None) -> str:
    """Return YAML; flow_style None: innermost collections on one line."""
    stream, yaml = io.StringIO(), YAML(typ="safe")
    yaml.default_flow_style, yaml.width = flow_style, 1000
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    yaml.dump(data, stream)
    return stream.getvalue()
