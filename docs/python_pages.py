"""The Python reference: a page for each class, one for the functions, one for each module, and an index."""

import dataclasses
import inspect
import re
import typing
from types import FunctionType, ModuleType
from typing import Any

from families import families, groups
from reference_pages import key_table, manual

import clsplat
from clsplat.core.schedule import Curve
from clsplat.core.settings import Settings
from clsplat.scene import Reader

FOLDER = "reference/python"
MEMBERS = (FunctionType, property, classmethod, staticmethod)


def python_pages() -> dict[str, str]:
    """Return the pages of the Python reference by their path in the site."""
    public = [getattr(clsplat, name) for name in clsplat.__all__]
    classes = [named for named in public if isinstance(named, type)]
    functions = [named for named in public if callable(named) and not isinstance(named, type)]
    modules = [named for named in public if isinstance(named, ModuleType)]
    extending = [kind for kind in plugin_classes() if kind not in classes]
    by_name = {kind.__name__: class_page(kind) for kind in (*classes, *extending)}
    by_name |= {module.__name__.rpartition(".")[2]: module_page(module) for module in modules}
    by_name["functions"] = "# Functions\n\n" + "".join(directive(function, 2) for function in functions)
    index = f"{INTRODUCTION}## Classes\n\n{class_list(classes)}## Functions and modules\n\n"
    index += "- [Functions](python/functions.md)\n"
    index += "".join(f"- [`{m.__name__}`](python/{m.__name__.rpartition('.')[2]}.md): {summary(m)}\n" for m in modules)
    index += f"\n## For plug-ins\n\n{PLUGINS}{class_list(extending)}"
    order = ["functions", *(name for name in by_name if name != "functions")]
    pages = {f"{FOLDER}/{name}.md": text for name, text in by_name.items()}
    return {f"{FOLDER}.md": index, **pages, f"{FOLDER}/SUMMARY.md": "".join(f"- [{n}]({n}.md)\n" for n in order)}


INTRODUCTION = "# Python reference\n\nEvery name here is in `clsplat`, unless its page says otherwise. "
INTRODUCTION += "[Use clsplat from Python](../python.md) has examples.\n\n"
PLUGINS = "Base classes of what a pipeline file can name, and the classes that their methods receive.\n\n"


def class_list(kinds: list[type]) -> str:
    """Return a list of links to classes, with the first sentence of each docstring."""
    return "".join(f"- [`{kind.__name__}`](python/{kind.__name__}.md): {summary(kind)}\n" for kind in kinds) + "\n"


def summary(named: Any) -> str:
    """Return the first paragraph of a docstring on one line."""
    return " ".join((named.__doc__ or "").strip().partition("\n\n")[0].split())


def class_page(kind: type) -> str:
    """Return a class: its docstring, its constructor, its fields with units, its methods and properties."""
    path = f"{kind.__module__}.{kind.__qualname__}"
    if "__init__" in vars(kind) and not dataclasses.is_dataclass(kind):
        text = f"# `{kind.__name__}`\n\n::: {path}\n{options(2)}      heading: Constructor\n"
        text += "      toc_label: Constructor\n      members: false\n      merge_init_into_class: true\n\n"
    else:
        text = f"# `{kind.__name__}` {{: #{path} }}\n\n{manual(kind)}"
    text += f"From `{kind.__module__}`.\n\n" if not hasattr(clsplat, kind.__name__) else ""
    is_settings = issubclass(kind, Settings)
    fields = re.sub(r"\]\((?=\w+\.md)", "](../", key_table(kind)) if is_settings else field_table(kind)
    text += f"## Fields\n\n{fields}" if fields else ""
    members = {name: value for name, value in vars(kind).items() if not name.startswith(("_", "model_"))}
    shown = [name for name, value in members.items() if isinstance(value, MEMBERS)]
    return text + "".join(f"::: {path}.{name}\n{options(2)}\n" for name in shown)


def field_table(kind: type) -> str:
    """Return the fields of a dataclass, with the comments next to them where there are any."""
    if not dataclasses.is_dataclass(kind):
        return ""
    source, rows = inspect.getsource(kind), []
    for name in [field.name for field in dataclasses.fields(kind) if not field.name.startswith("_")]:
        match = re.search(rf"^    {name}: ([^=#\n]+?)(?: = (?:\(\n)?[^#\n]*)?(?:#(.*))?$", source, re.M)
        type_ = match[1].strip().strip('"').replace("|", "or") if match else ""
        meaning = " ".join((match[2] or "").split()) if match else ""
        rows.append([f"`{name}`", f"`{type_}`", meaning.replace("|", "\\|").replace("[", "\\[")])
    head = ["field", "type", "meaning and unit"]
    if not any(row[-1] for row in rows):
        head, rows = head[:-1], [row[:-1] for row in rows]
    lines = [head, ["---"] * len(head), *rows] if rows else []
    return "".join(f"| {' | '.join(line)} |\n" for line in lines) + "\n"


def module_page(module: ModuleType) -> str:
    """Return a module: its docstring and its public names."""
    names = getattr(module, "__all__", None) or [n for n, v in vars(module).items() if isinstance(v, type)]
    text = f"# `{module.__name__}`\n\n{manual(module)}"  # type: ignore[arg-type]
    for name in names:
        named = getattr(module, name)
        if getattr(named, "__module__", "").startswith("clsplat") and not name.startswith("_"):
            text += directive(named, 2)
    return text


def plugin_classes() -> list[type]:
    """Return the base of every family with the classes of the package in the signatures of its methods."""
    kinds: dict[type, None] = {}
    bases = [*(group for base in families() for group in groups(base)), Curve, Reader]
    for base in bases:
        kinds[base] = None
        for method in vars(base).values():
            if callable(method) and not method.__name__.startswith("_"):
                hints = typing.get_type_hints(method)
                kinds |= {k: None for k in hints.values() if getattr(k, "__module__", "").startswith("clsplat.")}
    return [kind for kind in kinds if isinstance(kind, type)]


def directive(named: Any, level: int) -> str:
    """Return what mkdocstrings replaces by the documentation of a class or a function."""
    return f"::: {named.__module__}.{named.__qualname__}\n{options(level)}\n"


def options(level: int) -> str:
    """Return the options of a directive."""
    return f"    options:\n      heading_level: {level}\n"
