"""Make the pages about commands, shipped pipelines, and Python names, and those from files of the repository."""

import functools
import re
from typing import Any

import typer
from families import ROOT
from python_pages import python_pages

from clsplat.cli import app
from clsplat.cli.data import app as tools
from clsplat.core import errors
from clsplat.pipeline.files import shipped_pipelines
from clsplat.pipeline.yaml_file import read_pipeline

OTHER_CODES = {0: "Done.", 1: "Internal error, a defect of clsplat: `--debug` shows it; please report it."}


def command_page() -> str:
    """Return every command with its options, and the exit codes."""
    group = typer.main.get_command(app)
    text = f"# Command line\n\n{group.help} Options before the command:\n\n{option_table(group, 'clsplat')}"
    names = [name for name in group.list_commands(None) if name != "data"]
    text += "".join(section(group.get_command(None, name), f"clsplat {name}") for name in names)
    data = typer.main.get_command(tools)
    text += "".join(section(command, f"clsplat data {name}") for name, command in data.commands.items())
    codes = OTHER_CODES | {kind.exit_code: summary(kind) for kind in errors.ClsplatError.__subclasses__()}
    rows = "".join(f"| {code} | {meaning} |\n" for code, meaning in sorted(codes.items()))
    return (
        f"{text}\n## Exit codes\n\nAn error is one line: where, what is wrong, what was expected, and what to do.\n\n"
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
        f"| `{option_text(r[0])}` | {table_cell(r[1]).replace('[', escaped)} |\n"
        for r in records
        if r and r[0] != "--help"
    )
    return f"| option | meaning |\n|---|---|\n{rows}\n" if rows else ""


def option_text(text: str) -> str:
    """Return an option and its value, without names of Python types."""
    return re.sub(r" <(?:path|str|list\[\w+\])>", "", " ".join(text.split())).replace("|", "/")


def table_cell(text: str) -> str:
    """Return text for a cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def summary(kind: type) -> str:
    return (kind.__doc__ or "").strip().splitlines()[0]


def pipelines_page() -> str:
    """Return the shipped pipelines: their headers and their files."""
    text = "# Shipped pipelines\n\nRun one with `clsplat run NAME --scene DIR`. To make a variant, copy a file with "
    text += "`clsplat pipelines NAME --copy FILE`.\n\n"
    for name, file in shipped_pipelines().items():
        lines = read_pipeline(file).splitlines()
        count = next(i for i, line in enumerate(lines) if not line.startswith("#"))
        header = "\n".join(line.lstrip("# ") for line in lines[:count]).replace(".\n", ".\n\n")
        body = "\n".join(f"    {line}" for line in lines[count:])
        text += f'## {name}\n\n{header}\n\n??? note "{file.name}"\n\n    ```yaml\n{body}\n    ```\n\n'
    return text


def repository_page(file: str) -> str:
    """Return a file of the repository, with its links changed for the site."""
    return (ROOT / file).read_text("utf-8").replace("](docs/", "](")


@functools.cache
def other_pages() -> dict[str, str]:
    """Return these pages by their path in the site."""
    return {
        "reference/commands.md": command_page(),
        "reference/pipelines.md": pipelines_page(),
        **python_pages(),
        "contributing.md": repository_page("CONTRIBUTING.md"),
        "changelog.md": repository_page("CHANGELOG.md"),
    }
