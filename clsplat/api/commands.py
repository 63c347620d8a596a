"""What the commands do, as functions: paths and plain values in, files and plain values out.

The command line prints what these return.  They raise the errors of `clsplat.errors`, with the messages of the
commands: ConfigError for a pipeline or an argument, DataError for a dataset or a model, DeviceError for a device,
OutputError for a file that cannot be written.  `device` is a part of a device's name, as `devices` lists them, or a
`Device`; without it CLSPLAT_DEVICE, else the strongest GPU that works, else the first CPU.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import Overrides, PathLike, load_plugins, overrides, path_of

if TYPE_CHECKING:  # the command line starts without OpenCL
    from clsplat.opencl.device import Device
    from clsplat.runs.experiment import Job
    from clsplat.runs.folders import Start


def run(
    pipeline: PathLike,
    scene: PathLike | None = None,
    out: PathLike | None = None,
    *,
    set: Overrides = (),
    device: "str | Device | None" = None,
    start: Literal["new", "resume", "restart"] = "new",
    live: int | None = None,
    minutes: float | None = None,
    on: PathLike | None = None,
) -> Path:
    """Run a pipeline or a matrix, as `clsplat run` does; return the run folder.

    pipeline: a file, or the name of a shipped one; scene: default that of the pipeline; out: default runs/NAME; set:
    settings by place, such as {"optimize.steps": 3000}; start: "resume" goes on from the newest checkpoint in `out`, if
    there is one, "restart" begins again where `out` holds a run, and removes its checkpoints and metrics; live: the
    port of a page on this machine that shows the model while it trains, 0 for the usual one; minutes: the time that the
    run takes once its photographs are read, in as many steps as fit: they are chosen before it starts; on: a file that
    says where the cells of a matrix run, in the place of its `execution`.
    """
    from clsplat.cluster.commands import run_job

    return run_job(_job(pipeline, scene, out, set, start, on), device, live, minutes)


def describe_run(
    pipeline: PathLike,
    scene: PathLike | None = None,
    out: PathLike | None = None,
    *,
    set: Overrides = (),
    device: "str | Device | None" = None,
    start: Literal["new", "resume", "restart"] = "new",
    on: PathLike | None = None,
) -> str:
    """Check all that `run` would need and return what it would do, as lines of text; nothing is written."""
    return _job(pipeline, scene, out, set, start, on).describe(device)


def resume(
    folder: PathLike,
    scene: PathLike | None = None,
    *,
    set: Overrides = (),
    device: "str | Device | None" = None,
    live: int | None = None,
    on: PathLike | None = None,
) -> Path:
    """Go on with a run, or a matrix, from its newest checkpoint, as `clsplat resume` does; return the run folder.

    scene: where its photographs are, if they have moved; live, on: as for `run`.
    """
    from clsplat.cluster.commands import run_job
    from clsplat.pipeline.execution import values_of
    from clsplat.runs.experiment import Job

    load_plugins()
    return run_job(Job.resume(Path(folder), overrides(set), path_of(scene), values_of(path_of(on))), device, live)


def steps_key(folder: Path) -> str:
    """Return the key of the steps that a run trains, such as optimize.steps."""
    from clsplat.runs.steps_key import steps_key

    load_plugins()
    return steps_key(folder)


def status(folder: PathLike, html: PathLike | None = None) -> dict[str, Any]:
    """Return how far a run or a matrix is, from its files: what status.json holds, `last` report, `metrics` at the end.

    A matrix has `cells`, `done` and `failed` in the place of the step.  `silent` is the time in s since the last
    heartbeat of a run that has not ended, `ahead` that by which it lies in the future, from a minute on; the state is
    `killed` where its process is gone.  Of the store of a sweep return its `cells`, `counts` of their states, `events`,
    of a scene in blocks its `state` and its `parts`.  html: a page to be written of a store.
    """
    from clsplat.blocks.folder import status_of

    return status_of(Path(folder), path_of(html))


def status_schema() -> dict[str, Any]:
    """Return the JSON schema of status.json, for programs that watch runs."""
    from clsplat.training.status_schema import status_schema

    return status_schema()


def check(pipeline: PathLike) -> dict[str, Any]:
    """Validate a pipeline or a matrix; return its `path`, its `name`, and its `stages` or `cells`.

    Of a run folder, or that of a scene in blocks, return `whole`, its `state`, and `objects`: every file, whether it is
    `whole`, and a `detail`.  Of a model file return its `format`, `ranges`, `bounds`, `degenerate` counts, `findings`,
    and whether it is `valid`.
    """
    from clsplat.blocks.folder import check

    load_plugins()
    return check(str(pipeline))


def pipeline_schema() -> dict[str, Any]:
    """Return the JSON schema of pipeline files, with the variants of plug-ins."""
    from clsplat.pipeline.schema import json_schema

    load_plugins()
    return json_schema()


def pipelines(name: PathLike | None = None) -> Any:
    """Return `name`, `summary` and `path` of every shipped pipeline; of one of them its `stages` and `keys` too."""
    from clsplat.pipeline import recipes

    load_plugins()
    return recipes.summaries() if name is None else recipes.manual(str(name))


def copy_pipeline(name: PathLike, file: PathLike) -> Path:
    """Copy a pipeline to a file, or into a folder, to change it; return the copy.  A file is never replaced."""
    from clsplat.pipeline import recipes

    return recipes.copy(str(name), Path(file))


def evaluate(
    model: PathLike,
    scene: PathLike | None = None,
    *,
    downscales: Sequence[float] | None = None,
    metrics: Sequence[str] = ("psnr", "ssim"),
    lpips: PathLike | None = None,
    lpips_input: Literal["-1..1", "0..1"] = "-1..1",
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Measure a model at the views of a scene; return metrics by split and divisor, with the keys of metrics.json.

    model, scene: as for `render_views`; downscales: divisors of the photographs' size; metrics: of psnr (dB), ssim,
    ms_ssim and flip; lpips: an ONNX file, which reads values from -1 or from 0 on, as `lpips_input` says.
    """
    from clsplat.runs import model_file

    load_plugins()
    return model_file.evaluate(
        Path(model),
        path_of(scene),
        downscales=downscales,
        metrics=metrics,
        lpips=path_of(lpips),
        lpips_input=lpips_input,
        device=device,
    )


def _job(
    pipeline: PathLike,
    scene: PathLike | None,
    out: PathLike | None,
    values: Overrides,
    start: "Start",
    on: PathLike | None = None,
) -> "Job":
    from clsplat.pipeline.execution import values_of
    from clsplat.runs.experiment import Job

    load_plugins()
    return Job.open(str(pipeline), path_of(scene), path_of(out), overrides(values), start, values_of(path_of(on)))
