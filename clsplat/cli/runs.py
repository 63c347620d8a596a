"""Commands about runs and pipelines."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clsplat.api import commands
from clsplat.api import commands as api
from clsplat.cli.app import DeviceOption, JsonOption, LiveOption, PipelineArgument, SetOption, command, recipe_names
from clsplat.core import terminal
from clsplat.core.errors import ClsplatError, ConfigError, DataError, OutputError, shell_quote

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
        typer.Option(metavar="M", help="The time that it takes, within about 15 %: trains in as many steps as fit."),
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
    job = commands.resume_job(folder, scene, set_ or (), steps, on)
    if dry_run:
        terminal.show(job.describe(device))
    else:
        _show_summary(commands.run_job(job, device, live))


def _show_summary(folder: Path) -> None:
    from clsplat.runs.status import summary

    for line in summary(folder):
        terminal.print_message(line)


@command(
    "status",
    "clsplat status runs/splat_7k",
    "clsplat status runs/splat_7k --json",
    "clsplat status --schema > status.schema.json",
)
def status(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="RUN|STORE", help="A folder of a run, a matrix or blocks, or a store of cells.", show_default=False
        ),
    ] = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON schema of status.json.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the state of a run, its step and its metrics, or of all cells of a store, from the files alone."""
    from clsplat.runs.status import status_text
    from clsplat.sweeps.status import overview_text
    from clsplat.workflows.blocks import status_table

    if schema:
        terminal.show_json(commands.status_schema())
        return
    if folder is None:
        raise ConfigError("status: expected a run folder, or --schema")
    found = commands.status(folder)
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
        from clsplat.runs.verify import lines, verdict

        _show_findings(found, as_json, lines(found), verdict(found), None if found["whole"] else OutputError)
    elif "model" in found:
        from clsplat.gaussians.validate import lines, verdict

        _show_findings(found, as_json, lines(found), verdict(found), None if found["valid"] else DataError)
    elif as_json:
        terminal.show_json({**found, "valid": True})
    elif "parameters" in found:
        terminal.show(f"{found['path']}: valid; a field of {found['parameters']:,} parameters")
    elif "cells" in found:
        terminal.show(f"{found['path']}: valid; {len(found['cells'])} cells: {', '.join(found['cells'])}")
    else:
        adapts = f"; from the photographs follow {', '.join(found['adapts'])}" if found["adapts"] else ""
        terminal.show(f"{found['path']}: valid; {', '.join(found['stages'])}{adapts}")


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
            terminal.print_message(f"{target}: a copy of {name}; `clsplat check {shell_quote(target)}` validates it")
    elif as_json:
        terminal.show_json(commands.pipelines(name or None))
    else:
        from clsplat.pipeline.recipes import manual_text, summaries_text

        found = commands.pipelines(name or None)
        terminal.show(manual_text(found) if name else summaries_text(found))


# The command that trains a scene in blocks.


@command(
    "blocks",
    "clsplat blocks --scene my_city --plan",
    "clsplat blocks --scene my_city --blocks 9 --out runs/my_city",
    "clsplat blocks my_blocks.yaml --scene my_city --coarse runs/splat_7k",
)
def blocks(
    pipeline: PipelineArgument = "blocks",
    scene: Annotated[
        Path,
        typer.Option(metavar="DIR", help="A COLMAP, Blender or nerfstudio folder, or a run's.", show_default=False),
    ] = ...,  # type: ignore[assignment]
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the runs of all blocks and the model.")] = Path(
        "runs/blocks"
    ),
    count: Annotated[int, typer.Option("--blocks", metavar="N", help="Number of blocks.")] = 4,
    coarse: Annotated[
        str, typer.Option(metavar="PIPELINE|MODEL|RUN", help="What makes the coarse model that is cut, or that model.")
    ] = "blocks_coarse",
    sight: Annotated[
        float, typer.Option(metavar="SHARE", help="Of a view's pixels, above which it belongs to a block.")
    ] = 0.05,
    steps: Annotated[
        Literal["each", "shared"],
        typer.Option(help="Each block has the pipeline's steps, or its share of them by its views."),
    ] = "each",
    plan: Annotated[bool, typer.Option("--plan", help="Train the coarse model, show the plan, and stop.")] = False,
    set_: SetOption = None,
    set_coarse: Annotated[
        list[str] | None,
        typer.Option("--set-coarse", metavar="KEY=VALUE", help="As --set, of the coarse model; may be repeated."),
    ] = None,
    on: Annotated[
        Path | None,
        typer.Option("--on", metavar="FILE", help="Where blocks are trained, as cells of a store: engine, store."),
    ] = None,
    as_json: JsonOption = False,
    device: DeviceOption = None,
) -> None:
    """Train a large scene in blocks that fit the device, one after the other or on several, and merge them."""
    from clsplat.workflows.blocks import table

    if as_json:
        terminal.keep_stdout_for_json()
    found = api.train_in_blocks(
        scene,
        out,
        pipeline,
        blocks=count,
        coarse=coarse,
        sight=sight,
        steps=steps,
        overrides=set_ or (),
        coarse_overrides=set_coarse or (),
        only_plan=plan,
        on=on,
        device=device,
    )
    if as_json:
        terminal.show_json(found)
        return
    terminal.show(table(found))
    if plan:
        terminal.print_message(f"{out}/partition.json: the plan; the same command without --plan trains the blocks")
    else:
        terminal.print_message(f"`clsplat view {shell_quote(found['run'])}` shows the merged model")


# Commands about the cells of a sweep.

StoreOption = Annotated[Path, typer.Option("--store", metavar="DIR", help="The store of cells, a shared folder.")]


@command(
    "cell",
    "clsplat cell sweep.yaml --index 3 --store /shared/store",
    "clsplat cell splat_7k --scene my_scene --store runs/store",
)
def cell(
    pipeline: PipelineArgument,
    store: StoreOption,
    scene: Annotated[Path | None, typer.Option(metavar="DIR", help="The photographs, as for run.")] = None,
    index: Annotated[
        int | None,
        typer.Option(metavar="N", help="The cell of a matrix, counted from 0, such as $SLURM_ARRAY_TASK_ID."),
    ] = None,
    device: DeviceOption = None,
    set_: SetOption = None,
) -> None:
    """Run one cell of a matrix, unless its result is in the store; what every queue can call."""
    commands.run_cell(pipeline, store, scene, index=index, set=set_ or (), device=device)


@command("cancel", "clsplat cancel runs/store", "clsplat cancel runs/store seed=1")
def cancel(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="The store of cells.")],
    cell: Annotated[str | None, typer.Argument(metavar="[CELL]", help="A cell's name or key; default: all.")] = None,
) -> None:
    """Let cells that run, on whatever machine, save their state and stop."""
    terminal.print_message(f"{store}: {commands.cancel(store, cell)} asked to stop")


@command(
    "worker",
    "clsplat worker --scheduler dask://127.0.0.1:8786",
    "clsplat worker --scheduler dask://head:8786 --insecure",
)
def worker(
    scheduler: Annotated[str, typer.Option(metavar="ADDRESS", help="dask://HOST:PORT, or tls://HOST:PORT.")],
    device: Annotated[
        list[str] | None, typer.Option("--device", metavar="NAME", help="A device; may be repeated; default: all.")
    ] = None,
    tls_ca: Annotated[str | None, typer.Option(metavar="FILE", help="Certificate of the authority, PEM.")] = None,
    tls_cert: Annotated[str | None, typer.Option(metavar="FILE", help="Certificate of this machine, PEM.")] = None,
    tls_key: Annotated[str | None, typer.Option(metavar="FILE", help="Its private key, PEM.")] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Without TLS: whoever reaches the scheduler's port can run code.")
    ] = False,
) -> None:
    """Offer the devices of this machine to a Dask scheduler, one process a device, until it ends."""
    commands.work_for(scheduler, device, tls=(tls_ca, tls_cert, tls_key), insecure=insecure)
