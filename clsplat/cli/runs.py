"""Define the commands for runs and pipelines."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clsplat.api import commands
from clsplat.cli.app import DeviceOption, JsonOption, LiveOption, PipelineArgument, SetOption, command, recipe_names
from clsplat.core import terminal
from clsplat.core.errors import ClsplatError, ConfigError, DataError, OutputError, shell_quote

OnOption = Annotated[
    Path | None,
    typer.Option("--on", metavar="FILE", help="YAML file with the engine, store, and devices for cells or blocks."),
]


@command(
    "run",
    "clsplat run splat_7k --scene my_scene",
    "clsplat run splat_7k --scene my_scene --out runs/a --set optimize.steps=3000",
    "clsplat run splat_7k --scene my_scene --live",
    "clsplat run splat_7k --scene my_scene --minutes 5",
    "clsplat run photos --scene my_photos --quality high",
)
def run(
    pipeline: PipelineArgument,
    scene: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Dataset folder (COLMAP, Blender, nerfstudio, …); for `photos`, a folder of photos."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="The run folder; default: runs/NAME.")] = None,
    device: DeviceOption = None,
    set_: SetOption = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the newest checkpoint.")] = False,
    restart: Annotated[
        bool, typer.Option("--restart", help="Start over in the folder of an earlier run; removes its checkpoints.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check everything and list what would run.")] = False,
    live: LiveOption = None,
    minutes: Annotated[
        float | None,
        typer.Option(metavar="M", help="Choose the number of steps so that the run takes M minutes, within about 15%."),
    ] = None,
    quality: Annotated[
        Literal["draft", "standard", "high"],
        typer.Option(help="For `photos`: `draft` for a first look, `high` for larger images and more steps."),
    ] = "standard",
    on: OnOption = None,
) -> None:
    """Run a pipeline, or all cells of a matrix."""
    if quality != "standard":
        pipeline = commands.find_variant(pipeline, quality)
    if minutes is not None and dry_run:
        raise ConfigError(
            "--minutes has to train a few steps to measure their time, and --dry-run does not train; "
            "use only one of them"
        )
    if resume and restart:
        raise ConfigError("--resume continues a run and --restart starts it over; use only one of them")
    start: Literal["new", "resume", "restart"] = "resume" if resume else "restart" if restart else "new"
    if dry_run:
        terminal.show(commands.describe_run(pipeline, scene, out, set=set_ or (), device=device, start=start, on=on))
    else:
        folder = commands.run(
            pipeline, scene, out, set=set_ or (), device=device, start=start, live=live, minutes=minutes, on=on
        )
        _show_summary(folder)


@command(
    "resume",
    "clsplat resume runs/splat_7k",
    "clsplat resume runs/splat_7k --steps 14000",
    "clsplat resume runs/splat_7k --scene moved/my_scene",
)
def resume(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run or a matrix.")],
    scene: Annotated[
        Path | None, typer.Option(metavar="DIR", help="The new path of the dataset folder, if it was moved.")
    ] = None,
    device: DeviceOption = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Train up to this step; the result equals that of a new run with N steps, unless an opacity reset or "
            "pruning was due at the former last step.",
        ),
    ] = None,
    set_: SetOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check everything and list what would run.")] = False,
    live: LiveOption = None,
    on: OnOption = None,
) -> None:
    """Continue a run from its newest checkpoint, or train a finished run longer."""
    job = commands.resume_job(folder, scene, set_ or (), steps, on)
    if dry_run:
        terminal.show(job.describe(device))
    else:
        _show_summary(commands.run_job(job, device, live))


def _show_summary(folder: Path) -> None:
    from clsplat.runs.status import summarize_run

    for line in summarize_run(folder):
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
            metavar="RUN|STORE",
            help="The folder of a run, a matrix, or a scene in blocks, or a store of cells.",
            show_default=False,
        ),
    ] = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON schema of status.json.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Show the state, step, and metrics of a run, or of all cells of a store."""
    from clsplat.runs.status import format_status
    from clsplat.sweeps.status import format_store_status
    from clsplat.workflows.blocks import format_status_table

    if schema:
        terminal.show_json(commands.status_schema())
        return
    if folder is None:
        raise ConfigError("status: expected a run folder, or --schema")
    state = commands.status(folder)
    if as_json:
        terminal.show_json(state)
    else:
        is_store, in_blocks = "store" in state, "in_blocks" in state
        to_text = format_store_status if is_store else format_status_table if in_blocks else format_status
        terminal.show(to_text(state))


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
            help="A pipeline (as for `run`), a run folder, or a model file.",
        ),
    ] = "",
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON schema of pipeline files, for editors.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Validate a pipeline without running it, verify the files of a run folder, or inspect a model file."""
    if schema:
        terminal.show_json(commands.pipeline_schema())
        return
    if not pipeline:
        raise ConfigError("check: expected a pipeline, a run folder, a model, or --schema")
    result = commands.check(pipeline)
    if "objects" in result:
        from clsplat.runs.verify import format_files, verdict

        _show_findings(result, as_json, format_files(result), verdict(result), None if result["whole"] else OutputError)
    elif "model" in result:
        from clsplat.gaussians.validate import format_report as model_lines
        from clsplat.gaussians.validate import verdict as model_verdict

        error = None if result["valid"] else DataError
        _show_findings(result, as_json, model_lines(result), model_verdict(result), error)
    elif as_json:
        terminal.show_json({**result, "valid": True})
    elif "parameters" in result:
        terminal.show(f"{result['path']}: valid; a field with {result['parameters']:,} parameters")
    elif "cells" in result:
        terminal.show(f"{result['path']}: valid; {len(result['cells'])} cells: {', '.join(result['cells'])}")
    else:
        note = f"; the photos decide {', '.join(result['adapts'])}" if result["adapts"] else ""
        terminal.show(f"{result['path']}: valid; {', '.join(result['stages'])}{note}")


def _show_findings(
    result: dict[str, Any], as_json: bool, text: str, verdict: str, error: type[ClsplatError] | None
) -> None:
    """Show the result of `check` and its verdict.  If there is an `error`, raise it with the verdict."""
    if as_json:
        terminal.show_json(result)
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
    """List the shipped pipelines, or the --set keys of a pipeline."""
    if copy is not None:
        if not name:
            raise ConfigError("pipelines: --copy needs the name of a pipeline; `clsplat pipelines` lists them")
        target = commands.copy_pipeline(name, copy)
        if as_json:
            terminal.show_json({"copy": str(target)})
        else:
            terminal.print_message(f"{target}: a copy of {name}; `clsplat check {shell_quote(target)}` validates it")
    elif as_json:
        terminal.show_json(commands.pipelines(name or None))
    else:
        from clsplat.pipeline.recipes import manual_text, summaries_text

        result = commands.pipelines(name or None)
        terminal.show(manual_text(result) if name else summaries_text(result))


# Training a large scene in blocks.


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
        typer.Option(metavar="DIR", help="Dataset or run folder.", show_default=False),
    ] = ...,  # type: ignore[assignment]
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the block runs and the merged model.")] = Path(
        "runs/blocks"
    ),
    count: Annotated[int, typer.Option("--blocks", metavar="N", help="Number of blocks.")] = 4,
    coarse: Annotated[
        str,
        typer.Option(metavar="PIPELINE|MODEL|RUN", help="Coarse model to partition, or a pipeline that trains it."),
    ] = "blocks_coarse",
    min_coverage: Annotated[
        float,
        typer.Option(metavar="FRACTION", help="Fraction of a view that a block must cover to train on the view."),
    ] = 0.05,
    steps: Annotated[
        Literal["each", "shared"],
        typer.Option(help="Steps of each block: all of them, or proportional to its number of views."),
    ] = "each",
    plan: Annotated[bool, typer.Option("--plan", help="Only train the coarse model and show the plan.")] = False,
    set_: SetOption = None,
    set_coarse: Annotated[
        list[str] | None,
        typer.Option("--set-coarse", metavar="KEY=VALUE", help="Like --set, for the coarse model; may be repeated."),
    ] = None,
    on: OnOption = None,
    as_json: JsonOption = False,
    device: DeviceOption = None,
) -> None:
    """Train a large scene in blocks that fit the device, one by one or on several devices, and merge them."""
    from clsplat.workflows.blocks import format_table

    if as_json:
        terminal.keep_stdout_for_json()
    result = commands.train_in_blocks(
        scene,
        out,
        pipeline,
        blocks=count,
        coarse=coarse,
        min_coverage=min_coverage,
        steps=steps,
        overrides=set_ or (),
        coarse_overrides=set_coarse or (),
        only_plan=plan,
        on=on,
        device=device,
    )
    if as_json:
        terminal.show_json(result)
        return
    terminal.show(format_table(result))
    if plan:
        terminal.print_message(f"{out}/partition.json: the plan; run the command without --plan to train the blocks")
    else:
        terminal.print_message(f"`clsplat view {shell_quote(result['run'])}` shows the merged model")


# Commands for the cells of a sweep.

StoreOption = Annotated[Path, typer.Option("--store", metavar="DIR", help="The store of cells (a shared folder).")]


@command(
    "cell",
    "clsplat cell sweep.yaml --index 3 --store /shared/store",
    "clsplat cell splat_7k --scene my_scene --store runs/store",
)
def cell(
    pipeline: PipelineArgument,
    store: StoreOption,
    scene: Annotated[Path | None, typer.Option(metavar="DIR", help="The dataset, as for `run`.")] = None,
    index: Annotated[
        int | None,
        typer.Option(metavar="N", help="Index of the cell in a matrix, from 0, such as $SLURM_ARRAY_TASK_ID."),
    ] = None,
    device: DeviceOption = None,
    set_: SetOption = None,
) -> None:
    """Run one cell of a matrix, unless its result is in the store.  Use it in job arrays of any scheduler."""
    commands.run_cell(pipeline, store, scene, index=index, set=set_ or (), device=device)


@command("cancel", "clsplat cancel runs/store", "clsplat cancel runs/store seed=1")
def cancel(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="The folder of the store.")],
    cell: Annotated[
        str | None, typer.Argument(metavar="[CELL]", help="A cell's name or key; default: all cells.")
    ] = None,
) -> None:
    """Request that running cells, on any machine, save their state and stop."""
    terminal.print_message(f"{store}: stop requested for {commands.cancel(store, cell)}")


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
    tls_ca: Annotated[str | None, typer.Option(metavar="FILE", help="CA certificate, PEM.")] = None,
    tls_cert: Annotated[str | None, typer.Option(metavar="FILE", help="Certificate of this machine, PEM.")] = None,
    tls_key: Annotated[str | None, typer.Option(metavar="FILE", help="Private key of the certificate, PEM.")] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Skip TLS; anyone who can reach the scheduler's port can run code.")
    ] = False,
) -> None:
    """Offer this machine's devices to a Dask scheduler, one process per device, until the scheduler exits."""
    commands.run_worker(scheduler, device, tls=(tls_ca, tls_cert, tls_key), insecure=insecure)
