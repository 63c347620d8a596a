"""The pages about keys: one for each family of what a pipeline file can name, one for all other settings."""

import functools
from typing import Any

from families import Kind, families, family, tag, unnamed
from yaml_examples import example

from clsplat.density.statistics import Statistic
from clsplat.settings import variants

Node = dict[str, Any]
HEADINGS = {"stages": "Stages", "losses": "Losses and penalties", "rules": "Density rules", "prepare": "Prepare steps"}
WORDS = {"integer": "whole number", "string": "text", "boolean": "true or false", "null": "none", "object": "keys"}
BOUNDS = {"exclusiveMinimum": "> ", "minimum": "≥ ", "exclusiveMaximum": "< ", "maximum": "≤ "}
TABLE = "| key | takes | default | meaning and unit |\n|---|---|---|---|\n"


@functools.cache
def reference_pages() -> dict[str, str]:
    """Return every page that is made from settings, by its path in the site."""
    pages = {page: family_page(page) for page in dict.fromkeys(family(base).page for base in families())}
    pages |= {"settings": settings_page(), "statistics": statistics_page()}
    return {f"reference/{name}.md": text for name, text in pages.items()}


def family_page(page: str) -> str:
    """Return all families of a page, each with the keys that its members share."""
    text = f"# {HEADINGS.get(page, page.capitalize())}\n\n"
    for base, kinds in families().items():
        if family(base).page != page:
            continue
        text += f"## Every {family(base).title}\n\n{manual(base)}{key_table(base)}"
        for kind in kinds:
            sample, file = example(base, kind)
            title = f' title="{file}"' if file else ""
            text += f"## `{tag(kind)}` {{: #{tag(kind)} }}\n\n{manual(kind)}{key_table(kind, tuple(base.model_fields))}"
            text += f"```yaml{title}\n{sample}```\n\n"
    return text


def settings_page() -> str:
    """Return the settings without a name of their own."""
    text = "# Settings of a pipeline file\n\n"
    for kind, key in unnamed().items():
        title = f"`{key}`: {kind.__name__}" if key else "The file"
        text += f"## {title} {{: #{kind.__name__.lower()} }}\n\n{manual(kind)}{key_table(kind)}"
    return text


def statistics_page() -> str:
    """Return what density rules can ask for."""
    text = "# Statistics\n\nA growing rule acts where the mean of a statistic is large. Only those that a rule names "
    text += "are summed and cost time.\n\n"
    for name, statistic in variants(Statistic).items():
        text += f"## `{name}` {{: #{name} }}\n\n{manual(statistic)}"
    return text


def key_table(kind: Kind, without: tuple[str, ...] = ()) -> str:
    """Return a table of the keys of a class, but those named in `without` that it has from its base."""
    schema, rows = kind.model_json_schema(), ""
    for name, field in kind.model_fields.items():
        if name in ("type", "stage") or (name in without and name not in kind.__annotations__):
            continue
        node = schema["properties"][name]
        default = "required" if field.is_required() else shown(node.get("default"))
        cells = (f"`{name}`", expected(node), default, field.description or "")
        rows += "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |\n"
    return f"{TABLE}{rows}\n" if rows else ""


def expected(node: Node) -> str:
    """Return what a key takes, in words, from its JSON schema."""
    if "$ref" in node:
        return link(node["$ref"].rpartition("/")[2])
    if "const" in node:
        return f"`{node['const']}`"
    if "enum" in node:
        if set(node["enum"]) <= variants(Statistic).keys():
            return "[statistic](statistics.md)"
        return "one of " + ", ".join(f"`{value}`" for value in node["enum"])
    for union in ("anyOf", "oneOf", "allOf"):
        if union in node:
            return " or ".join(dict.fromkeys(expected_of(one) for one in node[union]))
    if node.get("type") == "array":
        return f"list of {expected(node['items'])}" if "items" in node else "list"
    if isinstance(node.get("additionalProperties"), dict):
        return f"keys, each with a {expected(node['additionalProperties'])}"
    bounds = " and ".join(f"{sign}{flow(node[key])}" for key, sign in BOUNDS.items() if key in node)
    return f"{WORDS.get(node.get('type', ''), node.get('type', 'any value'))} {bounds}".strip()


def expected_of(node: Node) -> str:
    """Return what one member of a union takes: all members of a family are one link."""
    name = node.get("$ref", "").rpartition("/")[2]
    for base, kinds in families().items():
        if name in [kind.__name__ for kind in kinds]:
            return f"[{family(base).title}]({family(base).page}.md)"
    return expected(node)


def link(name: str) -> str:
    """Return a link to the section about a class."""
    for base, kinds in families().items():
        for kind in kinds:
            if kind.__name__ == name:
                return f"[`{tag(kind)}`]({family(base).page}.md#{tag(kind)})"
    return f"[{name}](settings.md#{name.lower()})" if name in [kind.__name__ for kind in unnamed()] else "any value"


def shown(value: Any) -> str:
    """Return a default as a pipeline file would have it."""
    text = flow(value)
    return "none" if value is None else f"`{text}`" if len(text) <= 40 else "its defaults"


def flow(value: Any) -> str:
    """Return a value on one line of YAML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(flow, value)) + "]"
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def manual(kind: type) -> str:
    """Return a class's docstring as Markdown."""
    return "\n".join(line.strip() for line in (kind.__doc__ or "").strip().splitlines()) + "\n\n"
