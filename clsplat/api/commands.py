"""What the commands do, as functions: paths and plain values in, files and plain values out.

The command line prints what these return.  They raise the errors of `clsplat.core.errors`, with the messages of the
commands: ConfigError for a pipeline or an argument, DataError for a dataset or a model, DeviceError for a device,
OutputError for a file that cannot be written.  `device` is a part of a device's name, as `devices` lists them, or a
`Device`; without it CLSPLAT_DEVICE, else the strongest GPU that works, else the first CPU.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import Overrides, PathLike, load_plugins, overrides, path_of
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

    pipeline: a file, or the name of a shipped one; scene: default that of the pipeline; out: default runs/NAME; set:
    settings by place, such as {"optimize.steps": 3000}; start: "resume" goes on from the newest checkpoint in `out`, if
    there is one, "restart" begins again where `out` holds a run, and removes its checkpoints and metrics; live: the
    port of a page on this machine that shows the model while it trains, 0 for the usual one; minutes: the time that the
    run takes once its photographs are read, in as many steps as fit: they are chosen before it starts; on: a file that
    says where the cells of a matrix run, in the place of its `execution`.
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
    """Check all that `run` would need and return what it would do, as lines of text; nothing is written."""
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

    scene: where its photographs are, if they have moved; steps: train to this step; set, live, on: as for `run`.
    """
    return run_job(resume_job(folder, scene, set, steps, on), device, live)


def resume_job(
    folder: PathLike, scene: PathLike | None, set: Overrides, steps: int | None, on: PathLike | None
) -> "Job":
    """Return the job that `resume` runs, to describe it instead."""
    from clsplat.pipeline.execution import read_execution
    from clsplat.sweeps.experiment import Job

    load_plugins()
    return Job.resume(Path(folder), overrides(set), path_of(scene), read_execution(path_of(on)), steps)


def status(folder: PathLike) -> dict[str, Any]:
    """Return how far a run or a matrix is, from its files: what status.json holds, `last` report, `metrics` at the end.

    A matrix has `cells`, `done` and `failed` in the place of the step.  `silent` is the time in s since the last
    heartbeat of a run that has not ended, `ahead` that by which it lies in the future, from a minute on; the state is
    `killed` where its process is gone.  Of the store of a sweep return its `cells`, `counts` of their states, `events`,
    of a scene in blocks its `state` and its `parts`.
    """
    from clsplat.workflows.folder import status_of

    return status_of(Path(folder))


def status_schema() -> dict[str, Any]:
    """Return the JSON schema of status.json, for programs that watch runs."""
    from clsplat.training.status import status_schema

    return status_schema()


def check(pipeline: PathLike) -> dict[str, Any]:
    """Validate a pipeline or a matrix; return its `path`, its `name`, its `stages` or `cells`, and as
    `adapts` the keys that its photographs will decide.

    Of a run folder, or that of a scene in blocks, return `whole`, its `state`, and `objects`: every file, whether it is
    `whole`, and a `detail`.  Of a model file return its `format`, `ranges`, `bounds`, `degenerate` counts, `findings`,
    and whether it is `valid`.
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
    from clsplat.pipeline.execution import read_execution
    from clsplat.sweeps.experiment import Job

    load_plugins()
    return Job.open(str(pipeline), path_of(scene), path_of(out), overrides(values), start, read_execution(path_of(on)))


def run_job(job: "Job", device: "str | Device | None", live: int | None = None, minutes: float | None = None) -> Path:
    """Run a job, and return its folder; arguments as for `Job.run`.  Raises ClsplatError."""
    from clsplat.opencl.device import Device
    from clsplat.pipeline.matrix import Experiment

    work = job.work
    if not isinstance(work, Experiment) or work.execution.store_folder is None:
        job.run(device, live, minutes)
        return job.out
    if live is not None or minutes is not None:
        raise ConfigError("--live and --minutes are for one run; the cells of a store run in other processes")
    if isinstance(device, Device):
        raise ConfigError("expected the name of a device: the cells of a store run in other processes")
    if device is not None and work.execution.has_workers:
        raise ConfigError(
            "--device: a scheduler has the devices that its workers offer, by `clsplat worker --device NAME`"
        )
    from clsplat.sweeps.batch import run_sweep  # and what tells devices apart, which a single run does not need

    run_sweep(work, job.state, work.execution, device, job.start)
    return job.out


# A model made small, or in levels of detail, as functions; errors and `device` as in `clsplat.api.commands`.


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
    """Look for the smallest file of a model that loses no more than `target`, or the best one of that size.

    model, scene: as for `render_views`; target: "-0.1dB" or "5MB"; out: a folder, which holds the file, a page and all
    that was tried; keep: shares of the Gaussians to try; steps: of training after each pruning,
    default 1000; with each palette it is a fifth of them.  Returns
    what compress.json holds, `file` and `page`.  Raises ConfigError for a target that no file meets.
    """
    from clsplat.workflows import compress

    load_plugins()
    shares = compress.KEEPS if keep is None else keep
    folder = Path(out)
    return compress.compress(
        Path(model), path_of(scene), target, folder, form=format, keeps=shares, steps=steps, device=device
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
    """Write a model in levels of detail, as streamed SOG (lod-meta.json): each level has a share of the one before.

    model, scene: as for `render_views`, but without a scene nothing is trained, and ConfigError is raised for `steps`,
    `downscale` or `device`; levels: with the model itself; keep: the share; steps: of training each coarser level,
    default 500, 0 for none; downscale: divisor of the photographs' size there, by default that of the model's run.
    Returns `folder`, `bytes`, the `split` that is measured, and `levels` with
    `gaussians`, `bytes`, and in dB `merged_psnr`, before the training, and `psnr`.
    """
    from clsplat.workflows.lod import LodPlan, levels_of_detail

    load_plugins()
    plan = LodPlan(levels, keep, steps, downscale)
    return levels_of_detail(Path(model), Path(folder), path_of(scene), plan, device)


# A scene trained in blocks, as a function; errors and `device` as in `clsplat.api.commands`.


def plan_in_blocks(
    scene: PathLike, pipeline: str = "blocks", *, blocks: int = 4, device: "str | Device | None" = None
) -> dict[str, Any]:
    """Return how a scene would be cut by its points, before anything is trained: what partition.json holds, and the
    time of each block, `seconds`, from some steps on the device.  Nothing is kept.
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
    sight: float = 0.05,
    steps: Literal["each", "shared"] = "each",
    overrides: "Sequence[str]" = (),
    coarse_overrides: "Sequence[str]" = (),
    only_plan: bool = False,
    on: PathLike | None = None,
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Train a scene in blocks: a coarse model is cut, each block is trained from what its views see, all are merged.

    out: a folder, in which an interrupted call goes on; coarse: a pipeline that trains the coarse model, or a model
    file or run; sight: the share of a view's pixels above which it belongs to a block; steps: of each block those of
    the pipeline, or its share of them by its views; overrides: 'stage.key=value'; only_plan: stop after the partition;
    on: a file that says where blocks are trained, as cells of a store, in the place of one after the other here.
    Returns what partition.json holds, `run`, the folder of the merged model, and `metrics`.
    """
    from clsplat.pipeline.execution import Execution, read_execution
    from clsplat.workflows.blocks import BlocksPlan, train_in_blocks

    load_plugins()
    plan = BlocksPlan(pipeline, str(coarse), blocks, sight, steps, list(overrides), list(coarse_overrides))
    values = read_execution(path_of(on))
    execution = None if values is None else Execution.model_validate(values)
    return train_in_blocks(Path(scene), Path(out), plan, device, only_plan=only_plan, execution=execution)


# Functions about the cells of a sweep; errors and `device` as in `clsplat.api.commands`.


def run_cell(
    pipeline: PathLike,
    store: PathLike,
    scene: PathLike | None = None,
    *,
    index: int | None = None,
    set: Overrides = (),
    device: str | None = None,
) -> Path:
    """Run one cell of a matrix, or a pipeline as a cell, and keep it in a store; return the folder of its result.

    index: of the cell in the matrix, from 0.  What is in the store already is not run again.
    """
    from clsplat.runs.model_file import overrides_of
    from clsplat.sweeps.batch import run_one

    load_plugins()
    return run_one(str(pipeline), Path(store), overrides_of(overrides(set), path_of(scene)), index, device)


def cancel(store: PathLike, cell: str | None = None) -> str:
    """Let the cells of a store that have begun save their state and stop, or one of them, by its name or key.

    Return the key, or "all".
    """
    from clsplat.sweeps.store import Store

    return Store.opened(Path(store)).cancel(cell)


def work_for(
    scheduler: str,
    devices: Sequence[str] | None = None,
    *,
    tls: tuple[str | None, str | None, str | None] = (None, None, None),
    insecure: bool = False,
) -> None:
    """Offer the devices of this machine to a scheduler, dask://HOST:PORT or tls://HOST:PORT, until that ends.

    devices: names, default every device that works; tls: files of the authority, the certificate and its key.
    """
    from clsplat.pipeline.execution import from_options
    from clsplat.sweeps.dask import offer  # where Dask is installed

    load_plugins()
    certificates = {key: file for key, file in zip(("ca", "cert", "key"), tls, strict=True) if file} or None
    offer(from_options({"engine": scheduler, "insecure": insecure, "tls": certificates}), devices)


# Model files in another format, as a function.


def convert(
    sources: PathLike | Sequence[PathLike],
    out: PathLike,
    *,
    sh_degree: int | None = None,
    sh_bits: str | None = None,
    axes: Literal["spz", "ply"] = "spz",
    quality: Literal["small", "balanced", "high"] = "balanced",
    keep_nan: bool = False,
    crop: str | Sequence[float] | None = None,
    transform: str | None = None,
    drop_below: float = 0.0,
    time: float | None = None,
    frames: int | None = None,
) -> dict[str, Any]:
    """Write models, merged, as one file of the format that its name stands for; return `format`, `gaussians`, `bytes`.

    sh_bits: of SPZ, such as "8/6"; axes: of SPZ files that are read, or where none is of the one that is written; crop:
    x0, y0, z0, x1, y1, z1 in scene units, after `transform`, such as "scale=2 rotate=90,0,0" (degrees); drop_below: an
    opacity.  Gaussians that are not finite are dropped, unless `keep_nan`.
    time: the moment of a moving model, from 0 to 1, that a static one is written of; frames: so many moments, each in a
    file of its own: `out` is a folder, for PLY, or the name whose number is still to come.
    """
    from clsplat.gaussians import conversion
    from clsplat.gaussians.conversion import check_time, convert_frames
    from clsplat.runs.model_file import refuse_field

    files = [Path(source) for source in ([sources] if isinstance(sources, str | Path) else sources)]
    for file in files:
        refuse_field(file)
    box = crop if isinstance(crop, str) or crop is None else ",".join(map(str, crop))
    options = conversion.ConversionOptions(sh_bits, axes, quality, keep_nan)
    changes = conversion.Changes(
        drop_below,
        None if transform is None else conversion.parse_transform(transform),
        None if box is None else conversion.parse_crop(box),
        conversion.check_degree(sh_degree),
        check_time(time),
    )
    if frames is not None:
        return convert_frames(files, Path(out), frames, changes, options)
    return conversion.convert(files, Path(out), changes, options)


# Pages of runs and models as functions; errors as in `clsplat.api.commands`.


def compare_runs(runs: Sequence[PathLike], out: PathLike = "compare.html", published: PathLike | None = None) -> int:
    """Write the page that shows runs side by side; return their number.  The folder of a matrix stands for its runs.

    published: a YAML file of figures that others have published, which are shown below, apart.
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
    """Write a page that shows one model, or two with one camera, in any browser and offline; return the page.

    models: files or run folders; scene: whose views and photographs are in the page, by default that of a run folder;
    photographs: of which views, up to `photograph_budget` MB; splats: only so many, the most important ones.
    """
    from clsplat.runs import film

    load_plugins()
    return film.view(
        [Path(model) for model in models],
        path_of(scene),
        Path(out),
        photographs=photographs,
        photograph_budget=photograph_budget,
        splats=splats,
    )
