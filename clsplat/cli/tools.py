"""Commands about devices, datasets and speed."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from clsplat import terminal
from clsplat.cli.app import DeviceOption, JsonOption, command
from clsplat.errors import DataError, DeviceError


@command("devices", "clsplat devices", "clsplat devices --json")
def devices(as_json: JsonOption = False) -> None:
    """List OpenCL devices, their limits, and whether each works; exit 4 when none does."""
    from dataclasses import asdict

    from clsplat.opencl.discovery import list_devices

    found = [(info, info.fault()) for info in list_devices()]
    if as_json:
        terminal.show_json([{**asdict(info), "fault": fault} for info, fault in found])
    else:
        for info, fault in found:
            terminal.show(terminal.device_text(info, fault))
    if all(fault for _, fault in found):
        raise DeviceError(
            "no OpenCL device works; install a runtime: pip install 'clsplat[pocl]', pip install 'clsplat[intel]', "
            "apt install pocl-opencl-icd, or your GPU's driver"
        )


@command("inspect", "clsplat inspect my_scene", "clsplat inspect my_scene --html scene.html")
def inspect(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A COLMAP, Blender or nerfstudio folder.")],
    as_json: JsonOption = False,
    page: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write a page with the cameras and points in 3D.")
    ] = None,
) -> None:
    """Tell whether a dataset will train, and what is wrong with it; exit 3 when it cannot train."""
    from clsplat.inspect.inspection import Inspection
    from clsplat.inspect.page import write_page
    from clsplat.inspect.table import show

    if as_json:
        terminal.keep_stdout_for_json()
    inspection = Inspection.of(scene)
    if as_json:
        terminal.show_json(inspection.data())
    else:
        show(inspection, terminal.CONSOLE)
    if page is not None:
        write_page(inspection, page)
    if not inspection.trainable:
        raise DataError(inspection.verdict)


@command("bench", "clsplat bench --json > before.json", "clsplat bench --against before.json")
def bench(
    scenes: Annotated[
        str, typer.Option(metavar="NAME,…", help="Fixed scenes, of A, B and C, separated by commas.")
    ] = "A",
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also time this splat or point cloud (PLY), at --scene.")
    ] = None,
    scene: Annotated[Path | None, typer.Option(metavar="DIR", help="The scene of --model.")] = None,
    pipeline: Annotated[
        str, typer.Option(metavar="PIPELINE", help="The losses, statistics and filter of a step.")
    ] = "splat",
    repeats: Annotated[int, typer.Option(min=1, metavar="N", help="Steps of each scene.")] = 20,
    as_json: JsonOption = False,
    against: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Compare with the JSON of an earlier run.")
    ] = None,
    schedule: Annotated[Literal["auto", "wide", "simt"], typer.Option(help="wide for CPUs, simt for GPUs.")] = "auto",
    growth: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Only time 50 000 to a million Gaussians; an SVG is written."),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Time the stages of a training step on fixed scenes, beside the device's measured peaks."""
    from clsplat.bench.measurement import measure, measure_growth, read_measurement

    if as_json:
        terminal.keep_stdout_for_json()
    earlier = read_measurement(against, pipeline) if against else {}
    if growth is not None:
        terminal.show(measure_growth(growth, pipeline=pipeline, repeats=repeats, schedule=schedule, device=device))
        return
    names = [name for name in scenes.split(",") if name]
    found = measure(
        names, model=model, scene=scene, pipeline=pipeline, repeats=repeats, schedule=schedule, device=device
    )
    if as_json:
        terminal.show_json(found.data())
    else:
        terminal.show(found.text(earlier))
