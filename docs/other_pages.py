"""The pages about commands, shipped pipelines and Python names, and those that show a file of the repository."""

import functools
import typing
from typing import Any

import typer
from families import ROOT, families

import clsplat
from clsplat import errors
from clsplat.cli import app
from data_tools.__main__ import app as tools

OTHER_CODES = {0: "Done.", 1: "A defect of clsplat: please report it."}


def command_page() -> str:
    """Return every command with its options, and the exit codes."""
    group = typer.main.get_command(app)
    text = f"# Command line\n\n{group.help}\n\n{option_table(group, 'clsplat')}"
    text += "\n".join(section(command, f"clsplat {name}") for name, command in group.commands.items())
    data = typer.main.get_command(tools)
    text += "".join(section(command, f"clsplat data {name}") for name, command in data.commands.items())
    codes = OTHER_CODES | {kind.exit_code: summary(kind) for kind in errors.ClsplatError.__subclasses__()}
    rows = "".join(f"| {code} | {meaning} |\n" for code, meaning in sorted(codes.items()))
    return (
        f"{text}\n## Exit codes\n\nAn error is one line: what is wrong, where, what was expected and what to do.\n\n"
        f"| code | meaning |\n|---|---|\n{rows}"
    )


def section(command: Any, name: str) -> str:
    """Return a command's help: its usage, its purpose and its options."""
    arguments = [p for p in command.params if p.param_type_name == "argument"]
    usage = " ".join([name, *(str(p.name).upper().rstrip("_") for p in arguments), "[OPTIONS]"])
    return f"## `{name}`\n\n```sh\n{usage}\n```\n\n{command.help or ''}\n\n{option_table(command, name)}"


def option_table(command: Any, name: str) -> str:
    """Return a table of arguments and options."""
    context = command.make_context(name, [], resilient_parsing=True)
    records = [p.get_help_record(context) for p in command.params]
    escaped = "\\["  # brackets make no link
    rows = "".join(
        f"| `{cell(r[0])}` | {cell(r[1]).replace('[', escaped)} |\n" for r in records if r and r[0] != "--help"
    )
    return f"| option | meaning |\n|---|---|\n{rows}\n" if rows else ""


def cell(text: str) -> str:
    """Return a text that does not break a table."""
    return " ".join(text.split()).replace("|", "\\|")


def summary(kind: type) -> str:
    return (kind.__doc__ or "").strip().splitlines()[0]


def pipelines_page() -> str:
    """Return the shipped pipelines: what their headers say, and the files."""
    text = "# Shipped pipelines\n\n`clsplat run NAME --scene DIR` runs one. Copy a file to make your own variant.\n\n"
    for file in sorted((ROOT / "pipelines").glob("*.yaml")):
        lines = file.read_text().splitlines()
        count = next(i for i, line in enumerate(lines) if not line.startswith("#"))
        header = "\n".join(line.removeprefix("# ") for line in lines[:count]).replace(".\n", ".\n\n")
        body = "\n".join(f"    {line}" for line in lines[count:])
        text += f'## {file.stem}\n\n{header}\n\n??? note "{file.name}"\n\n    ```yaml\n{body}\n    ```\n\n'
    return text


def python_page() -> str:
    """Return the public names of the package, then the classes that a plug-in meets."""
    public = [name for name in getattr(clsplat, "__all__", []) if not name.startswith("_")]
    text = "# Python reference\n\n" + "".join(directive(getattr(clsplat, name)) for name in public)
    text += "## For plug-ins\n\nThe bases of what a pipeline file can name, and what their methods are given.\n\n"
    return text + "".join(directive(kind) for kind in plugin_classes())


def plugin_classes() -> list[type]:
    """Return the base of every family with the classes of the package in the signatures of its methods."""
    found: dict[type, None] = {}
    for base in families():
        found[base] = None
        for method in vars(base).values():
            if callable(method) and not method.__name__.startswith("_"):
                hints = typing.get_type_hints(method)
                found |= {k: None for k in hints.values() if getattr(k, "__module__", "").startswith("clsplat.")}
    return [kind for kind in found if isinstance(kind, type)]


def directive(named: Any) -> str:
    """Return what mkdocstrings replaces by the documentation of a class, a function or a module."""
    path = named.__name__ if not hasattr(named, "__module__") else f"{named.__module__}.{named.__qualname__}"
    return f"::: {path}\n\n"


def repository_page(file: str) -> str:
    """Return a file of the repository, with links that hold in the site."""
    return (ROOT / file).read_text().replace("](docs/", "](")


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
