"""Inspect devices and datasets, and measure speed.  Errors and `device` are as in `clsplat.api.commands`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import PathLike, load_plugins, to_path
from clsplat.opencl.runtimes import no_device_advice as no_device_advice
from clsplat.opencl.runtimes import no_device_error as no_device_error

if TYPE_CHECKING:  # the command line must start without importing OpenCL
    from clsplat.conformance.bench.measurement import Measurement
    from clsplat.conformance.doctor import DeviceReport
    from clsplat.opencl.device import Device
    from clsplat.prepare.inspect.findings import Inspection

ScheduleName = Literal["auto", "simt", "simt16", "wide"]  # wide for CPUs, the others for GPUs


def devices() -> list[dict[str, Any]]:
    """Return the OpenCL devices, each with its name, limits (bytes and work items), `schedule`, and `fault`.

    `fault` is the reason why a device does not work, or None.  Each device is tested once, in a separate process.
    """
    from dataclasses import asdict

    from clsplat.opencl.discovery import list_devices, resolve_schedule

    return [
        {**asdict(info), "schedule": resolve_schedule(info, "auto"), "fault": info.fault()} for info in list_devices()
    ]


def doctor(device: "str | Device | None" = None, page: PathLike | None = None) -> "DeviceReport":
    """Compare all kernels with the reference on a device.  Return a report with `verdict`, `usable`, and `data()`.

    The comparison takes a minute or two on a CPU.

    page: an HTML report to write, which can be attached to an issue
    """
    from clsplat.conformance.doctor import check_html_path, examine, write_page

    load_plugins()
    if page is not None:
        check_html_path(Path(page))
    report = examine(device)
    if page is not None:
        write_page(report, Path(page))
    return report


def inspect_scene(scene: PathLike, page: PathLike | None = None) -> "Inspection":
    """Inspect a dataset.  Return an inspection with `verdict`, `findings`, `is_trainable`, and `data()`.

    scene: a dataset folder, or a run folder, whose dataset is inspected
    page: an HTML page to write, which shows the cameras and points in 3D

    Raises DataError only if the folder does not exist.
    """
    from clsplat.core.files import check_result_path
    from clsplat.prepare.inspect.findings import Inspection
    from clsplat.prepare.inspect.page import write_page
    from clsplat.runs.model_file import photo_folder

    load_plugins()
    if page is not None:
        check_result_path(Path(page), ".html")
    inspection = Inspection.from_folder(photo_folder(Path(scene)))
    if page is not None:
        write_page(inspection, Path(page))
    return inspection


def measure_speed(
    scenes: Sequence[str] = ("A",),
    *,
    model: PathLike | None = None,
    scene: PathLike | None = None,
    pipeline: PathLike = "splat",
    repeats: int = 20,
    schedule: ScheduleName = "auto",
    device: "str | Device | None" = None,
) -> "Measurement":
    """Time the stages of a training step, as `clsplat bench` does.

    Returns a measurement with times in ms; its methods are `data()` and `text()`.

    scenes: any of the fixed scenes A, B, and C
    model, scene: a splat file or point cloud and its dataset, which are timed as well
    pipeline: the pipeline whose losses, statistics, and filters are used
    repeats: number of steps per scene
    """
    from clsplat.conformance.bench.measurement import measure

    load_plugins()
    return measure(
        scenes,
        model=to_path(model),
        scene=to_path(scene),
        pipeline=str(pipeline),
        repeats=repeats,
        schedule=schedule,
        device=device,
    )


def report_device(out: PathLike, scenes: Sequence[str] = ("A",), device: "str | Device | None" = None) -> None:
    """Check and time a device with each schedule for its kind, and write the results to a JSON file.

    The file contains the report of `doctor` and the measurements by schedule.  Raises OutputError.
    """
    import json

    from clsplat.core.files import check_result_path, write_text

    check_result_path(Path(out), ".json")
    checks = doctor(device)
    schedules = [s for s in checks.schedules if (s == "wide") == (checks.default == "wide") and not checks.failures[s]]
    times = {s: measure_speed(scenes, schedule=s, device=device).data() for s in schedules}  # type: ignore[arg-type]
    write_text(Path(out), json.dumps({"doctor": checks.data(), "bench": times}, indent=1) + "\n")


def read_measurement(file: PathLike, pipeline: PathLike = "splat") -> dict[str, Any]:
    """Read the `data()` of an earlier measurement of the same pipeline from a JSON file, for comparison."""
    from clsplat.conformance.bench import measurement

    load_plugins()
    return measurement.read_measurement(Path(file), str(pipeline))


def load_plugin(file: PathLike) -> None:
    """Import a plug-in file, as `--plugin` does.  Raises ConfigError with its file and line if the import fails."""
    from clsplat.pipeline import plugins

    plugins.load_file(Path(file))
