"""Make the reference pages about keys: one for each family, one for all other settings."""

import functools
import math
from typing import Any

from families import NOTATIONS, Kind, annotation_parts, families, family, groups, tag, unnamed_settings
from schedule_page import schedule_page
from yaml_examples import find_example

from clsplat.core.schedule import Bounded
from clsplat.core.settings import descriptions, variants
from clsplat.scene.detect import readers

Node = dict[str, Any]
HEADINGS = {
    "stages": "Stages",
    "losses": "Losses and penalties",
    "rules": "Density rules",
    "prepare": "Prepare steps",
    "modules": "Training modules",
    "views": "Orders and transforms",
    "filters": "Filters and backgrounds",
}
INTRODUCTIONS = {
    "stages": "A pipeline is a list of stages. Scheduled stages can also run inside a training, in `optimize.during`.",
    "losses": "`optimize.losses` is a list; training minimizes the weighted sum.",
    "rules": "`densify.rules` is a list. All rules act at once, in one rearrangement of the Gaussians.",
    "statistics": "A [growing rule](rules.md#grow) acts on Gaussians with a large mean `statistic`. Only statistics "
    "that a rule names are computed.",
    "modules": "`optimize.modules` lists what takes part in a training step in addition to the Gaussians, in the order "
    "of the forward pass; each type at most once. `--set` addresses a module by its type: "
    "`optimize.modules.TYPE.KEY=…` changes a key, `optimize.modules.TYPE={}` adds the module, "
    "`optimize.modules.TYPE=null` removes it.",
    "views": "How a training step picks and changes its photo: the keys `order` and `transforms` of `optimize.views`.",
    "filters": "Keys of `model`: the two low-pass filters, in the scene and on the screen, and the background.",
    "adaptations": "`adapt` names a class that derives "
    "[settings chosen automatically](../pipelines.md#settings-chosen-automatically).",
    "prepare": "`prepare` lists the steps that turn photographs into a scene, once, on the host.",
}
WORDS = {"integer": "whole number", "string": "text", "boolean": "true or false", "null": "none", "object": "keys"}
BOUNDS = {"exclusiveMinimum": "> ", "minimum": "≥ ", "exclusiveMaximum": "< ", "maximum": "≤ "}
TABLE = "| key | takes | default | meaning and unit |\n|---|---|---|---|\n"


@functools.cache
def reference_pages() -> dict[str, str]:
    """Return every page made from settings, by its path in the site."""
    pages = {page: family_page(page) for page in dict.fromkeys(family(base).page for base in families())}
    pages |= {"settings": settings_page(), "schedules": schedule_page(key_table), "readers": readers_page()}
    return {f"reference/{name}.md": text for name, text in pages.items()}


def family_page(page: str) -> str:
    """Return a page: for each of its families, the shared keys of each group, then each member."""
    text = f"# {HEADINGS.get(page, page.capitalize())}\n\n{INTRODUCTIONS.get(page, '')}\n\n"
    for base, kinds in families().items():
        if family(base).page == page:
            text += "".join(group_section(group) for group in groups(base))
            text += "".join(section(base, kind) for kind in kinds)
    return text


def group_section(group: Kind) -> str:
    """Return the docstring and the shared keys of a group, which is also a base class for plug-ins."""
    parent = group.__bases__[0]
    shared = tuple(parent.model_fields) if any(parent in groups(base) for base in families()) else ()
    heading = f"## Every {family(group).title} {{: #{group.__name__.lower()} }}\n\n"
    return f"{heading}{manual(group)}{key_table(group, shared)}Base class for plug-ins: `{group.__name__}`.\n\n"


def section(base: Kind, kind: Kind) -> str:
    """Return the docstring, the keys, and an example of a class that a pipeline file can name."""
    sample, file = find_example(base, kind)
    title = f' title="{file}"' if file else ""
    group = next(one for one in kind.__mro__ if one in groups(base))
    shared = f"It is a [{family(group).title}](#{group.__name__.lower()}).\n\n" if group is not base else ""
    keys = key_table(kind, tuple(group.model_fields))
    return f"## `{tag(kind)}` {{: #{tag(kind)} }}\n\n{manual(kind)}{shared}{keys}```yaml{title}\n{sample}```\n\n"


def settings_page() -> str:
    """Return the page about settings without a name."""
    text = "# Settings of a pipeline file\n\n"
    for kind, key in unnamed_settings().items():
        title = f"`{key}`" if key else "The file"
        text += f"## {title} {{: #{kind.__name__.lower()} }}\n\n{manual(kind)}{key_table(kind)}"
    return text


def readers_page() -> str:
    """Return the page about dataset readers, in the order in which they are tried."""
    text = (
        "# Dataset readers\n\nThe first reader that recognizes a folder reads it; see [datasets](../datasets.md).\n\n"
    )
    for reader in readers():
        text += f"## {reader.name}\n\n{manual(type(reader))}It looks for {reader.expects}.\n\n"
    return text


def key_table(kind: Kind, without: tuple[str, ...] = ()) -> str:
    """Return a table of the keys of a class, except inherited ones that are in `without`."""
    schema, texts, rows = kind.model_json_schema(), descriptions(kind), ""
    for name, field in kind.model_fields.items():
        if name in ("type", "stage") or (name in without and name not in kind.__annotations__):
            continue
        node = schema["properties"][name]
        default = "required" if field.is_required() else default_text(node.get("default"))
        bound = next((part for part in annotation_parts(field) if isinstance(part, Bounded)), None)
        takes = accepted_values(node)
        if bound:
            limits = f"{'>' if bound.exclusive else '≥'} {bound.minimum:g}"
            limits += f" and ≤ {bound.maximum:g}" if math.isfinite(bound.maximum) else ""
            takes = takes.replace(BY_STEP, f"{BY_STEP} {limits}")
        cells = (f"`{name}`", takes, default, texts.get(name, ""))
        rows += "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |\n"
    return f"{TABLE}{rows}\n" if rows else ""


BY_STEP = "[number or schedule](schedules.md)"


def accepted_values(node: Node) -> str:
    """Return in words what a key takes, from its JSON schema."""
    if "$ref" in node:
        return link(node["$ref"].rpartition("/")[2])
    if "const" in node:
        return f"`{node['const']}`"
    if "enum" in node:
        for base in families():
            if set(node["enum"]) <= variants(base).keys():
                return f"[{family(base).title}]({family(base).page}.md)"
        return "one of " + ", ".join(f"`{value}`" for value in node["enum"])
    for union in ("anyOf", "oneOf", "allOf"):
        if union in node:
            return union_values(node[union])
    if node.get("type") == "array":
        return f"list of {accepted_values(node['items'])}" if "items" in node else "list"
    if isinstance(node.get("additionalProperties"), dict):
        return f"keys, each with a {accepted_values(node['additionalProperties'])}"
    bounds = " and ".join(f"{sign}{flow_yaml(node[key])}" for key, sign in BOUNDS.items() if key in node)
    return f"{WORDS.get(node.get('type', ''), node.get('type', 'any value'))} {bounds}".strip()


def union_values(nodes: list[Node]) -> str:
    """Return what a union takes: the members of a family become one link, and so do the notations of a schedule."""
    flat = [inner for node in nodes for inner in (node.get("anyOf") or [node])]
    names = [node.get("$ref", "").rpartition("/")[2] for node in flat]
    if {kind.__name__ for kind in NOTATIONS} <= set(names):
        others = [
            accepted_values(n) for n, name in zip(flat, names, strict=True) if n.get("type") not in ("number", "array")
        ]
        return " or ".join([BY_STEP, *(text for text in others if "schedules.md" not in text)])
    return " or ".join(dict.fromkeys(member_values(one) for one in flat))


def member_values(node: Node) -> str:
    """Return what one member of a union takes."""
    name = node.get("$ref", "").rpartition("/")[2]
    for base, kinds in families().items():
        if name in [kind.__name__ for kind in kinds]:
            return f"[{family(base).title}]({family(base).page}.md)"
    return accepted_values(node)


def link(name: str) -> str:
    """Return a link to the section about a class."""
    for base, kinds in families().items():
        for kind in kinds:
            if kind.__name__ == name:
                return f"[`{tag(kind)}`]({family(base).page}.md#{tag(kind)})"
    if name in [kind.__name__ for kind in NOTATIONS]:
        return f"[keys](schedules.md#{name.lower()})"
    return (
        f"[keys](settings.md#{name.lower()})" if name in [kind.__name__ for kind in unnamed_settings()] else "any value"
    )


def default_text(value: Any) -> str:
    """Return a default as a pipeline file writes it."""
    text = flow_yaml(value)
    return "none" if value is None else f"`{text}`" if len(text) <= 40 else "its defaults"


def flow_yaml(value: Any) -> str:
    """Return a value on one line of YAML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow_yaml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(flow_yaml, value)) + "]"
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def manual(kind: type) -> str:
    """Return a class's docstring as Markdown."""
    return "\n".join(line.strip() for line in (kind.__doc__ or "").strip().splitlines()) + "\n\n"
