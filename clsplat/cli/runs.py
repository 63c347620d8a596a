"""Commands about runs and pipelines."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clsplat import terminal
from clsplat.api import commands
from clsplat.cli.app import DeviceOption, JsonOption, LiveOption, PipelineArgument, SetOption, command, recipe_names
from clsplat.errors import ClsplatError, ConfigError, DataError, OutputError, in_shell

OnOption = Annotated[
    Path | None,
    typer.Option("--on", metavar="FILE", help="Where the cells of a matrix run: engine, store, devices."),
]


@command(
    "run",
    "clsplat run splat_7k --scene my_scene",
    "clsplat run splat_7k --scene my_scene --out runs/a --set optimize.steps=3000",
    "clsplat run splat_7k --scene my_scene --live",
    "clsplat run splat_7k --scene my_scene --minutes 5",
)
def run(
    pipeline: PipelineArgument,
    scene: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="A COLMAP, Blender or nerfstudio folder, or a run's; for `photos`, photographs."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="The run folder; default: runs/NAME.")] = None,
    device: DeviceOption = None,
    set_: SetOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the newest checkpoint.")] = False,
    restart: Annotated[
        bool, typer.Option("--restart", help="Begin again in a folder that holds a run, without its checkpoints.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check everything and say what would run.")] = False,
    live: LiveOption = None,
    minutes: Annotated[
        float | None,
        typer.Option(metavar="M", help="The time that it takes: trains in as many steps as fit, which it says before."),
    ] = None,
    on: OnOption = None,
) -> None:
    """Run a pipeline, or all cells of a matrix."""
    if minutes is not None and dry_run:
        raise ConfigError("--minutes rehearses the pipeline on the device, which --dry-run does not; give one of them")
    if resume and restart:
        raise ConfigError("--resume goes on with a run and --restart begins it again; give one of them")
    start: Literal["new", "resume", "restart"] = "resume" if resume else "restart" if restart else "new"
    if dry_run:
        terminal.show(commands.describe_run(pipeline, scene, out, set=set_ or (), device=device, start=start, on=on))
    else:
        found = commands.run(
            pipeline, scene, out, set=set_ or (), device=device, start=start, live=live, minutes=minutes, on=on
        )
        _show_summary(found)


@command(
    "resume",
    "clsplat resume runs/splat_7k",
    "clsplat resume runs/splat_7k --steps 14000",
    "clsplat resume runs/splat_7k --scene moved/my_scene",
)
def resume(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder, or that of a matrix.")],
    scene: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where its photographs are now; default: where they were.")
    ] = None,
    device: DeviceOption = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Train to this step, further than before: optimize.steps, or train_field.steps.",
        ),
    ] = None,
    set_: SetOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check everything and say what would run.")] = False,
    live: LiveOption = None,
    on: OnOption = None,
) -> None:
    """Go on with a run from its newest checkpoint, or train one that is done for longer."""
    changes = [*(set_ or ()), *([f"{commands.steps_key(folder)}={steps}"] if steps is not None else [])]
    if dry_run:
        file = folder / "pipeline.yaml"
        terminal.show(commands.describe_run(file, scene, folder, set=changes, device=device, start="resume", on=on))
    else:
        _show_summary(commands.resume(folder, scene, set=changes, device=device, live=live, on=on))


def _show_summary(folder: Path) -> None:
    from clsplat.runs.summary import summary

    for line in summary(folder):
        terminal.remark(line)


@command(
    "status",
    "clsplat status runs/splat_7k",
    "clsplat status runs/splat_7k --json",
    "clsplat status runs/store --html store.html",
    "clsplat status --schema > status.schema.json",
)
def status(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="RUN|STORE", help="A folder of a run, a matrix or blocks, or a store of cells.", show_default=False
        ),
    ] = None,
    html: Annotated[Path | None, typer.Option("--html", metavar="FILE", help="Write a page of a store.")] = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON schema of status.json.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the state of a run, its step and its metrics, or of all cells of a store, from the files alone."""
    from clsplat.blocks.table import status_table
    from clsplat.cluster.overview import overview_text
    from clsplat.runs.status import status_text

    if schema:
        terminal.show_json(commands.status_schema())
        return
    if folder is None:
        raise ConfigError("status: expected a run folder, or --schema")
    found = commands.status(folder, html)
    if as_json:
        terminal.show_json(found)
    else:
        text = overview_text if "store" in found else status_table if "in_blocks" in found else status_text
        terminal.show(text(found))


@command(
    "check",
    "clsplat check my_pipeline.yaml",
    "clsplat check runs/splat_7k",
    "clsplat check model.spz --json",
    "clsplat check --schema > pipeline.schema.json",
)
def check(
    pipeline: Annotated[
        str,
        typer.Argument(
            metavar="PIPELINE|RUN|MODEL",
            autocompletion=recipe_names,
            show_default=False,
            help="As for run; or a run folder, or a model file.",
        ),
    ] = "",
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON schema of pipeline files, for editors.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Validate a pipeline without running it, verify every file of a run folder, or look at a model file."""
    if schema:
        terminal.show_json(commands.pipeline_schema())
        return
    if not pipeline:
        raise ConfigError("check: expected a pipeline, a run folder, a model, or --schema")
    found = commands.check(pipeline)
    if "objects" in found:
        from clsplat.runs.verdict import lines, verdict

        _show_findings(found, as_json, lines(found), verdict(found), None if found["whole"] else OutputError)
    elif "model" in found:
        from clsplat.gaussians.checkup import lines, verdict

        _show_findings(found, as_json, lines(found), verdict(found), None if found["valid"] else DataError)
    elif as_json:
        terminal.show_json({**found, "valid": True})
    elif "parameters" in found:
        terminal.show(f"{found['path']}: valid; a field of {found['parameters']:,} parameters")
    elif "cells" in found:
        terminal.show(f"{found['path']}: valid; {len(found['cells'])} cells: {', '.join(found['cells'])}")
    else:
        terminal.show(f"{found['path']}: valid; {', '.join(found['stages'])}")


def _show_findings(
    found: dict[str, Any], as_json: bool, text: str, verdict: str, error: type[ClsplatError] | None
) -> None:
    """Show what `check` found, and the verdict on it, which is raised as an error where there is one."""
    if as_json:
        terminal.show_json(found)
    else:
        terminal.show(text)
    if error:
        raise error(verdict)
    if not as_json:
        terminal.show(verdict)


@command(
    "pipelines",
    "clsplat pipelines",
    "clsplat pipelines splat_7k",
    "clsplat pipelines splat_7k --copy my_pipeline.yaml",
)
def pipelines(
    name: PipelineArgument = "",
    copy: Annotated[Path | None, typer.Option(metavar="FILE", help="Copy the pipeline to a new file.")] = None,
    as_json: JsonOption = False,
) -> None:
    """List the shipped pipelines, or the keys of one as --set takes them."""
    if copy is not None:
        if not name:
            raise ConfigError("pipelines: --copy needs the name of a pipeline")
        target = commands.copy_pipeline(name, copy)
        if as_json:
            terminal.show_json({"copy": str(target)})
        else:
            terminal.remark(f"{target}: a copy of {name}; `clsplat check {in_shell(target)}` validates it")
    elif as_json:
        terminal.show_json(commands.pipelines(name or None))
    else:
        from clsplat.pipeline.recipes import manual_text, summaries_text

        found = commands.pipelines(name or None)
        terminal.show(manual_text(found) if name else summaries_text(found))
