"""Define the command-line application: global options, suggestions for misspelled commands, shared options."""

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from clsplat.api import arguments, tools
from clsplat.core import terminal
from clsplat.core.errors import ConfigError, MemoryLimitError
from clsplat.core.machine import process_limit
from clsplat.core.resources import full_version
from clsplat.core.signals import stop_when_stdin_closes
from clsplat.pipeline.files import shipped_pipelines

SYNONYMS = {
    **dict.fromkeys(("train", "fit", "optimize", "start"), "run"),
    **dict.fromkeys(("eval", "measure", "metrics", "score"), "evaluate"),
    **dict.fromkeys(("info", "describe"), "inspect"),
    **dict.fromkeys(("show", "viewer", "look", "walk"), "view"),
    **dict.fromkeys(("list", "ls", "recipes"), "pipelines"),
    **dict.fromkeys(("validate", "lint", "verify"), "check"),
    **dict.fromkeys(("continue", "restart"), "resume"),
    **dict.fromkeys(("progress", "ps"), "status"),
    **dict.fromkeys(("benchmark", "time", "profile"), "bench"),
    **dict.fromkeys(("prove", "diagnose", "selftest"), "doctor"),
    **dict.fromkeys(("export", "transform", "merge"), "convert"),
    **dict.fromkeys(("level", "georeference", "register"), "align"),
    **dict.fromkeys(("shrink", "prune", "quantize"), "compress"),
    **dict.fromkeys(("decimate", "simplify", "levels", "stream"), "lod"),
    **dict.fromkeys(("split", "tiles", "city"), "blocks"),
    **dict.fromkeys(("surface", "collider"), "mesh"),
    "diff": "compare",
    "help": "--help",
    "version": "--version",
}

MIN_ADDRESS_SPACE = 1 << 30  # bytes; OpenCL runtimes crash with less

ORDER = [
    *("run", "blocks", "resume", "status", "cell", "cancel", "worker"),
    *("check", "pipelines", "devices", "doctor", "inspect"),
    *("render", "view", "evaluate", "align", "convert", "compress", "lod", "mesh", "compare", "bench", "data"),
]


class WrappedError(Exception):
    """An error whose cause is an exception that typer would otherwise handle itself."""


class Commands(TyperGroup):
    """The commands of clsplat; the commands of `data` are imported when first used."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted([*super().list_commands(ctx), "data"], key=ORDER.index)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name == "data" and cmd_name not in self.commands:
            from clsplat.cli.data import app as data_app

            self.commands[cmd_name] = data = typer.main.get_command(data_app)
            data.name = cmd_name
            data.short_help = "Prepare datasets: photos, video, undistort, cameras, …"
        return super().get_command(ctx, cmd_name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        name = args[0]
        if not name.startswith("-") and not ctx.resilient_parsing and self.get_command(ctx, name) is None:
            best = SYNONYMS.get(name) or next(iter(difflib.get_close_matches(name, self.list_commands(ctx), n=1)), None)
            if best is None and name in self.get_command(ctx, "data").commands:
                best = f"data {name}"
            hint = f"did you mean '{best}'?" if best else "`clsplat --help` lists the commands"
            raise ConfigError(f"no command '{name}'; {hint}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (EOFError, KeyboardInterrupt, OSError) as error:
            raise WrappedError from error


def examples(*lines: str) -> str:
    """Format examples for the end of a help text."""
    return "Examples:\n" + "\n".join(f"  {line}" for line in lines)


app = typer.Typer(
    cls=Commands,
    help="3D Gaussian Splatting on any OpenCL device.",
    epilog=examples(
        "clsplat devices",
        "clsplat run quickstart --scene my_scene",
        "clsplat run photos --scene my_photos",
    ),
    invoke_without_command=True,
    pretty_exceptions_enable=False,
)


def command(name: str, *lines: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that registers a command.  lines: examples for its help text."""
    return app.command(name, epilog=examples(*lines))


@dataclass(frozen=True)
class Common:
    """The global options."""

    device: str | None


def _show_version(value: bool) -> None:
    if value:
        terminal.show(f"clsplat {full_version()}")
        raise typer.Exit


@app.callback()
def common(
    context: typer.Context,
    device: Annotated[
        str | None, typer.Option(metavar="NAME", help="OpenCL device for commands that take --device.")
    ] = None,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show tracebacks and debug lines; may also come after the command.")
    ] = False,
    plugin: Annotated[
        list[Path] | None,
        typer.Option(
            "--plugin", metavar="FILE", help="Plug-in to load: a Python file with custom methods; may be repeated."
        ),
    ] = None,
    attended: Annotated[
        bool, typer.Option("--attended", hidden=True, help="Shut down when standard input closes, as on SIGTERM.")
    ] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    terminal.start_logging(debug)
    limit = process_limit("RLIMIT_AS")
    if limit is not None and limit < MIN_ADDRESS_SPACE:
        raise MemoryLimitError(
            f"`ulimit -v` limits clsplat to {limit >> 20} MiB of address space; libraries crash with less than "
            f"{MIN_ADDRESS_SPACE >> 20} MiB: raise the limit"
        )
    if attended:
        stop_when_stdin_closes()
    context.obj = Common(device)
    if context.invoked_subcommand is not None:
        arguments.load_plugins()
    for file in plugin or []:
        tools.load_plugin(file)
    if context.invoked_subcommand is None:
        print(context.get_help(), end="")
        raise ConfigError("expected a command")


def _device_or_global(context: typer.Context, device: str | None) -> str | None:
    """Return the device given after the command, or else the global --device."""
    common = context.find_root().obj
    return device if device is not None or common is None else common.device


def recipe_names(incomplete: str) -> list[str]:
    return [name for name in shipped_pipelines() if name.startswith(incomplete)]


DeviceOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        callback=_device_or_global,
        help="Part of a device name, as listed by `clsplat devices`; NAME:1 is the second match.",
    ),
]
PipelineArgument = Annotated[
    str,
    typer.Argument(
        metavar="PIPELINE",
        autocompletion=recipe_names,
        show_default=False,
        help="A pipeline file, or the name of a shipped pipeline.",
    ),
]
ModelArgument = Annotated[Path, typer.Argument(metavar="MODEL|RUN", help="A run folder, or a model file with --scene.")]
SceneOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Dataset folder (COLMAP, Blender, nerfstudio, …) or run folder; default: the scene of the run.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE …", help="Change settings; `clsplat pipelines NAME` lists them."),
]
LiveOption = Annotated[
    int | None,
    typer.Option(
        "--live",
        metavar="[PORT]",
        min=0,
        max=65535,
        help="Show the model in a browser while it trains; default port: 8710, or the next free one.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON.")]
