"""Train a scene in blocks: a coarse model, its partition, runs of blocks, and the merged model."""

import hashlib
import json
import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.quick import open_verified
from clsplat.core.errors import (
    ClsplatError,
    ConfigError,
    DataError,
    EmptyRegionError,
    one_line,
    pluralize,
    quote,
    shell_quote,
)
from clsplat.core.files import METRICS
from clsplat.core.progress import log_level
from clsplat.core.reading import read_json, sha256
from clsplat.core.text_table import text_table
from clsplat.formats.ply import join_plys
from clsplat.formats.table import detect
from clsplat.gaussians.conversion import from_points
from clsplat.gaussians.model import DEFAULT_RENDERING, Model, model_path, raw_model_path
from clsplat.gaussians.model import load as load_model
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photographs
from clsplat.pipeline.execution import Execution
from clsplat.pipeline.input_files import with_content_hashes
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.matrix import Cell as MatrixCell
from clsplat.runs.estimate import MAX_PER_PIXEL, format_minutes, max_gaussians, step_seconds
from clsplat.runs.failures import Failures
from clsplat.runs.model_file import path_setting, photo_folder, require_model
from clsplat.runs.opening import read_run_scene, with_lengths
from clsplat.runs.status import format_status
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.sweeps.batch import Batch
from clsplat.sweeps.store import Store
from clsplat.workflows.block_pipelines import (
    block_pipeline,
    coarse_pipeline,
    merged_pipeline,
    require_divisible,
    without_start,
)
from clsplat.workflows.finetune import claim_folder, is_trained, train_in_folder
from clsplat.workflows.folder import COARSE, MERGED, RECORD
from clsplat.workflows.partition import MIN_COVERAGE, Block, Partition, Partitioner

# Estimates of the training time of blocks.


def block_seconds(
    blocks: Sequence[Block], pipelines: Mapping[str, Pipeline], size: tuple[int, int], units: int
) -> dict[str, list[float]]:
    """Return two training times, s, for each block: with its initial and with its maximum number of Gaussians.

    pipelines: by block name; size: of a photo, px; units: compute units of the device.
    """
    times = {}
    for block in blocks:
        estimates = (step_seconds(units, size, count) for count in _gaussian_range(block, pipelines[block.name], size))
        steps = sum(training.steps for training in _optimize_stages(pipelines[block.name]))
        times[block.name] = [steps * estimate[end] for end, estimate in enumerate(estimates)]
    return times


def _gaussian_range(block: Block, pipeline: Pipeline, size: tuple[int, int]) -> tuple[int, int]:
    """Return the initial and maximum numbers of Gaussians of a block.  Without a limit, the maximum is a guess."""
    initial_count, pixels = int(block.start.sum()), size[0] * size[1]
    limits = [max_gaussians(stage) or block.pairs * MAX_PER_PIXEL * pixels for stage in _optimize_stages(pipeline)]
    return initial_count, max(initial_count, int(max(limits)) + initial_count - block.gaussians)


def _optimize_stages(pipeline: Pipeline) -> list[Optimize]:
    return [stage for stage in pipeline.stages if isinstance(stage, Optimize)]


LOG = logging.getLogger("clsplat")
MAX_BLOCKS = 99  # two digits, as in the names of block folders
Steps = Literal["each", "shared"]


@dataclass(frozen=True)
class BlocksPlan:
    """The options for training in blocks."""

    pipeline: str = "blocks"
    coarse: str = "blocks_coarse"  # a pipeline, or a model
    blocks: int = 4
    min_coverage: float = MIN_COVERAGE  # fraction of a view's pixels above which it belongs to a block
    steps: Steps = "each"  # per block: all steps of the pipeline, or a fraction in proportion to its views
    overrides: list[str] = field(default_factory=list)
    coarse_overrides: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not 1 <= self.blocks <= MAX_BLOCKS:
            raise ConfigError(f"--blocks {self.blocks}: expected 1 to {MAX_BLOCKS}")
        if not 0 <= self.min_coverage < 1:
            raise ConfigError(f"--min-coverage {self.min_coverage:g}: expected a fraction from 0 to below 1")
        if self.steps not in get_args(Steps):
            raise ConfigError(f"--steps {quote(self.steps)}: expected one of {', '.join(get_args(Steps))}")


class Blocks:
    """Trains the blocks of a scene in a folder, from the coarse model to the merged one."""

    def __init__(
        self, scene: Path, out: Path, plan: BlocksPlan, device: str | Device | None, execution: Execution | None = None
    ) -> None:
        """execution: where blocks are trained; by default one after another in this process."""
        if execution is not None and not execution.has_store:
            raise ConfigError("--on: blocks need a store; add `store` to that file, or use an engine other than inline")
        self.out, self.plan, self.execution = out, plan, execution
        self._device_name = device if isinstance(device, str) else None
        overrides = [f"scene.path={path_setting(photo_folder(scene))}"]
        self.pipeline = load(plan.pipeline, [*overrides, "init.file=coarse", *plan.overrides])
        require_divisible(self.pipeline)
        self.coarse_file = _coarse_file(plan.coarse)
        self.coarse = (
            None if self.coarse_file else coarse_pipeline(load(plan.coarse, plan.coarse_overrides), self.pipeline)
        )
        if self.coarse_file and plan.coarse_overrides:
            raise ConfigError(
                "--set-coarse: the coarse model is already trained; omit it, or pass a pipeline as --coarse"
            )
        rasterizer = self.pipeline.settings.rasterizer
        self.device = open_verified(device, rasterizer.schedule, rasterizer.sort)
        self.run_scene = read_run_scene(self.pipeline.settings.scene, self.pipeline.settings.scene.folder)
        # a block has other photos, and would choose another near plane
        self.pipeline = with_lengths(self.pipeline, self.run_scene.scene)
        if len(self.run_scene.original.downscales) > 1:
            path = self.run_scene.original.path
            raise DataError(f"{path}: has photos in several sizes; blocks need a single size: resize the photos")

    def identity(self) -> dict[str, Any]:
        """Return the inputs that identify the work: options, and hashes of the photos, pipelines, and coarse model."""
        pipelines = {"pipeline": without_start(self.pipeline), **({"coarse": self.coarse} if self.coarse else {})}
        contents = {
            name: json.dumps(with_content_hashes(pipeline), sort_keys=True) for name, pipeline in pipelines.items()
        }
        digests = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in contents.items()}
        options = {"blocks": self.plan.blocks, "min_coverage": self.plan.min_coverage, "steps": self.plan.steps}
        model = {"model": sha256(self.coarse_file)} if self.coarse_file else {}
        return {**options, "photographs": self.run_scene.identity.digest, **model, **digests}

    def partition(self) -> Partition:
        """Train the coarse model if necessary, partition it, and write the manifest."""
        file = self.coarse_file
        if file is None and self.coarse is not None:
            LOG.info("training the coarse model")
            file = raw_model_path(train_in_folder(self.coarse, self.out / COARSE, self.device))
        assert file is not None
        scene, background = self.run_scene.scene, self.run_scene.background
        model = load_model(file).in_scene(scene)
        photographs = Photographs(self.device, background, budget=0)  # each photo is used once per pass
        partitioner = Partitioner(model, scene, self.device, photographs)
        partition = partitioner.partition(self.plan.blocks, sha256(file), self.plan.min_coverage)
        partition.write(self.out)
        return partition

    def plan_data(self, partition: Partition) -> dict[str, Any]:
        """Return the manifest with the estimated training time of each block."""
        pipelines = {block.name: self.block_pipeline(block, partition) for block in partition.blocks}
        sizes = sorted((view.camera.width, view.camera.height) for view in self.run_scene.scene.split("train"))
        units, size = self.device.info.units, sizes[len(sizes) // 2]
        data, times = partition.data(), block_seconds(partition.blocks, pipelines, size, units)
        return {**data, "blocks": [{**block, "seconds": times[block["name"]]} for block in data["blocks"]]}

    def block_pipeline(self, block: Block, partition: Partition) -> Pipeline:
        """Return the pipeline of a block."""
        fraction = Fraction(len(block.views), partition.views) if self.plan.steps == "shared" else Fraction(1)
        return block_pipeline(self.pipeline, block, self.out / f"{block.name}.ply", partition.extent, fraction)

    def train(self, partition: Partition) -> list[tuple[Block, Path]]:
        """Train the unfinished blocks; return all blocks with their model files, in order.

        A block without Gaussians has no model.  A failed block does not stop the others; the error raised at the
        end names the first failure and has its exit code.
        """
        files, failures = [], Failures("blocks")
        pipelines = {block.name: self.block_pipeline(block, partition) for block in partition.blocks}
        if self.execution:
            self._train_as_cells(self.execution, pipelines, failures)
        for block in partition.blocks:
            if block.name in failures:
                continue
            LOG.info("%s of %d: %s", block.name, len(pipelines), pluralize(len(block.views), "view"))
            with failures.recording(block.name):
                try:
                    model = train_in_folder(pipelines[block.name], self.out / block.name, self.device)
                    files.append((block, raw_model_path(model)))
                except EmptyRegionError:
                    LOG.warning("%s: no Gaussians are left in its cell; continuing without it", block.name)
        if failures:
            remedy = "fix the cause and run the same command again; finished blocks are kept"
            coarse = shell_quote(self.out / COARSE)
            other_settings = f"for other settings, use another --out; --coarse {coarse} reuses the coarse model"
            summary = failures.summary(len(pipelines))
            error = ClsplatError(f"{summary}; {remedy if self.coarse_file else f'{remedy}; {other_settings}'}")
            error.exit_code = summary.exit_code
            raise error
        if not files:
            raise EmptyRegionError("all blocks are empty after training; use another pipeline and another --out")
        return files

    def _train_as_cells(self, execution: Execution, pipelines: dict[str, Pipeline], failures: Failures) -> None:
        """Train the unfinished blocks as cells of a sweep store, and copy their runs to the block folders."""
        cells = [
            MatrixCell(name, pipeline)
            for name, pipeline in pipelines.items()
            if not is_trained(pipeline, self.out / name)
        ]
        if cells:
            name, store = f"{self.pipeline.settings.name}-{self.out.name}", Store(execution.store_folder(self.out))
            Batch(name, str(self.out.resolve()), cells, self.out, store, failures).run(execution, self._device_name)

    def merge(self, block_models: list[tuple[Block, Path]]) -> Path:
        """Merge the models of all blocks in order; return the file."""
        file = self.out / f"{MERGED}.ply"

        def check(number: int, means: NDArray[np.float32]) -> None:
            block, path = block_models[number]
            if not block.box.shifted(block.origin).contains(means).all():  # as the stage crop does
                raise DataError(f"{path}: has Gaussians outside its cell; remove its folder and run the command again")

        count = join_plys(file, [path for _, path in block_models], check)
        LOG.info("%s of %s merged", pluralize(count, "Gaussian"), pluralize(len(block_models), "block"))
        return file

    def finish(self, file: Path) -> Path:
        """Run the stages after training on the merged model; return its folder."""
        run = self.out / MERGED
        train_in_folder(merged_pipeline(self.pipeline, file), run, self.device)
        return run


def train_in_blocks(
    scene: Path,
    out: Path,
    plan: BlocksPlan | None = None,
    device: str | Device | None = None,
    *,
    only_plan: bool = False,
    execution: Execution | None = None,
) -> dict[str, Any]:
    """Train a scene in blocks in a folder; return the manifest and `run`, the folder of the merged model.

    Finished parts of an earlier call are kept, and interrupted ones resume.  If a block fails, raises ClsplatError,
    which names the block.

    only_plan: whether to stop after the partition
    execution: where blocks are trained, as cells of a sweep store; by default, in this process
    """
    blocks = Blocks(scene, out, plan or BlocksPlan(), device, execution)
    with claim_folder(out, blocks.identity(), RECORD, "a scene in blocks", "another --out"):
        partition = blocks.partition()
        if only_plan:
            return {**blocks.plan_data(partition), "run": None}
        run = blocks.finish(blocks.merge(blocks.train(partition)))
    return {**partition.data(), "run": str(run), "metrics": read_json(run / METRICS)}


def _coarse_file(coarse: str) -> Path | None:
    """Return the model file if `coarse` names a model, or None if it names a pipeline.  Raises DataError."""
    path = Path(coarse)
    if path.is_dir() or (path.is_file() and detect(path)):
        require_model(path)
        return raw_model_path(model_path(path))
    return None


# Text tables of a partition and of the state of its runs.

HEADINGS = ("block", "Gaussians", "initial Gaussians", "views", "cameras inside", "pairs", "initial MiB")
TIME_HEADING = "estimated time"
NOTE = "memory: at the start of training; times: without growth, and with growth up to an estimated maximum"


def format_table(manifest: dict[str, Any]) -> str:
    """Format a manifest as a text table.  The column `initial MiB` is the device memory at the start of training.

    Training times, if there are any, are ranges: from no growth to growth up to the maximum number of Gaussians.
    """
    scene_row = [
        "scene",
        *[f"{manifest['gaussians']:,}"] * 2,
        str(manifest["views"]),
        "",
        "100 %",
        _format_mib(manifest["memory"]),
    ]
    times = [block["seconds"] for block in manifest["blocks"] if "seconds" in block]
    if not times:
        return text_table([HEADINGS, *map(_cells, manifest["blocks"]), scene_row])
    rows = [[*_cells(block), format_minutes(seconds)] for block, seconds in zip(manifest["blocks"], times, strict=True)]
    low, high = (sum(seconds) for seconds in zip(*times, strict=True))
    total_row = [*scene_row, f"{format_minutes((low, high))}, one after another"]
    return f"{text_table([[*HEADINGS, TIME_HEADING], *rows, total_row])}\n{NOTE}"


def format_status_table(status: dict[str, Any]) -> str:
    """Format the result of `blocks_status`, one line per run."""
    done_count = sum(part["state"] == "done" for part in status["parts"])
    lines = [f"{status['in_blocks']}: {status['state']}, {done_count} of {len(status['parts'])} runs are done"]
    for part in status["parts"]:
        first_line = format_status(part).partition("\n")[0] if "run" in part else f"{part['name']}: {part['state']}"
        lines.append(f"{first_line}; {part['message']}" if part.get("message") else first_line)
    return "\n  ".join(map(one_line, lines))


def _cells(block: dict[str, Any]) -> list[str]:
    cameras = sum(view["why"] == "inside" for view in block["views"])
    counts = [f"{block['gaussians']:,}", f"{block['start']:,}", str(len(block["views"])), str(cameras)]
    return [block["name"], *counts, f"{100 * block['pairs']:.0f} %", _format_mib(block["memory"])]


def _format_mib(size: int) -> str:
    return f"{size / 2**20:,.0f}"


# A plan before training, which treats each point of the dataset as a Gaussian.


def plan_blocks(
    scene: Path, blocks: int, pipeline: str = "blocks", device: str | Device | None = None
) -> dict[str, Any]:
    """Partition the scene's points, and return the manifest with estimated times, without writing files.

    Raises ConfigError for an invalid number of blocks, and DataError if the scene has too few points.
    """
    settings = load(pipeline, [f"scene.path={path_setting(photo_folder(scene))}", "init.file=points"]).settings
    with log_level(logging.ERROR):  # `Blocks` reads the scene again and logs its warnings
        original = read_run_scene(settings.scene, settings.scene.folder).original
        points = original.points
    if points is None or not len(points):
        raise DataError(f"{scene}: has no points to partition; `clsplat blocks --plan` trains a coarse model first")
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, "points.ply")
        tables = from_points(points, Init().opacity, settings.model.sh_degree, extent=original.extent)
        Model(**tables, rendering=DEFAULT_RENDERING, sky=None, origin=original.origin).save(model)
        blocks_run = Blocks(scene, Path(folder), BlocksPlan(pipeline, str(model), blocks), device)
        try:
            return blocks_run.plan_data(blocks_run.partition())
        except DataError as error:
            raise DataError(f"{scene}, partitioned by its {pluralize(len(points), 'point')}: {error}") from error
