"""The command that trains a scene in blocks."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from clsplat import terminal
from clsplat.api import blocks as api
from clsplat.cli.app import DeviceOption, JsonOption, PipelineArgument, SetOption, command
from clsplat.errors import in_shell


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
    from clsplat.blocks.table import table

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
        terminal.remark(f"{out}/partition.json: the plan; the same command without --plan trains the blocks")
    else:
        terminal.remark(f"`clsplat view {in_shell(found['run'])}` shows {found['metrics']['gaussians']:,} Gaussians")
