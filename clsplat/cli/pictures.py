"""The command that renders: pictures of views, and films."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from clsplat import terminal
from clsplat.api import pictures
from clsplat.cli.app import DeviceOption, ModelArgument, SceneOption, command
from clsplat.errors import ConfigError, amount

ScaleOption = Annotated[
    float | None,
    typer.Option(min=1, metavar="N", help="Divide image sizes by this; default: as the run did, 1 for a file."),
]
PathOption = Annotated[
    str | None,
    typer.Option(metavar="PATH", help="A film: ellipse, spiral, orbit, through, views, fixed[:VIEW], or a path file."),
]
SideOption = Annotated[
    str | None, typer.Option(metavar="photograph|MODEL", help="Video: the nearest photograph, or a model, beside it.")
]


FormatOption = Annotated[Literal["png", "npy"], typer.Option("--format", help="8-bit images, or float32 arrays.")]
SizeOption = Annotated[
    str | None, typer.Option(metavar="WxH", help="Film: px of a picture, even numbers; default: as the photographs.")
]
TimeOption = Annotated[
    float | None, typer.Option(metavar="T", help="Of a model that moves: this moment, 0 to 1; default: of each view.")
]
TimesOption = Annotated[
    str | None, typer.Option(metavar="A..B", help="Film: moments of its first and its last frame; default: 0..1.")
]
SavePathOption = Annotated[
    Path | None, typer.Option(metavar="FILE.json", help="Film: write its path, too, for nerfstudio or for --path.")
]


@command(
    "render",
    "clsplat render runs/splat_7k --out images",
    "clsplat render point_cloud.ply --scene my_scene --split all --format npy",
    "clsplat render runs/splat_7k --video ellipse.webm --size 1280x720",
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
    depth: Annotated[bool, typer.Option("--depth", help="Also depths, NAME_depth: red is near.")] = False,
    alpha: Annotated[bool, typer.Option("--alpha", help="Also how much is covered, NAME_alpha.")] = False,
    path: PathOption = None,
    frames: Annotated[int | None, typer.Option(metavar="N", help="Film: its frames; default: 120.")] = None,
    fps: Annotated[float | None, typer.Option(metavar="F", help="Film: frames a second; default: 30.")] = None,
    size: SizeOption = None,
    file: Annotated[Path | None, typer.Option("--video", metavar="FILE", help="Film: .webm, or .mp4.")] = None,
    side: SideOption = None,
    time: TimeOption = None,
    times: TimesOption = None,
    save_path: SavePathOption = None,
    device: DeviceOption = None,
) -> None:
    """Render a model at the views of a scene, one file for each, named as the view; or film it along a path."""
    if scale is not None and not math.isfinite(scale):
        raise ConfigError(f"--scale {scale}: expected a finite number of at least 1")
    if time is not None and times is not None:
        raise ConfigError("--time and --times: expected one of them; --times A..B lets time run")
    if path is not None or file is not None:
        if split is not None:
            raise ConfigError("--split is for pictures of views; of a film, --path views shows all views")
        options: dict[str, Any] = {"path": path or "ellipse", "frames": frames, "fps": fps, "size": size, "side": side}
        options["times"] = times if time is None else time
        options |= {"depth": depth, "alpha": alpha, "save_path": save_path, "downscale": scale, "kind": format_}
        found = pictures.render_path(model, scene, file, out=out, device=device, **options)
        terminal.remark(_told(found, pictures_wide=1 if side is None else 2))
        return
    of_films: dict[str, Any] = {"--frames": frames, "--fps": fps, "--size": size, "--side": side, "--times": times}
    of_films["--save-path"] = save_path
    if given := [name for name, value in of_films.items() if value is not None]:
        raise ConfigError(f"{given[0]} is for films; give --path or --video, too")
    count = pictures.render_views(
        model,
        scene,
        out,
        split=split or "test",
        downscale=scale,
        kind=format_,
        depth=depth,
        alpha=alpha,
        time=time,
        device=device,
    )
    terminal.remark(f"{amount(count, 'image')} written to {out}")


def _told(found: dict[str, Any], pictures_wide: int) -> str:
    """What was filmed, in a line."""
    first, *others = (Path(name) for name in found["files"])
    width, height = found["size"]
    made = f"{found['frames']} frames of {pictures_wide * width} x {height} px in {found['took']:.1f} s"
    if first.suffix in (".png", ".npy"):
        return f"{first.parent}: {made}"
    also = "".join(f", {path.name}" for path in others)
    return f"{first}{also}: {first.stat().st_size / 1e6:.2f} MB, {found['seconds']:.1f} s long; {made}"
