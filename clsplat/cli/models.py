"""Commands about trained models."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from clsplat import terminal
from clsplat.api import commands, compression, converting, pages
from clsplat.cli.app import DeviceOption, ModelArgument, SceneOption, command
from clsplat.errors import ConfigError, quoted
from clsplat.files import is_there


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
        typer.Option(metavar="N,…", help="Divide image sizes by these; default: as the run did, 1 for a file."),
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
    from clsplat.files import write_text
    from clsplat.results import check_result

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


@command(
    "view",
    "clsplat view runs/splat_7k --out scene.html",
    "clsplat view point_cloud.ply --scene my_scene --photographs all",
    "clsplat view runs/splat runs/mip_splatting",
)
def view(
    models: Annotated[
        list[Path], typer.Argument(metavar="MODEL|RUN [MODEL2]", help="Model files or run folders; two share a camera.")
    ],
    scene: SceneOption = None,
    out: Annotated[Path, typer.Option(metavar="FILE.html", help="The page to write.")] = Path("viewer.html"),
    photographs: Annotated[
        Literal["none", "test", "all"], typer.Option(help="Views whose photographs are in the page.")
    ] = "test",
    photograph_budget: Annotated[
        float, typer.Option(min=0, metavar="MB", help="Photographs up to this size: every second, third, … then.")
    ] = 4.0,
    splats: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Only so many, the most important ones; default: all.")
    ] = None,
) -> None:
    """Write a page to walk through a model, beside its photographs; it opens offline."""
    before = "replaced; " if is_there(out) else ""
    with terminal.counted():
        page = pages.view(
            *models, scene=scene, out=out, photographs=photographs, photograph_budget=photograph_budget, splats=splats
        )
    terminal.remark(f"{page}: {before}{page.stat().st_size / 1e6:.1f} MB; open it in a browser")


@command(
    "convert",
    "clsplat convert point_cloud.ply scene.spz",
    "clsplat convert moving.ply frames --frames 30",
    "clsplat convert a.ply b.sog both.glb --transform 'rotate=90,0,0'",
)
def convert(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="IN… OUT", help="Models to read, all merged, and the file to write; its name says how."),
    ],
    sh_degree: Annotated[int | None, typer.Option(metavar="N", help="Keep harmonics to this degree.")] = None,
    sh_bits: Annotated[
        str | None,
        typer.Option(metavar="A/B", help="SPZ: bits of harmonics, of band 1 and of the others; default: by --quality."),
    ] = None,
    axes: Annotated[
        Literal["spz", "ply"],
        typer.Option(help="Of SPZ files that are read, else of the one that is written: up and back, or as in a PLY."),
    ] = "spz",
    spz_version: Annotated[int, typer.Option(metavar="3|4", help="SPZ: 4 needs the extra spz.")] = 3,
    quality: Annotated[
        Literal["small", "balanced", "high"], typer.Option(help="Of SPZ and SOG: how finely all is rounded.")
    ] = "balanced",
    keep_nan: Annotated[
        bool, typer.Option("--keep-nan", help="Keep Gaussians that are not finite or too large, in a PLY.")
    ] = False,
    crop: Annotated[
        str | None, typer.Option(metavar="X0,Y0,Z0,X1,Y1,Z1", help="Keep what lies in this box after --transform.")
    ] = None,
    transform: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="scale=S rotate=X,Y,Z translate=X,Y,Z, or a matrix; colours turn too."),
    ] = None,
    drop_below: Annotated[
        float, typer.Option(metavar="OPACITY", min=0, max=1, help="Drop Gaussians that are fainter.")
    ] = 0.0,
    time: Annotated[
        float | None, typer.Option(metavar="T", help="Of a model that moves: the moment, 0 to 1, that is written.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(metavar="N", help="So many moments, each in a file; OUT is a folder, or frame.spz.")
    ] = None,
) -> None:
    """Write models in another format: PLY, SPZ, SOG, glTF and others."""
    done = converting.convert(
        files[:-1],
        files[-1],
        sh_degree=sh_degree,
        sh_bits=sh_bits,
        axes=axes,
        spz_version=spz_version,
        quality=quality,
        keep_nan=keep_nan,
        crop=crop,
        transform=transform,
        drop_below=drop_below,
        time=time,
        frames=frames,
    )
    share = 100 * done["bytes"] / max(done["bytes_read"], 1)
    size = f"{done['bytes'] / 1e6:.3g} MB, {share:,.1f} % of what was read"
    terminal.remark(f"{done['file']}: {done['format']}, {done['gaussians']:,} Gaussians, {size}")


@command(
    "compress",
    "clsplat compress runs/splat_7k --target -0.1dB",
    "clsplat compress point_cloud.ply --scene my_scene --target 5MB",
)
def compress(
    model: ModelArgument,
    scene: SceneOption = None,
    target: Annotated[
        str, typer.Option(metavar="SIZE|LOSS", help="The best file of this size, or the smallest of this loss.")
    ] = "-0.1dB",
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for the file, the page and all that is tried.")
    ] = Path("runs/compress"),
    format_: Annotated[Literal["sog", "spz"], typer.Option("--format", help="Of the files.")] = "sog",
    keep: Annotated[
        str | None, typer.Option(metavar="SHARE,…", help="Of the Gaussians; default: 1,0.7,0.5,0.35,0.25,0.18.")
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Of training after each pruning, and a fifth with each palette; default: 1000."
        ),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Prune, train and quantise a model until it meets a target; every file is measured as it is read back."""
    from clsplat.compress.page import table

    try:
        shares = None if keep is None else [float(text) for text in keep.split(",")]
    except ValueError:
        raise ConfigError(f"--keep {quoted(keep)}: expected shares, separated by commas, such as 1,0.7,0.5") from None
    found = compression.compress_model(
        model, scene, target, out, format=format_, keep=shares, steps=steps, device=device
    )
    terminal.show(table(found))
    chosen, source = found["chosen"], found["source"]
    size = f"{chosen['bytes'] / 1e6:.3g} MB, {chosen['bytes'] / source['bytes']:.1%} of the model"
    terminal.remark(f"{found['file']}: {size}, {chosen['psnr'] - source['psnr']:+z.2f} dB; page: {found['page']}")


@command("lod", "clsplat lod runs/splat_7k site/scene", "clsplat lod point_cloud.ply site/scene --levels 3")
def lod(
    model: Annotated[Path, typer.Argument(metavar="MODEL|RUN", help="A model file, or a run folder.")],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder to make, with its lod-meta.json.")],
    levels: Annotated[int, typer.Option(metavar="N", help="Levels, with the model itself.")] = 4,
    keep: Annotated[float, typer.Option(metavar="SHARE", help="Of the Gaussians of the level before.")] = 0.5,
    scene: SceneOption = None,
    steps: Annotated[
        int | None, typer.Option(metavar="N", help="Of training each coarser level, 0: none; default: 500.")
    ] = None,
    downscale: Annotated[
        float | None,
        typer.Option(metavar="N", help="Divide the photographs' size in this training; default: as the run."),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Write a model in levels of detail for the web (streamed SOG); with photographs each level is trained."""
    from clsplat.lod.table import table

    found = compression.write_levels(
        model, folder, scene, levels=levels, keep=keep, steps=steps, downscale=downscale, device=device
    )
    terminal.show(table(found))
    measured = f"; PSNR of {found['split']} views, not yet quantised" if found["split"] else ""
    terminal.remark(f"{found['folder']}/lod-meta.json: {found['bytes'] / 1e6:.3g} MB{measured}")


@command("compare", "clsplat compare runs/splat runs/mip_splatting --out compare.html")
def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN…", help="Run folders; that of a matrix stands for all its runs.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("compare.html"),
    published: Annotated[
        Path | None, typer.Option(metavar="FILE.yaml", help="Published figures, shown below the runs, apart from them.")
    ] = None,
) -> None:
    """Show runs side by side on one page that opens offline."""
    count = pages.compare_runs(runs, out, published)
    terminal.remark(f"{count} runs compared in {out}")
