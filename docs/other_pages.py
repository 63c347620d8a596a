"""The pages about commands, shipped pipelines and Python names, and those that show a file of the repository."""

import dataclasses
import functools
import inspect
import re
import typing
from types import FunctionType, ModuleType
from typing import Any

import typer
from families import ROOT, families, groups
from reference_pages import key_table, manual

import clsplat
from clsplat.cli import app
from clsplat.cli.data import app as tools
from clsplat.core import errors
from clsplat.core.schedule import Curve
from clsplat.core.settings import Settings
from clsplat.pipeline.files import shipped
from clsplat.pipeline.yaml_file import read_pipeline
from clsplat.scene import Reader

OTHER_CODES = {0: "Done.", 1: "Internal error, a defect of clsplat: `--debug` shows it; please report it."}


def command_page() -> str:
    """Return every command with its options, and the exit codes."""
    group = typer.main.get_command(app)
    text = f"# Command line\n\n{group.help} These options stand before the command:\n\n{option_table(group, 'clsplat')}"
    names = [name for name in group.list_commands(None) if name != "data"]
    text += "".join(section(group.get_command(None, name), f"clsplat {name}") for name in names)
    data = typer.main.get_command(tools)
    text += "".join(section(command, f"clsplat data {name}") for name, command in data.commands.items())
    codes = OTHER_CODES | {kind.exit_code: summary(kind) for kind in errors.ClsplatError.__subclasses__()}
    rows = "".join(f"| {code} | {meaning} |\n" for code, meaning in sorted(codes.items()))
    return (
        f"{text}\n## Exit codes\n\nAn error is one line: what is wrong, where, what was expected and what to do.\n\n"
        f"| code | meaning |\n|---|---|\n{rows}"
    )


def section(command: Any, name: str) -> str:
    """Return a command's help: its usage, its purpose, its options and examples."""
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    names = [(p.metavar or str(p.name).upper()).replace("|", "/") for p in arguments]
    shown = [name if p.required else f"[{name}]" for name, p in zip(names, arguments, strict=True)]
    usage = " ".join([name, *shown, "[OPTIONS]"])
    examples = "\n".join(line.strip() for line in (command.epilog or "").splitlines()[1:])
    block = f"```sh\n{examples}\n```\n\n" if examples else ""
    return f"## `{name}`\n\n```text\n{usage}\n```\n\n{command.help or ''}\n\n{option_table(command, name)}{block}"


def option_table(command: Any, name: str) -> str:
    """Return a table of arguments and options."""
    context = command.make_context(name, [], resilient_parsing=True)
    records = [p.get_help_record(context) for p in command.params]
    escaped = "\\["  # brackets make no link
    rows = "".join(
        f"| `{option(r[0])}` | {cell(r[1]).replace('[', escaped)} |\n" for r in records if r and r[0] != "--help"
    )
    return f"| option | meaning |\n|---|---|\n{rows}\n" if rows else ""


def option(text: str) -> str:
    """Return an option and the value that it takes, without names of Python types."""
    return re.sub(r" <(?:path|str|list\[\w+\])>", "", " ".join(text.split())).replace("|", "/")


def cell(text: str) -> str:
    """Return a text that does not break a table."""
    return " ".join(text.split()).replace("|", "\\|")


def summary(kind: type) -> str:
    return (kind.__doc__ or "").strip().splitlines()[0]


def pipelines_page() -> str:
    """Return the shipped pipelines: what their headers say, and the files."""
    text = "# Shipped pipelines\n\n`clsplat run NAME --scene DIR` runs one. Copy a file to make your own variant.\n\n"
    for name, file in shipped().items():
        lines = read_pipeline(file).splitlines()
        count = next(i for i, line in enumerate(lines) if not line.startswith("#"))
        header = "\n".join(line.lstrip("# ") for line in lines[:count]).replace(".\n", ".\n\n")
        body = "\n".join(f"    {line}" for line in lines[count:])
        text += f'## {name}\n\n{header}\n\n??? note "{file.name}"\n\n    ```yaml\n{body}\n    ```\n\n'
    return text


def python_page() -> str:
    """Return the public names of the package, then the classes that a plug-in meets."""
    public = {name: getattr(clsplat, name) for name in clsplat.__all__}
    classes = [named for named in public.values() if isinstance(named, type)]
    functions = [named for named in public.values() if callable(named) and not isinstance(named, type)]
    modules = [named for named in public.values() if isinstance(named, ModuleType)]
    text = "# Python reference\n\nAll of these are names of `clsplat`; [Python](../python.md) shows their use.\n\n"
    text += "## Classes\n\n" + "".join(class_section(kind) for kind in classes)
    text += "## Functions\n\n" + "".join(directive(function, 3) for function in functions)
    text += "## Modules\n\n" + "".join(module_section(module) for module in modules)
    text += "## For plug-ins\n\nThe bases of what a pipeline file can name, and what their methods are given.\n\n"
    return text + "".join(class_section(kind) for kind in plugin_classes() if kind not in classes)


def class_section(kind: type) -> str:
    """Return a class: its docstring, how it is made, its fields with units, its methods and properties."""
    text = f"### `{kind.__name__}` {{: #{kind.__module__}.{kind.__qualname__} }}\n\n{manual(kind)}"
    text += f"From `{kind.__module__}`.\n\n" if not hasattr(clsplat, kind.__name__) else ""
    own = "__init__" in vars(kind) and not dataclasses.is_dataclass(kind)
    text += directive(kind.__init__, 4, f"{kind.__name__}(…)") if own else ""  # type: ignore[misc]
    text += key_table(kind) if issubclass(kind, Settings) else field_table(kind)
    members = {name: value for name, value in vars(kind).items() if not name.startswith("_")}
    kinds = (FunctionType, property, classmethod, staticmethod)
    shown = [name for name, value in members.items() if isinstance(value, kinds) and not name.startswith("model_")]
    return text + "".join(f"::: {kind.__module__}.{kind.__qualname__}.{name}\n{options(4)}\n" for name in shown)


def field_table(kind: type) -> str:
    """Return the fields of a dataclass with the comments beside them."""
    if not dataclasses.is_dataclass(kind):
        return ""
    source, rows = inspect.getsource(kind), []
    for name in [field.name for field in dataclasses.fields(kind) if not field.name.startswith("_")]:
        found = re.search(rf"^    {name}: ([^=#\n]+?)(?: = (?:\(\n)?[^#\n]*)?(?:#(.*))?$", source, re.M)
        type_ = found[1].strip().strip('"').replace("|", "or") if found else ""
        rows.append((f"`{name}`", f"`{type_}`", cell(found[2] or "").replace("[", "\\[") if found else ""))
    if not any(meaning for _, _, meaning in rows):
        return "Fields: " + ", ".join(f"{name} ({type_})" for name, type_, _ in rows) + ".\n\n" if rows else ""
    return (
        "| field | type | meaning and unit |\n|---|---|---|\n" + "".join(f"| {' | '.join(r)} |\n" for r in rows) + "\n"
    )


def module_section(module: Any) -> str:
    """Return a module: its docstring and its public names."""
    names = getattr(module, "__all__", None) or [n for n, v in vars(module).items() if isinstance(v, type)]
    text = f"### `{module.__name__}`\n\n{manual(module)}"
    for name in names:
        named = getattr(module, name)
        if getattr(named, "__module__", "").startswith("clsplat") and not name.startswith("_"):
            text += directive(named, 4)
    return text


def plugin_classes() -> list[type]:
    """Return the base of every family with the classes of the package in the signatures of its methods."""
    found: dict[type, None] = {}
    bases = [*(group for base in families() for group in groups(base)), Curve, Reader]
    for base in bases:
        found[base] = None
        for method in vars(base).values():
            if callable(method) and not method.__name__.startswith("_"):
                hints = typing.get_type_hints(method)
                found |= {k: None for k in hints.values() if getattr(k, "__module__", "").startswith("clsplat.")}
    return [kind for kind in found if isinstance(kind, type)]


def directive(named: Any, level: int, heading: str = "") -> str:
    """Return what mkdocstrings replaces by the documentation of a class or a function."""
    return f"::: {named.__module__}.{named.__qualname__}\n{options(level, heading)}\n"


def options(level: int, heading: str = "") -> str:
    """Return the options of a directive."""
    title = f'      heading: "{heading}"\n' if heading else ""
    return f"    options:\n      heading_level: {level}\n{title}"


def repository_page(file: str) -> str:
    """Return a file of the repository, with links that hold in the site."""
    return (ROOT / file).read_text("utf-8").replace("](docs/", "](")


@functools.cache
def other_pages() -> dict[str, str]:
    """Return these pages by their path in the site."""
    return {
        "reference/commands.md": command_page(),
        "reference/pipelines.md": pipelines_page(),
        "reference/python.md": python_page(),
        "contributing.md": repository_page("CONTRIBUTING.md"),
        "changelog.md": repository_page("CHANGELOG.md"),
    }
