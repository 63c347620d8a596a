"""Define the commands for trained models."""

import json
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clsplat.api import commands, rendering
from clsplat.cli.app import DeviceOption, JsonOption, ModelArgument, SceneOption, command
from clsplat.core import terminal
from clsplat.core.errors import ConfigError, pluralize, quote
from clsplat.core.files import path_exists
from clsplat.core.text_table import text_table


def _parse_numbers(option: str, text: str | None, description: str) -> list[float] | None:
    """Parse the comma-separated numbers of an option.  Raises ConfigError."""
    try:
        return None if text is None else [float(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"{option} {quote(text)}: expected {description}") from None


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
            metavar="N,…", help="Divisors of the image size; default: the divisor of the run, or 1 for a model file."
        ),
    ] = None,
    metrics: Annotated[
        str, typer.Option(metavar="NAME,…", help="One or more of psnr, ssim, ms_ssim, and flip.")
    ] = "psnr,ssim",
    lpips: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Also compute LPIPS, with this ONNX file from `clsplat data lpips`."),
    ] = None,
    lpips_input: Annotated[
        Literal["-1..1", "0..1"], typer.Option(help="Range of pixel values for LPIPS; 3DGS papers use 0..1.")
    ] = "-1..1",
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the metrics to a JSON file.")] = None,
    as_json: JsonOption = False,
    device: DeviceOption = None,
) -> None:
    """Measure a model on a scene's test and training views, and print a table."""
    from clsplat.core.files import check_result_path, write_text

    if as_json:
        terminal.keep_stdout_for_json()
    if out is not None:
        check_result_path(out, ".json")
    divisors = _parse_numbers("--downscales", downscales, "numbers, separated by commas, such as 1,2,4")
    results = commands.evaluate(
        model,
        scene,
        downscales=divisors,
        metrics=metrics.split(","),
        lpips=lpips,
        lpips_input=lpips_input,
        device=device,
    )
    if out is not None:
        write_text(out, json.dumps(results, indent=1) + "\n")
    if as_json:
        terminal.show_json(results)
    elif out is None:
        terminal.show(_metrics_table(results))


def _metrics_table(results: dict[str, Any]) -> str:
    """Format metrics as a table with a row for each split and downscale factor."""
    rows = [
        {"split": split, "size": f"1/{downscale}", **averages}
        for split in ("test", "train")
        for downscale, averages in results[split].items()
    ]
    columns = ["split", "size", *(name for name, value in (rows or [{}])[0].items() if isinstance(value, int | float))]
    cells = [
        [f"{row[name]:.4f}" if isinstance(row[name], float) else str(row[name]) for name in columns] for row in rows
    ]
    return text_table([columns, *cells], left_columns=2)


@command(
    "view",
    "clsplat view runs/splat_7k --out scene.html",
    "clsplat view point_cloud.ply --scene my_scene --photographs all",
    "clsplat view runs/splat runs/mip_splatting",
)
def view(
    models: Annotated[
        list[Path],
        typer.Argument(metavar="MODEL|RUN [MODEL2]", help="Model files or run folders; two are shown side by side."),
    ],
    scene: SceneOption = None,
    out: Annotated[Path, typer.Option(metavar="FILE.html", help="The page to write.")] = Path("viewer.html"),
    photographs: Annotated[Literal["none", "test", "all"], typer.Option(help="Which photos to include.")] = "test",
    photograph_budget: Annotated[
        float, typer.Option(min=0, metavar="MB", help="Maximum total size of the photos; some are left out if needed.")
    ] = 4.0,
    splats: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Include only the N most important Gaussians; default: all.")
    ] = None,
) -> None:
    """Write an HTML page that shows a model next to its photos and opens offline."""
    prefix = "replaced; " if path_exists(out) else ""
    with terminal.counts_on_terminal():
        page = commands.view(
            *models, scene=scene, out=out, photographs=photographs, photograph_budget=photograph_budget, splats=splats
        )
    terminal.print_message(f"{page}: {prefix}{page.stat().st_size / 1e6:.1f} MB; open it in a browser")


CropOption = Annotated[
    str | None,
    typer.Option(metavar="X0,Y0,Z0,X1,Y1,Z1", help="Keep only this box, in world coordinates after --transform."),
]
TransformOption = Annotated[
    str | None,
    typer.Option(metavar="TEXT", help="scale=S rotate=X,Y,Z (degrees) translate=X,Y,Z, or a matrix; also rotates SH."),
]
MergeOption = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="Merge neighbors until N Gaussians remain, excluding the sky.")
]
SkyOption = Annotated[
    Literal["splats", "none"] | None, typer.Option(help="Write a learned sky as distant Gaussians, or remove it.")
]
ColliderOption = Annotated[
    Path | None, typer.Option(metavar="MESH", help="OpenUSD: a .ply or .obj file for an invisible collision mesh.")
]
FramesOption = Annotated[
    int | None,
    typer.Option(metavar="N", help="Dynamic model: write N files over time; OUT: a folder, or a file name to number."),
]


@command(
    "convert",
    "clsplat convert point_cloud.ply scene.spz",
    "clsplat convert moving.ply frames --frames 30",
    "clsplat convert scene.ply scene.usdz --collider collider.ply",
    "clsplat convert a.ply b.sog both.glb --transform 'rotate=90,0,0'",
)
def convert(
    files: Annotated[
        list[Path],
        typer.Argument(metavar="IN… OUT", help="Models to merge, and the file to write; its suffix sets the format."),
    ],
    sh_degree: Annotated[int | None, typer.Option(metavar="N", help="Highest SH degree to keep.")] = None,
    quality: Annotated[
        Literal["small", "balanced", "high"], typer.Option(help="Precision of the values in SPZ and SOG files.")
    ] = "balanced",
    crop: CropOption = None,
    transform: TransformOption = None,
    drop_below: Annotated[
        float, typer.Option(metavar="OPACITY", min=0, max=1, help="Drop Gaussians with a lower opacity.")
    ] = 0.0,
    filter_floaters: Annotated[
        bool, typer.Option("--filter-floaters", help="Drop Gaussians that are large and faint, isolated, or far away.")
    ] = False,
    level: Annotated[
        bool, typer.Option("--level", help="Rotate the model upright: its ground is at y = 0, and -y points up.")
    ] = False,
    splats: MergeOption = None,
    sky: SkyOption = None,
    time: Annotated[
        float | None, typer.Option(metavar="T", help="Dynamic model: write it at this time, 0 to 1.")
    ] = None,
    frames: FramesOption = None,
    world: Annotated[bool, typer.Option("--world", help="Write world coordinates, not relative to an origin.")] = False,
    collider: ColliderOption = None,
) -> None:
    """Convert models to another format: PLY, SPZ, SOG, glTF, OpenUSD, HTML, and others."""
    result = commands.convert(
        files[:-1],
        files[-1],
        sh_degree=sh_degree,
        quality=quality,
        crop=crop,
        transform=transform,
        drop_below=drop_below,
        filter_floaters=filter_floaters,
        level=level,
        splats=splats,
        sky=sky,
        time=time,
        frames=frames,
        world=world,
        collider=collider,
    )
    percent = 100 * result["bytes"] / max(result["bytes_read"], 1)
    size = f"{result['bytes'] / 1e6:.3g} MB, {percent:,.1f} % of the input"
    terminal.print_message(f"{result['file']}: {result['format']}, {result['gaussians']:,} Gaussians, {size}")


@command(
    "align",
    "clsplat align my_scene leveled --level cameras",
    "clsplat align runs/splat_7k metric.ply --distance '0,0,1;1.2,0,3.4=1.25'",
    "clsplat align my_scene on_map --gps",
    "clsplat align my_scene surveyed --control points.csv",
)
def align(
    path: Annotated[
        Path, typer.Argument(metavar="SCENE|MODEL|RUN", help="A dataset folder, a model file, or a run folder.")
    ],
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="A model file to write, or a folder for cameras and photos.")
    ],
    scene: SceneOption = None,
    level: Annotated[
        Literal["cameras", "ground"] | None, typer.Option(help="Rotate the scene upright, by its cameras or ground.")
    ] = None,
    distance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="A;B=LENGTH",
            help="A known distance; A and B: x,y,z, PHOTO:u,v+PHOTO:u,v, or a name in --control; may be repeated.",
        ),
    ] = None,
    gps: Annotated[bool, typer.Option("--gps", help="Use GPS positions in EXIF; coordinates become UTM.")] = False,
    control: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.csv", help="CSV file of points marked in photos, with columns point, x, y, z, photo, u, v."
        ),
    ] = None,
    format_: Annotated[
        Literal["colmap", "nerfstudio", "inria"], typer.Option("--format", help="Format of the cameras in a folder.")
    ] = "colmap",
    images: Annotated[Literal["none", "copy"], typer.Option(help="Whether to copy the photos to a folder.")] = "copy",
    as_json: JsonOption = False,
) -> None:
    """Give a scene or a model its true scale, up direction, or map coordinates, and print the remaining errors."""
    from clsplat.workflows.align import format_table

    if as_json:
        terminal.keep_stdout_for_json()
    result = commands.align(
        path,
        out,
        scene,
        level=level,
        distances=distance or [],
        gps=gps,
        control=control,
        format=format_,
        images=images,
    )
    if as_json:
        terminal.show_json(result)
        return
    if result["points"] or result["distances"]:
        terminal.show(format_table(result))
    rms = (
        ""
        if result["rms"] is None
        else f", RMS error {result['rms']:.4g}, {pluralize(len(result['outliers']), 'outlier')}"
    )
    cosine = (sum(result["matrix"][i][i] for i in range(3)) / result["scale"] - 1) / 2  # of the angle of a rotation
    angle = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
    terminal.print_message(f"{out}: rotated by {angle:.1f} degrees, scaled by {result['scale']:.6g}{rms}")


@command(
    "compress",
    "clsplat compress runs/splat_7k --target -0.1dB",
    "clsplat compress point_cloud.ply --scene my_scene --target 5MB",
)
def compress(
    model: ModelArgument,
    scene: SceneOption = None,
    target: Annotated[
        str, typer.Option(metavar="SIZE|LOSS", help="Maximum file size or PSNR loss, such as 5MB or -0.1dB.")
    ] = "-0.1dB",
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the file, the page, and all trials.")] = Path(
        "runs/compress"
    ),
    format_: Annotated[Literal["sog", "spz"], typer.Option("--format", help="Format of the files.")] = "sog",
    keep: Annotated[
        str | None,
        typer.Option(metavar="F,…", help="Fractions of the Gaussians to try; default: 1,0.7,0.5,0.35,0.25,0.18."),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Training steps after each pruning; each palette trains for a fifth of them; default: 1000.",
        ),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Prune, train, and quantize a model to meet a target size or quality; each file is measured as written."""
    from clsplat.workflows.compress import format_table

    keeps = _parse_numbers("--keep", keep, "fractions, separated by commas, such as 1,0.7,0.5")
    result = commands.compress_model(model, scene, target, out, format=format_, keep=keeps, steps=steps, device=device)
    terminal.show(format_table(result))
    best, source = result["chosen"], result["source"]
    size = f"{best['bytes'] / 1e6:.3g} MB, {best['bytes'] / source['bytes']:.1%} of the model"
    terminal.print_message(
        f"{result['file']}: {size}, {best['psnr'] - source['psnr']:+z.2f} dB; page: {result['page']}"
    )


@command("lod", "clsplat lod runs/splat_7k site/scene", "clsplat lod point_cloud.ply site/scene --levels 3")
def lod(
    model: Annotated[Path, typer.Argument(metavar="MODEL|RUN", help="A model file, or a run folder.")],
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to write, with lod-meta.json.")],
    levels: Annotated[int, typer.Option(metavar="N", help="Number of levels, including the model itself.")] = 4,
    keep: Annotated[float, typer.Option(metavar="F", help="Size of a level, as a fraction of the previous one.")] = 0.5,
    scene: SceneOption = None,
    steps: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Training steps for each coarser level; 0: merge without training; default: 500."
        ),
    ] = None,
    downscale: Annotated[
        float | None,
        typer.Option(metavar="N", help="Divisor of the image size in training; default: the divisor of the run."),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Write a model at several levels of detail for the web (streamed SOG).  With photos, train each level."""
    from clsplat.workflows.lod import format_table

    result = commands.write_levels(
        model, folder, scene, levels=levels, keep=keep, steps=steps, downscale=downscale, device=device
    )
    terminal.show(format_table(result))
    note = f"; PSNR of {result['split']} views, not yet quantized" if result["split"] else ""
    terminal.print_message(f"{result['folder']}/lod-meta.json: {result['bytes'] / 1e6:.3g} MB{note}")


ScaleOption = Annotated[
    float | None,
    typer.Option(
        min=1, metavar="N", help="Divisor of the image size; default: the divisor of the run, or 1 for a model file."
    ),
]


@command(
    "mesh",
    "clsplat mesh runs/splat_7k scene.glb",
    "clsplat mesh point_cloud.ply a.ply --scene my_scene --voxel 0.02",
    "clsplat mesh runs/splat_7k collider.obj --collision --keep 0.1",
)
def mesh(
    model: ModelArgument,
    file: Annotated[Path, typer.Argument(metavar="OUT", help="File to write: .ply, .obj, or .glb.")],
    scene: SceneOption = None,
    voxel: Annotated[
        float | None,
        typer.Option(metavar="SIZE", help="Resolution in scene units; default: 1.2 pixels at the median depth."),
    ] = None,
    keep: Annotated[float, typer.Option(metavar="F", help="Fraction of the faces to keep.")] = 1.0,
    collision: Annotated[
        bool, typer.Option("--collision", help="Write a closed collision mesh around all space not seen to be empty.")
    ] = False,
    scale: ScaleOption = None,
    device: DeviceOption = None,
) -> None:
    """Write the surface of a model as a triangle mesh with colors, from the depths of the training views."""
    result = commands.write_mesh(
        model, file, scene, voxel=voxel, keep=keep, collision=collision, downscale=scale, device=device
    )
    size = f"{result['faces']:,} faces, {result['vertices']:,} vertices, {result['bytes'] / 1e6:.3g} MB"
    topology = "closed" if result["closed"] else "open"
    terminal.print_message(f"{result['file']}: {size}; {topology}, voxel {result['voxel']:.3g} scene units")


@command("compare", "clsplat compare runs/splat runs/mip_splatting --out compare.html")
def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN…", help="Run folders; a matrix folder includes all its runs.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("compare.html"),
    published: Annotated[
        Path | None, typer.Option(metavar="FILE.yaml", help="Published metrics, shown in a separate table.")
    ] = None,
) -> None:
    """Compare runs side by side on an HTML page that opens offline."""
    count = commands.compare_runs(runs, out, published)
    terminal.print_message(f"{count} runs compared in {out}")


# Rendering of views, and of videos along a camera path.

PathOption = Annotated[
    str | None,
    typer.Option(metavar="PATH", help="Video: ellipse, spiral, orbit, through, views, fixed[:VIEW], or a path file."),
]
FromOption = Annotated[
    str | None,
    typer.Option("--from", metavar="X,Y,Z", help="One image from this position, or a video with a fixed camera."),
]
TargetOption = Annotated[
    str | None, typer.Option("--look-at", metavar="X,Y,Z", help="With --from: point to look at; default: the center.")
]
SideOption = Annotated[
    str | None,
    typer.Option(metavar="photograph|MODEL", help="Video: show the nearest photo, or a model, next to the render."),
]


FormatOption = Annotated[Literal["png", "npy"], typer.Option("--format", help="8-bit images or float32 arrays.")]
SizeOption = Annotated[
    str | None,
    typer.Option(metavar="WxH", help="Video: even frame size in pixels; default: the size of the photos."),
]
DepthOption = Annotated[
    Literal["mean", "median"] | None,
    typer.Option(
        "--depth", metavar="[mean|median]", help="Also write depths, as NAME_depth or NAME_median_depth; red is near."
    ),
]
TimeOption = Annotated[
    float | None, typer.Option(metavar="T", help="Dynamic model: time, 0 to 1; default: the time of each view.")
]
TimesOption = Annotated[
    str | None, typer.Option(metavar="A..B", help="Video: times of the first and last frame; default: 0..1.")
]


@command(
    "render",
    "clsplat render runs/splat_7k --out images",
    "clsplat render point_cloud.ply --scene my_scene --split all --format npy",
    "clsplat render runs/splat_7k --depth median --normals",
    "clsplat render runs/splat_7k --video ellipse.webm --size 1280x720",
    "clsplat render scan.ply --path orbit --video turntable.webm",
    "clsplat render scan.ply --from 0,-1,3 --look-at 0,0,0",
    "clsplat render runs/a --path views --side photograph --video both.webm",
    "clsplat render runs/dynamic --path fixed --times 0..1 --video motion.webm",
)
def render(
    model: ModelArgument,
    scene: SceneOption = None,
    split: Annotated[Literal["test", "train", "all"] | None, typer.Option(help="Which views; default: test.")] = None,
    scale: ScaleOption = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the images.")] = Path("renders"),
    format_: FormatOption = "png",
    depth: DepthOption = None,
    normals: Annotated[bool, typer.Option("--normals", help="Also write normals, as NAME_normals.")] = False,
    alpha: Annotated[bool, typer.Option("--alpha", help="Also write opacities, as NAME_alpha.")] = False,
    path: PathOption = None,
    frames: Annotated[int | None, typer.Option(metavar="N", help="Video: number of frames; default: 120.")] = None,
    fps: Annotated[float | None, typer.Option(metavar="F", help="Video: frames per second; default: 30.")] = None,
    size: SizeOption = None,
    file: Annotated[Path | None, typer.Option("--video", metavar="FILE", help="Video file, .webm or .mp4.")] = None,
    position: FromOption = None,
    look_at: TargetOption = None,
    side: SideOption = None,
    time: TimeOption = None,
    times: TimesOption = None,
    device: DeviceOption = None,
) -> None:
    """Render a model at the views of a scene, from anywhere, or as a video along a camera path."""
    if scale is not None and not math.isfinite(scale):
        raise ConfigError(f"--scale {scale}: expected a finite number of at least 1")
    if time is not None and times is not None:
        raise ConfigError("--time and --times cannot be combined; use --times A..B for a video")
    if path is not None or file is not None or position is not None or look_at is not None:
        if split is not None:
            raise ConfigError("--split is for images of views; for a video of all views, use --path views")
        options: dict[str, Any] = {"path": path or "ellipse", "frames": frames, "fps": fps, "size": size, "side": side}
        if position is not None:
            options |= {"path": path or "fixed", "frames": frames or (1 if file is None else None)}
        options["position"] = _parse_numbers("--from", position, "a position, such as 0,-1,2.5")
        options["look_at"] = _parse_numbers("--look-at", look_at, "a position, such as 0,0,0")
        options["times"] = times if time is None else time
        options |= {"depth": depth or False, "normals": normals, "alpha": alpha, "downscale": scale, "format": format_}
        result = rendering.render_path(model, scene, file, out=out, device=device, **options)
        terminal.print_message(_video_text(result, columns=1 if side is None else 2))
        return
    video_options: dict[str, Any] = {"--frames": frames, "--fps": fps, "--size": size, "--side": side, "--times": times}
    if names := [name for name, value in video_options.items() if value is not None]:
        raise ConfigError(f"{names[0]} is for videos; add --path or --video")
    count = rendering.render_views(
        model,
        scene,
        out,
        split=split or "test",
        downscale=scale,
        format=format_,
        depth=depth or False,
        normals=normals,
        alpha=alpha,
        time=time,
        device=device,
    )
    terminal.print_message(f"{pluralize(count, 'image')} written to {out}")


def _video_text(result: dict[str, Any], columns: int) -> str:
    """Describe a video in a line of text: its size, duration, and rendering time."""
    first, *others = (Path(name) for name in result["files"])
    width, height = result["size"]
    summary = f"{pluralize(result['frames'], 'frame')} of {columns * width} x {height} px in {result['took']:.1f} s"
    if first.suffix in (".png", ".npy"):
        return f"{first.parent}: {summary}"
    extra_files = "".join(f", {path.name}" for path in others)
    return f"{first}{extra_files}: {first.stat().st_size / 1e6:.2f} MB, {result['seconds']:.1f} s long; {summary}"
