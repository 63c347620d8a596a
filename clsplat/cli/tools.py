"""Define the commands for devices, datasets, and speed."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from clsplat.api import tools
from clsplat.api.commands import plan_in_blocks
from clsplat.cli.app import DeviceOption, JsonOption, command
from clsplat.core import signals, terminal
from clsplat.core.errors import ConfigError, DataError, DeviceError


@command("devices", "clsplat devices", "clsplat devices --json")
def devices(as_json: JsonOption = False) -> None:
    """List OpenCL devices, their limits, and whether each works; exit code 4 if none does."""
    infos = tools.devices()
    if as_json:
        terminal.show_json(infos)
    else:
        for device in infos:
            terminal.show(terminal.device_text(device))
    if all(device["fault"] for device in infos):
        raise tools.no_device_error("no OpenCL device works", tools.no_device_advice())


@command("doctor", "clsplat doctor", "clsplat doctor --device radeonsi --html device.html")
def doctor(
    device: DeviceOption = None,
    as_json: JsonOption = False,
    page: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Write an HTML report, to attach to an issue.")
    ] = None,
) -> None:
    """Compare every kernel with the float64 reference; exit code 4 if the device computes wrong results."""
    from clsplat.conformance.doctor import check_html_path, write_page

    if as_json:
        terminal.keep_stdout_for_json()
    if page is not None:
        check_html_path(page)
    report = tools.doctor(device)
    if as_json:
        terminal.show_json(report.data())
    else:
        terminal.show(report.text())
    if page is not None:  # after the verdict is printed: it took minutes, and writing the page may fail
        write_page(report, page)
    if not report.usable:
        raise DeviceError(f"{report.info.label}: {report.verdict.text}")


POINTS_NOTE = (
    "this partition is based on the points of the dataset and the pipeline `blocks`; `clsplat blocks --plan` trains a "
    "coarse model to partition, and accepts other pipelines and settings"
)


@command(
    "inspect",
    "clsplat inspect my_scene",
    "clsplat inspect my_scene --html scene.html",
    "clsplat inspect my_city --blocks 9",
)
def inspect(
    scene: Annotated[
        Path,
        typer.Argument(metavar="SCENE", help="Dataset folder (COLMAP, Blender, nerfstudio, …), photos, or run folder."),
    ],
    as_json: JsonOption = False,
    page: Annotated[
        Path | None,
        typer.Option("--html", metavar="FILE", help="Write an HTML page with the cameras and points in 3D."),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--blocks", metavar="N", help="Only partition the points into N blocks, and show views, memory, and time."
        ),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Report problems in a dataset or photos, and whether they can be used for training; exit code 3 if not."""
    from clsplat.prepare.inspect.findings import show
    from clsplat.workflows.blocks import format_table

    if count is None and device is not None:
        raise ConfigError("inspect: --device has no effect without --blocks; add --blocks or omit --device")
    if count is not None and page is not None:
        raise ConfigError("inspect: --blocks and --html cannot be combined; omit one of them")
    if as_json:
        terminal.keep_stdout_for_json()
    if count is not None:
        plan = plan_in_blocks(scene, blocks=count, device=device)
        if as_json:
            terminal.show_json(plan)
        else:
            terminal.show(format_table(plan))
            terminal.print_message(POINTS_NOTE)
        return
    inspection = tools.inspect_scene(scene, page)
    if as_json:
        terminal.show_json(inspection.data())
    else:
        show(inspection, terminal.CONSOLE)
        signals.check_output()
    if not inspection.is_trainable and not inspection.next_step:
        raise DataError(inspection.verdict)


@command("bench", "clsplat bench --json > before.json", "clsplat bench --against before.json")
def bench(
    scenes: Annotated[str, typer.Option(metavar="NAME,…", help="One or more of the fixed scenes A, B, and C.")] = "A",
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Also time this splat file or point cloud (PLY); needs --scene.")
    ] = None,
    scene: Annotated[Path | None, typer.Option(metavar="DIR", help="The scene of --model.")] = None,
    pipeline: Annotated[
        str,
        typer.Option(metavar="PIPELINE", help="Pipeline with the losses, statistics, and filters of a step."),
    ] = "splat",
    repeats: Annotated[int, typer.Option(min=1, metavar="N", help="Steps per scene.")] = 20,
    as_json: JsonOption = False,
    against: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Compare with the JSON output of an earlier `clsplat bench`.")
    ] = None,
    schedule: Annotated[
        Literal["auto", "simt", "simt16", "wide"], typer.Option(help="wide for CPUs; simt and simt16 for GPUs.")
    ] = "auto",
    report: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Check and time the device with all its schedules, and write JSON."),
    ] = None,
    device: DeviceOption = None,
) -> None:
    """Time the stages of a training step on fixed scenes.

    The times are compared with the measured peak compute and memory throughput of the device.
    """
    if as_json:
        terminal.keep_stdout_for_json()
    baseline = tools.read_measurement(against, pipeline) if against else {}
    names = [name for name in scenes.split(",") if name]
    if report:
        tools.report_device(report, names, device)
        return
    measurement = tools.measure_speed(
        names, model=model, scene=scene, pipeline=pipeline, repeats=repeats, schedule=schedule, device=device
    )
    if as_json:
        terminal.show_json({**measurement.data(), **({"against": baseline} if baseline else {})})
    else:
        terminal.show(measurement.text(baseline))
