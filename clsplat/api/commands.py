"""Provide the commands of the command line as functions.

They accept paths and plain values, write files, and return plain values, which the command line prints.  They raise the
errors of `clsplat.core.errors`: ConfigError for a pipeline or an argument, DataError for a dataset or a model,
DeviceError for a device, and OutputError for a file that cannot be written.

`device` is part of the name of a device, as returned by `devices`, or an open `Device`.  The default is the device that
CLSPLAT_DEVICE names, otherwise the strongest working GPU, or the first CPU if there is no such GPU.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import Overrides, PathLike, load_plugins, overrides, to_path
from clsplat.core.errors import ConfigError

if TYPE_CHECKING:  # the command line must start without importing OpenCL
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
    """Run a pipeline or a matrix, as `clsplat run` does, and return the run folder.

    pipeline: a file, or the name of a shipped pipeline
    scene: the dataset folder; default: the scene that the pipeline names
    out: the run folder; default: runs/NAME
    set: settings by key, such as {"optimize.steps": 3000}
    start: "resume" continues from the newest checkpoint in `out`, if there is one; "restart" removes the checkpoints
        and metrics of an existing run in `out` and starts over
    live: port of a web page on this machine that shows the model while it trains; 0 selects the default port
    minutes: choose the number of steps so that the run takes this many minutes, including the reading of the photos
    on: an execution file, which specifies where the cells of a matrix run; it replaces the matrix's `execution`
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
    """Check all inputs of `run` without running it or writing files, and return a description of the run as text.

    The arguments are those of `run`.
    """
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
    """Continue a run or a matrix from its newest checkpoint, as `clsplat resume` does, and return the run folder.

    folder: the run folder
    scene: the new path of the dataset folder, if it was moved
    steps: train up to this step
    set, live, on: as for `run`
    """
    return run_job(resume_job(folder, scene, set, steps, on), device, live)


def resume_job(
    folder: PathLike, scene: PathLike | None, set: Overrides, steps: int | None, on: PathLike | None
) -> "Job":
    """Return the job that `resume` runs, so that it can also be described without running it."""
    from clsplat.pipeline.execution import read_execution
    from clsplat.sweeps.experiment import Job

    load_plugins()
    return Job.resume(Path(folder), overrides(set), to_path(scene), read_execution(to_path(on)), steps)


def status(folder: PathLike) -> dict[str, Any]:
    """Return the state of a run or a matrix from its files.

    A run has the keys of status.json, its last report as `last`, and its `metrics`.  A matrix has `cells`, `done`, and
    `failed` instead of a step.  An unfinished run also has `silent`, the seconds since its last heartbeat.  If clocks
    differ and the heartbeat is at least 60 s in the future, `ahead` is the difference in seconds.  The state of a run
    is "killed" if its process no longer exists.  `advice` says how to continue.

    A store has `cells`, the `counts` of cells by state, and `events`.  A scene that is trained in blocks has
    `state` and `parts`.
    """
    from clsplat.workflows.folder import read_status

    return read_status(Path(folder))


def status_schema() -> dict[str, Any]:
    """Return the JSON schema of status.json, for programs that watch runs."""
    from clsplat.training.status import status_schema

    return status_schema()


def check(pipeline: PathLike) -> dict[str, Any]:
    """Validate a pipeline or a matrix, verify a run folder, or inspect a model file.

    The keys of the result depend on what is checked:

    - A pipeline or a matrix: `path`, `name`, `stages` or `cells`, and `adapts` (the keys whose values depend on the
      photos).
    - A run folder, or the folder of a scene in blocks: `whole` (whether all files are intact), `state`, and `objects`,
      a list of files, each with `whole` and a `detail`.
    - A model file: `format`, `ranges`, `bounds`, the counts of `degenerate` Gaussians, `findings`, and `valid`.
    """
    from clsplat.workflows.folder import check

    load_plugins()
    return check(str(pipeline))


def pipeline_schema() -> dict[str, Any]:
    """Return the JSON schema of pipeline files, including the classes that plug-ins add."""
    from clsplat.pipeline.recipes import json_schema

    load_plugins()
    return json_schema()


def pipelines(name: PathLike | None = None) -> Any:
    """List the shipped pipelines with their `name`, `summary`, and `path`, or describe the pipeline `name`.

    A description has these keys, and also `stages` and `keys`.
    """
    from clsplat.pipeline import recipes

    load_plugins()
    return recipes.summaries() if name is None else recipes.manual(str(name))


def find_variant(name: PathLike, key: Literal["short", "draft", "high"]) -> str:
    """Return the name or path of a pipeline's variant, such as `photos_high`.  Raises ConfigError if there is none."""
    from clsplat.pipeline import files

    return files.variant_name(str(name), key)


def copy_pipeline(name: PathLike, file: PathLike) -> Path:
    """Copy a pipeline to a file or into a folder; return the path of the copy.  Existing files are never replaced."""
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
    """Measure a model at the views of a scene.  Return metrics by split and downscale factor, as in metrics.json.

    model, scene: as for `render_views`
    downscales: divisors of the image size
    metrics: any of "psnr" (in dB), "ssim", "ms_ssim", and "flip"
    lpips: an ONNX file of an LPIPS network
    lpips_input: the range of the pixel values that this network expects
    """
    from clsplat.metrics.perceptual import Perceptual, metric_names
    from clsplat.runs.model_file import ModelFile

    load_plugins()
    if invalid_values := [value for value in downscales or () if not 1 <= value < math.inf]:
        raise ConfigError(f"downscales: expected factors of at least 1, got {invalid_values[0]:g}")
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
    """Run a job and return its folder.  The arguments are those of `Job.run`.  Raises ClsplatError."""
    from clsplat.opencl.device import Device
    from clsplat.pipeline.matrix import Experiment

    experiment = job.work
    if not isinstance(experiment, Experiment) or not experiment.execution.has_store:
        job.run(device, live, minutes)
        return job.out
    if live is not None or minutes is not None:
        raise ConfigError("--live and --minutes are for single runs; omit them for a matrix with a store")
    if isinstance(device, Device):
        raise ConfigError("device: expected a name, because the cells of a store run in other processes")
    if device is not None and experiment.execution.has_workers:
        raise ConfigError("--device: with a scheduler, workers choose the devices; use `clsplat worker --device NAME`")
    from clsplat.sweeps.batch import run_sweep  # slow to import, and not needed for a single run

    run_sweep(experiment, job.state, experiment.execution, device, job.start)
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
    """Compress a model to the smallest file within a limit on quality loss, or the best file within a limit on size.

    model, scene: as for `render_views`
    target: the limit, such as "-0.1dB" (of PSNR) or "5MB"
    out: folder for the file, a page about the search, and all trials
    format: the file format
    keep: the fractions of the Gaussians that the trials keep; default: six fractions from 0.18 to 1
    steps: training steps after each pruning, 1000 by default; each palette is trained for a fifth of these steps

    Returns the content of compress.json, with `file` and `page`.  Raises ConfigError for a target that no file meets.
    """
    from clsplat.workflows import compress

    load_plugins()
    keeps = compress.KEEPS if keep is None else keep
    folder = Path(out)
    return compress.compress(
        Path(model), to_path(scene), target, folder, file_format=format, keeps=keeps, steps=steps, device=device
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
    """Write a model at several levels of detail, as streamed SOG (lod-meta.json).

    model, scene: as for `render_views`; without a scene, no level is trained, and `steps`, `downscale`, and `device`
        raise ConfigError
    folder: the new folder
    levels: the number of levels, including the model itself
    keep: number of Gaussians of each level, as a fraction of the previous level
    steps: training steps of each coarser level, 500 by default; 0 turns training off
    downscale: divisor of the image size in training; default: the downscale factor of the run

    Returns `folder`, `bytes`, `split` (the views that were measured), and `levels`.  Each level has `gaussians`,
    `bytes`, `merged_psnr` (dB, before training), and `psnr` (dB).
    """
    from clsplat.workflows.lod import LodPlan, build_levels

    load_plugins()
    plan = LodPlan(levels, keep, steps, downscale)
    return build_levels(Path(model), Path(folder), to_path(scene), plan, device)


def write_mesh(
    model: PathLike,
    file: PathLike,
    scene: PathLike | None = None,
    *,
    voxel: float | None = None,
    keep: float = 1.0,
    collision: bool = False,
    downscale: float | None = None,
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Write the surface of a model as a mesh with colors and normals, in world coordinates.

    model, scene, downscale: as for `render_views`; the depths of the training views are fused
    file: a .ply, .obj, or .glb file
    voxel: the edge length of a voxel, in scene units; default: 1.2 pixels at the median depth
    keep: reduce the mesh to this fraction of its faces; this requires the extra `mesh`
    collision: write a collision mesh instead: the closed surface around all space that fewer than two views see as
        empty; the default voxel is then twice as large

    Returns `file`, `bytes`, the numbers of `vertices` and `faces`, the `voxel`, and whether the surface is `closed`.
    Raises DataError for a dynamic model, a field, or a model without an opaque surface.
    """
    from clsplat.workflows import mesh

    load_plugins()
    options = mesh.MeshOptions(voxel, keep, collision)
    return mesh.write_mesh(Path(model), Path(file), to_path(scene), options, downscale, device)


# Training a large scene in blocks.


def plan_in_blocks(
    scene: PathLike, pipeline: str = "blocks", *, blocks: int = 4, device: "str | Device | None" = None
) -> dict[str, Any]:
    """Partition a scene into blocks by its points, without training or writing files.

    Returns the content of partition.json, with the estimated training time of each block in `seconds`.
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

    scene: the dataset folder
    out: folder for all runs; to continue an interrupted call, repeat it with the same folder
    pipeline: the pipeline that trains each block
    blocks: the number of blocks
    coarse: a pipeline that trains the coarse model, or a model file or run folder
    min_coverage: a block trains on a view if it covers more than this fraction of the view's pixels
    steps: "each" trains every block for all steps of the pipeline; "shared" trains a block for a fraction of the steps,
        in proportion to its number of views
    overrides, coarse_overrides: settings of the two pipelines, as 'stage.key=value'
    only_plan: stop after the partition
    on: an execution file, which specifies where to train the blocks

    Returns the content of partition.json, `run` (the folder of the merged model), and `metrics`.
    """
    from clsplat.pipeline.execution import Execution, read_execution
    from clsplat.workflows.blocks import BlocksPlan, train_in_blocks

    load_plugins()
    plan = BlocksPlan(pipeline, str(coarse), blocks, min_coverage, steps, list(overrides), list(coarse_overrides))
    settings = read_execution(to_path(on))
    execution = None if settings is None else Execution.model_validate(settings)
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
    """Run a cell of a matrix, or a pipeline as a single cell, and store the result.  Return the folder of the result.

    store: the folder of the store
    index: index of the cell in the matrix, from 0

    A cell that already has a result in the store is not run again.
    """
    from clsplat.runs.model_file import with_scene_path
    from clsplat.sweeps.batch import run_one

    load_plugins()
    return run_one(str(pipeline), Path(store), with_scene_path(overrides(set), to_path(scene)), index, device)


def cancel(store: PathLike, cell: str | None = None) -> str:
    """Request that all running cells of a store, or the cell with this name or key, save their state and stop.

    Returns the key of the cell, or "all".
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
    """Run cells from a scheduler on the devices of this machine until the scheduler exits.

    scheduler: the address of the scheduler, dask://HOST:PORT or tls://HOST:PORT
    devices: names of devices; default: all working devices
    tls: paths of the CA certificate, the certificate, and its private key
    insecure: allow a connection without TLS
    """
    from clsplat.pipeline.execution import from_options
    from clsplat.sweeps.dask import offer_devices  # requires Dask

    load_plugins()
    certificates = {key: file for key, file in zip(("ca", "cert", "key"), tls, strict=True) if file} or None
    offer_devices(from_options({"engine": scheduler, "insecure": insecure, "tls": certificates}), devices)


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
    filter_floaters: bool = False,
    level: bool = False,
    splats: int | None = None,
    sky: Literal["splats", "none"] | None = None,
    time: float | None = None,
    frames: int | None = None,
    world: bool = False,
    collider: PathLike | None = None,
) -> dict[str, Any]:
    """Merge models into one file, whose suffix selects the format.  Gaussians with invalid values are dropped.

    The suffix .html writes a viewer page without a scene.  Returns `file`, `format`, `gaussians`, and `bytes`.

    crop: x0, y0, z0, x1, y1, z1 in world coordinates, after `transform`
    transform: such as "scale=2 rotate=90,0,0" (degrees)
    drop_below: drop Gaussians with a lower opacity
    filter_floaters: drop Gaussians that are large and faint, isolated, or far outside the scene; needs no photos
    level: move the model so that its ground is at y = 0 and -y points up; the ground must be within 45° of level
    splats: merge neighbors until this number of Gaussians remains, not counting the sky
    sky: "splats" writes a learned sky as distant Gaussians, "none" removes it; default: leave it as it is
    time: write a dynamic model as a static model at this time, in [0, 1]
    frames: write this number of static files at evenly spaced times: PLY files in the folder `out`, or files named
        `out` with a number added
    world: write world coordinates, not coordinates relative to an origin
    collider: a .ply or .obj mesh in the coordinates of the models, which OpenUSD stores for collisions
    """
    from clsplat.gaussians import conversion
    from clsplat.runs.model_file import refuse_field
    from clsplat.runs.video import PAGE_ENDINGS, convert_to_page

    files = [Path(source) for source in ([sources] if isinstance(sources, str | Path) else sources)]
    for file in files:
        refuse_field(file)
    box = crop if isinstance(crop, str) or crop is None else ",".join(map(str, crop))
    changes = conversion.Changes(
        drop_below,
        filter_floaters,
        None if transform is None else conversion.parse_transform(transform),
        level,
        None if box is None else conversion.parse_crop(box),
        conversion.check_degree(sh_degree),
        conversion.check_time(time),
        world,
        sky,
        splats,
        to_path(collider),
    )
    if frames is not None:
        return conversion.convert_frames(files, Path(out), frames, changes, quality)
    write = convert_to_page if Path(out).suffix.lower() in PAGE_ENDINGS else conversion.convert
    return write(files, Path(out), changes, quality)


def align(
    path: PathLike,
    out: PathLike,
    scene: PathLike | None = None,
    *,
    level: Literal["cameras", "ground"] | None = None,
    distances: Sequence[str] = (),
    gps: bool = False,
    control: PathLike | None = None,
    format: Literal["colmap", "nerfstudio", "inria"] = "colmap",
    images: Literal["none", "copy"] = "copy",
) -> dict[str, Any]:
    """Give a scene or a model a known scale, up direction, or position, as `clsplat align` does.

    path: a dataset folder, a model file, or a run folder
    out: a model file; for a dataset, a folder for its cameras in this `format`, with the photos if `images` is "copy"
    scene: the dataset of a model file
    level: the source of the up direction, cameras or ground; up becomes -y
    distances: known distances (scale bars), each as "A;B=1.25", in the new unit of length; A and B are "x,y,z",
        "PHOTO:u,v+PHOTO:u,v", or names of control points
    gps: use the GPS positions in the EXIF data of the photos; coordinates become UTM, and z points up
    control: a CSV file of control points: their world coordinates, if known, and their positions in photos, px; one
        photo per row; columns: point, x, y, z, photo, u, and v

    Returns `scale`, `matrix` (4 x 4), `epsg`, `rms`, the names of `outliers`, the errors of `points` and `distances`,
    and `files`.  Raises DataError if the points do not determine the transform.
    """
    from clsplat.workflows.align import AlignOptions
    from clsplat.workflows.align import align as align_files

    load_plugins()
    options = AlignOptions(level, tuple(distances), gps, to_path(control))
    return align_files(Path(path), Path(out), to_path(scene), options, format, images)


# Pages about runs and models.


def compare_runs(runs: Sequence[PathLike], out: PathLike = "compare.html", published: PathLike | None = None) -> int:
    """Write a page that compares runs; return the number of runs.  A matrix folder stands for all its finished runs.

    published: a YAML file of published metrics, which are shown in a separate table
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
    """Write a page that shows one model, or two side by side, offline in any browser.  Return its path.

    models: model files or run folders
    scene: the dataset whose views and photos are included; default: the dataset of a run folder
    photographs: the photos to include, up to `photograph_budget` MB
    splats: include only this number of Gaussians, selected by importance
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
