"""Commands about trained models."""

import json
import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from clsplat import terminal
from clsplat.api import commands
from clsplat.cli.app import DeviceOption, ModelArgument, SceneOption, command
from clsplat.errors import ConfigError, quoted


@command(
    "render",
    "clsplat render runs/splat_7k --out images",
    "clsplat render point_cloud.ply --scene my_scene --split all --format npy",
)
def render(
    model: ModelArgument,
    scene: SceneOption = None,
    split: Annotated[Literal["test", "train", "all"], typer.Option(help="Which views.")] = "test",
    scale: Annotated[
        float | None,
        typer.Option(min=1, metavar="N", help="Divide image sizes by this; default: as the run did, 1 for a file."),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the images.")] = Path("renders"),
    format_: Annotated[
        Literal["png", "npy"], typer.Option("--format", help="8-bit images, or float32 arrays.")
    ] = "png",
    device: DeviceOption = None,
) -> None:
    """Render a model at the views of a scene, one file for each, named as the view."""
    if scale is not None and not math.isfinite(scale):
        raise ConfigError(f"--scale {scale}: expected a finite number of at least 1")
    count = commands.render_views(model, scene, out, split=split, downscale=scale, kind=format_, device=device)
    terminal.remark(f"{count} images written to {out}")


@command(
    "evaluate",
    "clsplat evaluate runs/splat_7k",
    "clsplat evaluate point_cloud.ply --scene my_scene --downscales 1,2,4,8",
)
def evaluate(
    model: ModelArgument,
    scene: SceneOption = None,
    downscales: Annotated[
        str | None,
        typer.Option(
            "--downscales",
            "--scales",
            metavar="N,…",
            help="Divide image sizes by these; default: as the run did, 1 for a file.",
        ),
    ] = None,
    metrics: Annotated[
        str, typer.Option(metavar="NAME,…", help="Of psnr, ssim, ms_ssim and flip, separated by commas.")
    ] = "psnr,ssim",
    lpips: Annotated[
        Path | None, typer.Option(metavar="FILE", help="An ONNX file of LPIPS; without it lpips is null.")
    ] = None,
    lpips_input: Annotated[Literal["-1..1", "0..1"], typer.Option(help="Values that LPIPS reads.")] = "-1..1",
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the metrics here as JSON; default: print them.")
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Measure a model on a scene's test and training views."""
    from clsplat.files import check_result, write_text

    if out is None:
        terminal.keep_stdout_for_json()
    else:
        check_result(out, ".json")
    try:
        divisors = None if downscales is None else [float(text) for text in downscales.split(",")]
    except ValueError:
        expected = "expected numbers, separated by commas, such as 1,2,4"
        raise ConfigError(f"--downscales {quoted(downscales)}: {expected}") from None
    found = commands.evaluate(
        model,
        scene,
        downscales=divisors,
        metrics=metrics.split(","),
        lpips=lpips,
        lpips_input=lpips_input,
        device=device,
    )
    if out is None:
        terminal.show_json(found)
    else:
        write_text(out, json.dumps(found, indent=1) + "\n")


@command("compare", "clsplat compare runs/splat runs/mip_splatting --out compare.html")
def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN…", help="Run folders; that of a matrix stands for all its runs.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("compare.html"),
) -> None:
    """Show runs side by side on one page that opens offline."""
    count = commands.compare_runs(runs, out)
    terminal.remark(f"{count} runs compared in {out}")
