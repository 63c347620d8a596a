"""Provide the commands as functions, from paths and plain values to files and plain values.

The command line prints their results.  They raise the errors of `clsplat.core.errors`: ConfigError for a pipeline or an
argument, DataError for a dataset or a model, DeviceError for a device, OutputError for a file that cannot be written.
`device` is part of a device's name, as in `devices`, or a `Device`; the default is CLSPLAT_DEVICE, or else the
strongest working GPU, or else the first CPU.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import Overrides, PathLike, load_plugins, overrides, to_path
from clsplat.core.errors import ConfigError

if TYPE_CHECKING:  # the command line starts without OpenCL
    from clsplat.opencl.device import Device
    from clsplat.runs.run_folder import Start
    from clsplat.sweeps.experiment import Job


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

    pipeline: a file, or the name of a shipped one
    scene: folder of the dataset; default: the scene of the pipeline
    out: the run folder; default: runs/NAME
    set: settings by key, such as {"optimize.steps": 3000}
    start: "resume" continues from the newest checkpoint in `out`, if there is one; "restart" starts over if `out` has
        a run, and removes its checkpoints and metrics
    live: port of a web page on this machine that shows the model while it trains; 0: the default port
    minutes: choose the number of steps to fit this time, counted from the reading of the photos
    on: a file that says where the cells of a matrix run, instead of its `execution`
    """
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
    """Check everything that `run` needs, and return what it would do as text; nothing is written."""
    return _job(pipeline, scene, out, set, start, on).describe(device)


def resume(
    folder: PathLike,
    scene: PathLike | None = None,
    *,
    set: Overrides = (),
    steps: int | None = None,
    device: "str | Device | None" = None,
    live: int | None = None,
    on: PathLike | None = None,
) -> Path:
    """Continue a run, or a matrix, from its newest checkpoint, as `clsplat resume` does; return the run folder.

    scene: the new folder of the photos, if they were moved; steps: train up to this step; set, live, on: as for `run`.
    """
    return run_job(resume_job(folder, scene, set, steps, on), device, live)


def resume_job(
    folder: PathLike, scene: PathLike | None, set: Overrides, steps: int | None, on: PathLike | None
) -> "Job":
    """Return the job that `resume` runs, to describe it instead."""
    from clsplat.pipeline.execution import read_execution
    from clsplat.sweeps.experiment import Job

    load_plugins()
    return Job.resume(Path(folder), overrides(set), to_path(scene), read_execution(to_path(on)), steps)


def status(folder: PathLike) -> dict[str, Any]:
    """Return the state of a run or a matrix from its files: the content of status.json, `last` report, and `metrics`.

    A matrix has `cells`, `done`, and `failed` instead of a step.  `silent` is the time since the last heartbeat of an
    unfinished run, s, and `ahead` the time by which it is in the future, if more than a minute; the state is "killed"
    if the process is gone.  `advice` says how to continue.  The store of a sweep has `cells`, `counts` of their states,
    and `events`; a scene in blocks has `state` and `parts`.
    """
    from clsplat.workflows.folder import parse_status

    return parse_status(Path(folder))


def status_schema() -> dict[str, Any]:
    """Return the JSON schema of status.json, for programs that watch runs."""
    from clsplat.training.status import status_schema

    return status_schema()


def check(pipeline: PathLike) -> dict[str, Any]:
    """Validate a pipeline or a matrix, verify a run folder, or inspect a model file.

    A pipeline or a matrix returns `path`, `name`, `stages` or `cells`, and `adapts`: the keys that the photos will
    decide.  The folder of a run, or of a scene in blocks, returns `whole`, `state`, and `objects`: each file, whether
    it is `whole`, and a `detail`.  A model file returns `format`, `ranges`, `bounds`, `degenerate` counts, `findings`,
    and `valid`.
    """
    from clsplat.workflows.folder import check

    load_plugins()
    return check(str(pipeline))


def pipeline_schema() -> dict[str, Any]:
    """Return the JSON schema of pipeline files, with the variants of plug-ins."""
    from clsplat.pipeline.recipes import json_schema

    load_plugins()
    return json_schema()


def pipelines(name: PathLike | None = None) -> Any:
    """Return `name`, `summary`, and `path` of all shipped pipelines, or those and `stages` and `keys` of one."""
    from clsplat.pipeline import recipes

    load_plugins()
    return recipes.summaries() if name is None else recipes.manual(str(name))


def copy_pipeline(name: PathLike, file: PathLike) -> Path:
    """Copy a pipeline to a file, or into a folder; return the copy.  Existing files are never replaced."""
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
    """Measure a model at the views of a scene; return metrics by split and downscale factor, as in metrics.json.

    model, scene: as for `render_views`; downscales: divisors of the image size; metrics: some of psnr (dB), ssim,
    ms_ssim and flip; lpips: an ONNX file; lpips_input: the range of pixel values that it expects.
    """
    from clsplat.metrics.perceptual import Perceptual, metric_names
    from clsplat.runs.model_file import ModelFile

    load_plugins()
    if invalid := [value for value in downscales or () if not 1 <= value < math.inf]:
        raise ConfigError(f"--downscales: expected downscale factors of at least 1, got {invalid[0]:g}")
    perceptual = Perceptual.open(metric_names(metrics), to_path(lpips), lpips_input)
    return ModelFile(Path(model), to_path(scene), device).evaluate(downscales, perceptual)


def _job(
    pipeline: PathLike,
    scene: PathLike | None,
    out: PathLike | None,
    values: Overrides,
    start: "Start",
    on: PathLike | None = None,
) -> "Job":
    from clsplat.pipeline.execution import read_execution
    from clsplat.sweeps.experiment import Job

    load_plugins()
    return Job.open(str(pipeline), to_path(scene), to_path(out), overrides(values), start, read_execution(to_path(on)))


def run_job(job: "Job", device: "str | Device | None", live: int | None = None, minutes: float | None = None) -> Path:
    """Run a job and return its folder; arguments as for `Job.run`.  Raises ClsplatError."""
    from clsplat.opencl.device import Device
    from clsplat.pipeline.matrix import Experiment

    work = job.work
    if not isinstance(work, Experiment) or not work.execution.has_store:
        job.run(device, live, minutes)
        return job.out
    if live is not None or minutes is not None:
        raise ConfigError("--live and --minutes are for single runs; the cells of a store run in other processes")
    if isinstance(device, Device):
        raise ConfigError("device: expected a name, because the cells of a store run in other processes")
    if device is not None and work.execution.has_workers:
        raise ConfigError("--device: with a scheduler, workers choose the devices; use `clsplat worker --device NAME`")
    from clsplat.sweeps.batch import run_sweep  # slow to import, and not needed for a single run

    run_sweep(work, job.state, work.execution, device, job.start)
    return job.out


# Compression and levels of detail.


def compress_model(
    model: PathLike,
    scene: PathLike | None = None,
    target: str = "-0.1dB",
    out: PathLike = "runs/compress",
    *,
    format: Literal["sog", "spz"] = "sog",
    keep: Sequence[float] | None = None,
    steps: int | None = None,
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Find the smallest file of a model within a loss of quality, or the best file of a size.

    model, scene: as for `render_views`; target: "-0.1dB" or "5MB"; out: folder for the file, a page, and all trials;
    keep: fractions of the Gaussians to try; steps: training steps after each pruning, default 1000, and a fifth of that
    for each palette.  Returns the content of compress.json, with `file` and `page`.  Raises ConfigError for a target
    that no file meets.
    """
    from clsplat.workflows import compress

    load_plugins()
    keeps = compress.KEEPS if keep is None else keep
    folder = Path(out)
    return compress.compress(
        Path(model), to_path(scene), target, folder, form=format, keeps=keeps, steps=steps, device=device
    )


def write_levels(
    model: PathLike,
    folder: PathLike,
    scene: PathLike | None = None,
    *,
    levels: int = 4,
    keep: float = 0.5,
    steps: int | None = None,
    downscale: float | None = None,
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Write a model in levels of detail, as streamed SOG (lod-meta.json).

    model, scene: as for `render_views`, but without a scene nothing is trained, and ConfigError is raised for `steps`,
    `downscale`, or `device`; levels: their number, including the model itself; keep: fraction of the Gaussians of the
    previous level; steps: training steps of each coarser level, default 500, 0 for none; downscale: divisor of the
    image size in training, by default that of the run.  Returns `folder`, `bytes`, the measured `split`, and
    `levels` with `gaussians`, `bytes`, `merged_psnr`, before training, and `psnr`, dB.
    """
    from clsplat.workflows.lod import LodPlan, levels_of_detail

    load_plugins()
    plan = LodPlan(levels, keep, steps, downscale)
    return levels_of_detail(Path(model), Path(folder), to_path(scene), plan, device)


# Training a large scene in blocks.


def plan_in_blocks(
    scene: PathLike, pipeline: str = "blocks", *, blocks: int = 4, device: "str | Device | None" = None
) -> dict[str, Any]:
    """Partition a scene by its points, without training it or writing files.

    Returns the content of partition.json, with the estimated time of each block as `seconds`.
    """
    from clsplat.workflows.blocks import plan_blocks

    load_plugins()
    return plan_blocks(Path(scene), blocks, pipeline, device)


def train_in_blocks(
    scene: PathLike,
    out: PathLike = "runs/blocks",
    pipeline: str = "blocks",
    *,
    blocks: int = 4,
    coarse: PathLike = "blocks_coarse",
    min_coverage: float = 0.05,
    steps: Literal["each", "shared"] = "each",
    overrides: "Sequence[str]" = (),
    coarse_overrides: "Sequence[str]" = (),
    only_plan: bool = False,
    on: PathLike | None = None,
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Train a scene in blocks: partition a coarse model, train each block with the views that see it, and merge them.

    out: a folder; an interrupted call continues there; coarse: a pipeline that trains the coarse model, or a model file
    or run; min_coverage: a view trains a block that covers more than this fraction of its pixels; steps: "each": all
    steps of the pipeline for each block, "shared": a fraction in proportion to its number of views; overrides:
    'stage.key=value'; only_plan: stop after the partition; on: a file that says where to train the blocks.
    Returns the content of partition.json, `run`, the folder of the merged model, and `metrics`.
    """
    from clsplat.pipeline.execution import Execution, read_execution
    from clsplat.workflows.blocks import BlocksPlan, train_in_blocks

    load_plugins()
    plan = BlocksPlan(pipeline, str(coarse), blocks, min_coverage, steps, list(overrides), list(coarse_overrides))
    values = read_execution(to_path(on))
    execution = None if values is None else Execution.model_validate(values)
    return train_in_blocks(Path(scene), Path(out), plan, device, only_plan=only_plan, execution=execution)


# The cells of a sweep.


def run_cell(
    pipeline: PathLike,
    store: PathLike,
    scene: PathLike | None = None,
    *,
    index: int | None = None,
    set: Overrides = (),
    device: str | None = None,
) -> Path:
    """Run a cell of a matrix, or a pipeline as a cell, and store its result; return the folder of the result.

    index: index of the cell in the matrix, from 0.  A cell whose result is in the store is not run again.
    """
    from clsplat.runs.model_file import with_scene_path
    from clsplat.sweeps.batch import run_one

    load_plugins()
    return run_one(str(pipeline), Path(store), with_scene_path(overrides(set), to_path(scene)), index, device)


def cancel(store: PathLike, cell: str | None = None) -> str:
    """Ask running cells of a store, or one of them by name or key, to save their state and stop.

    Return the key, or "all".
    """
    from clsplat.sweeps.store import Store

    return Store.open(Path(store)).cancel(cell)


def run_worker(
    scheduler: str,
    devices: Sequence[str] | None = None,
    *,
    tls: tuple[str | None, str | None, str | None] = (None, None, None),
    insecure: bool = False,
) -> None:
    """Offer the devices of this machine to a scheduler, dask://HOST:PORT or tls://HOST:PORT, until it ends.

    devices: names, by default all devices that work; tls: files of the CA certificate, the certificate, and its key.
    """
    from clsplat.pipeline.execution import from_options
    from clsplat.sweeps.dask import offer  # where Dask is installed

    load_plugins()
    certificates = {key: file for key, file in zip(("ca", "cert", "key"), tls, strict=True) if file} or None
    offer(from_options({"engine": scheduler, "insecure": insecure, "tls": certificates}), devices)


# Conversion of model files.


def convert(
    sources: PathLike | Sequence[PathLike],
    out: PathLike,
    *,
    sh_degree: int | None = None,
    quality: Literal["small", "balanced", "high"] = "balanced",
    crop: str | Sequence[float] | None = None,
    transform: str | None = None,
    drop_below: float = 0.0,
    time: float | None = None,
    frames: int | None = None,
    world: bool = False,
) -> dict[str, Any]:
    """Merge models into one file, in the format of its extension; return `format`, `gaussians`, and `bytes`.

    crop: x0, y0, z0, x1, y1, z1 in world coordinates, after `transform`, such as "scale=2 rotate=90,0,0" (degrees);
    drop_below: an opacity.  Gaussians that are not finite, or without rotation, are dropped.
    time: write a moving model as a static one, at this time from 0 to 1; frames: write this number of files, one per
    timestamp, to the folder `out` as PLY, or to files named `out` with a number added; world: write world coordinates
    instead of an origin.
    """
    from clsplat.gaussians import conversion
    from clsplat.gaussians.conversion import check_time, convert_frames
    from clsplat.runs.model_file import refuse_field

    files = [Path(source) for source in ([sources] if isinstance(sources, str | Path) else sources)]
    for file in files:
        refuse_field(file)
    box = crop if isinstance(crop, str) or crop is None else ",".join(map(str, crop))
    changes = conversion.Changes(
        drop_below,
        None if transform is None else conversion.parse_transform(transform),
        None if box is None else conversion.parse_crop(box),
        conversion.check_degree(sh_degree),
        check_time(time),
        world,
    )
    if frames is not None:
        return convert_frames(files, Path(out), frames, changes, quality)
    return conversion.convert(files, Path(out), changes, quality)


# Pages about runs and models.


def compare_runs(runs: Sequence[PathLike], out: PathLike = "compare.html", published: PathLike | None = None) -> int:
    """Write a page that compares runs; return their number.  A matrix folder is replaced by its finished runs.

    published: a YAML file with published metrics, which are shown in a separate table.
    """
    from clsplat.core.files import check_result_path
    from clsplat.sweeps.compare.comparison import read_published
    from clsplat.sweeps.compare.page import write_comparison

    check_result_path(Path(out), ".html")
    tables = [] if published is None else read_published(Path(published))
    return write_comparison([Path(folder) for folder in runs], Path(out), published=tables)


def view(
    *models: PathLike,
    scene: PathLike | None = None,
    out: PathLike = "viewer.html",
    photographs: Literal["none", "test", "all"] = "test",
    photograph_budget: float = 4.0,
    splats: int | None = None,
) -> Path:
    """Write a page that shows one model, or two side by side, offline in any browser; return its path.

    models: files or run folders; scene: the page includes its views and photos; default: that of a run folder;
    photographs: which photos to include, up to `photograph_budget` MB; splats: include only this number of Gaussians,
    the most important ones.
    """
    from clsplat.runs import video as videos

    load_plugins()
    return videos.view(
        [Path(model) for model in models],
        to_path(scene),
        Path(out),
        photographs=photographs,
        photograph_budget=photograph_budget,
        splats=splats,
    )
