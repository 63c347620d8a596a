"""A scene trained in blocks by one command: a coarse model, its partition, runs of blocks, the merged model."""

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

from clsplat.conformance.quick import open_correct
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
from clsplat.gaussians.model import NUMBERS, Model, model_path, raw_model
from clsplat.gaussians.model import load as load_model
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photographs
from clsplat.pipeline.execution import Execution
from clsplat.pipeline.input_files import with_content_hashes
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.matrix import Cell as MatrixCell
from clsplat.runs.estimate import MAX_PER_PIXEL, max_gaussians, minutes_text, step_seconds
from clsplat.runs.failures import Failures
from clsplat.runs.model_file import as_setting, photographs_of, require_model
from clsplat.runs.opening import read_run_scene
from clsplat.runs.status import status_text
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
from clsplat.workflows.partition import SIGHT, Block, Partition, Partitioner

# How long the training of each block takes, roughly.


def block_seconds(
    blocks: Sequence[Block], pipelines: Mapping[str, Pipeline], size: tuple[int, int], units: int
) -> dict[str, list[float]]:
    """Return the time of the training of each block, s: at least, with the Gaussians of its start, and at most.

    pipelines: by the names of blocks; size: of a photograph, px; units: compute units of the device.
    """
    found = {}
    for block in blocks:
        ends = (step_seconds(units, size, count) for count in _counts(block, pipelines[block.name], size))
        steps = sum(training.steps for training in _trainings(pipelines[block.name]))
        found[block.name] = [steps * each[end] for end, each in enumerate(ends)]
    return found


def _counts(block: Block, pipeline: Pipeline, size: tuple[int, int]) -> tuple[int, int]:
    """The Gaussians that a block starts from, and the most that it may come to; without a setting that is a guess."""
    first, pixels = int(block.start.sum()), size[0] * size[1]
    own = [max_gaussians(training, pixels) or block.pairs * MAX_PER_PIXEL * pixels for training in _trainings(pipeline)]
    return first, max(first, int(max(own)) + first - block.gaussians)


def _trainings(pipeline: Pipeline) -> list[Optimize]:
    return [stage for stage in pipeline.stages if isinstance(stage, Optimize)]


LOG = logging.getLogger("clsplat")
MAX_BLOCKS = 99  # blocks
Steps = Literal["each", "shared"]


@dataclass(frozen=True)
class BlocksPlan:
    """What is asked for."""

    pipeline: str = "blocks"
    coarse: str = "blocks_coarse"  # a pipeline, or a model
    blocks: int = 4
    min_coverage: float = SIGHT  # fraction of a view's pixels above which it belongs to a block
    steps: Steps = "each"  # of a block: those of the pipeline, or its share of them by its views
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
    """The work in a folder."""

    def __init__(
        self, scene: Path, out: Path, plan: BlocksPlan, device: str | Device | None, execution: Execution | None = None
    ) -> None:
        """execution: where blocks are trained; without it one after the other in this process."""
        if execution is not None and not execution.has_store:
            raise ConfigError("--on: blocks are trained as cells of a store; expected the key store, or another engine")
        self.out, self.plan, self.execution = out, plan, execution
        self._name = device if isinstance(device, str) else None
        where = [f"scene.path={as_setting(photographs_of(scene))}"]
        self.pipeline = load(plan.pipeline, [*where, "init.file=coarse", *plan.overrides])
        require_divisible(self.pipeline)
        self.given = _given(plan.coarse)
        self.coarse = None if self.given else coarse_pipeline(load(plan.coarse, plan.coarse_overrides), self.pipeline)
        if self.given and plan.coarse_overrides:
            raise ConfigError("--set-coarse is for a coarse model that is trained; leave it out, or give a pipeline")
        rasterizer = self.pipeline.settings.rasterizer
        self.device = open_correct(device, rasterizer.schedule, rasterizer.sort)
        self.scene = read_run_scene(self.pipeline.settings.scene, self.pipeline.settings.scene.folder)
        if len(self.scene.original.downscales) > 1:
            raise DataError(
                f"{self.scene.original.path}: has each photograph in several sizes; expected one for blocks"
            )

    def question(self) -> dict[str, Any]:
        """Return what the folder belongs to."""
        pipelines = {"pipeline": without_start(self.pipeline), **({"coarse": self.coarse} if self.coarse else {})}
        texts = {name: json.dumps(with_content_hashes(one), sort_keys=True) for name, one in pipelines.items()}
        digests = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
        asked = {"blocks": self.plan.blocks, "min_coverage": self.plan.min_coverage, "steps": self.plan.steps}
        model = {"model": sha256(self.given)} if self.given else {}
        return {**asked, "photographs": self.scene.identity.digest, **model, **digests}

    def partition(self) -> Partition:
        """Train the coarse model where that is not done, and cut it; write the manifest."""
        file = self.given
        if file is None and self.coarse is not None:
            LOG.info("the coarse model")
            file = raw_model(train_in_folder(self.coarse, self.out / COARSE, self.device))
        assert file is not None
        model = load_model(file).with_origin(self.scene.scene.origin)
        photographs = Photographs(self.device, self.scene.background, budget=0)  # each is used once in a pass
        work = Partitioner(model, self.scene.scene, self.device, photographs)
        found = work.partition(self.plan.blocks, sha256(file), self.plan.min_coverage)
        found.write(self.out)
        return found

    def plan_data(self, partition: Partition) -> dict[str, Any]:
        """Return the manifest with the time that the training of each block takes, roughly."""
        pipelines = {block.name: self.block_pipeline(block, partition) for block in partition.blocks}
        sizes = sorted((view.camera.width, view.camera.height) for view in self.scene.scene.split("train"))
        units, size = self.device.info.units, sizes[len(sizes) // 2]
        found, times = partition.data(), block_seconds(partition.blocks, pipelines, size, units)
        return {**found, "blocks": [{**block, "seconds": times[block["name"]]} for block in found["blocks"]]}

    def block_pipeline(self, block: Block, partition: Partition) -> Pipeline:
        """Return the pipeline of a block."""
        share = Fraction(len(block.views), partition.views) if self.plan.steps == "shared" else Fraction(1)
        return block_pipeline(self.pipeline, block, self.out / f"{block.name}.ply", partition.extent, share)

    def train(self, partition: Partition) -> list[tuple[Block, Path]]:
        """Train the blocks that are not done; return them with their models, in order.

        One in whose cell no Gaussian is left has no model.  One that fails does not stop the others; at the end an
        error names the first, and has its exit code.
        """
        files, failures = [], Failures("blocks")
        pipelines = {block.name: self.block_pipeline(block, partition) for block in partition.blocks}
        if self.execution:
            self._train_as_cells(self.execution, pipelines, failures)
        for block in partition.blocks:
            if block.name in failures:
                continue
            LOG.info("%s of %d: %s", block.name, len(pipelines), pluralize(len(block.views), "view"))
            with failures.kept(block.name):
                try:
                    model = train_in_folder(pipelines[block.name], self.out / block.name, self.device)
                    files.append((block, raw_model(model)))
                except EmptyRegionError:
                    LOG.warning("%s: no Gaussian is left in its cell; the model goes on without it", block.name)
        if failures:
            remedy = "when that is mended, the same command trains them, and leaves the others alone"
            kept = shell_quote(self.out / COARSE)
            other = f"other settings need another --out; --coarse {kept} keeps the coarse model there"
            whole = failures.whole(len(pipelines))
            error = ClsplatError(f"{whole}; {remedy if self.given else f'{remedy}; {other}'}")
            error.exit_code = whole.exit_code
            raise error
        if not files:
            raise EmptyRegionError("no Gaussian is left in any block; expected another pipeline, with another --out")
        return files

    def _train_as_cells(self, execution: Execution, pipelines: dict[str, Pipeline], failures: Failures) -> None:
        """Train the blocks that are not done as cells of a store, and put their runs into the folders of blocks."""
        cells = [
            MatrixCell(name, pipeline)
            for name, pipeline in pipelines.items()
            if not is_trained(pipeline, self.out / name)
        ]
        if cells:
            name, store = f"{self.pipeline.settings.name}-{self.out.name}", Store(execution.store_folder(self.out))
            Batch(name, str(self.out.resolve()), cells, self.out, store, failures).run(execution, self._name)

    def merge(self, parts: list[tuple[Block, Path]]) -> Path:
        """Write the models of all blocks as one, in the order of their numbers; return its file."""
        file = self.out / f"{MERGED}.ply"

        def check(number: int, means: NDArray[np.float32]) -> None:
            block, path = parts[number]
            if not block.box.shifted(block.origin).holds(means).all():  # as the stage crop does
                raise DataError(f"{path}: holds Gaussians outside its cell; remove its folder, and train it again")

        count = join_plys(file, [path for _, path in parts], check)
        LOG.info("%s of %s merged", pluralize(count, "Gaussian"), pluralize(len(parts), "block"))
        return file

    def finish(self, file: Path) -> Path:
        """Run what follows a training on the merged model; return its folder."""
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
    """Train a scene in blocks, in a folder; return the manifest, and beside it `run`, the folder of the merged model.

    What an earlier call has finished is left alone, and what it has begun goes on.  only_plan: stop after the
    partition; execution: where blocks are trained as cells of a store.  Raises ClsplatError; one of a block names it.
    """
    work = Blocks(scene, out, plan or BlocksPlan(), device, execution)
    with claim_folder(out, work.question(), RECORD, "a scene in blocks", "another --out"):
        partition = work.partition()
        if only_plan:
            return {**work.plan_data(partition), "run": None}
        run = work.finish(work.merge(work.train(partition)))
    return {**partition.data(), "run": str(run), "metrics": read_json(run / METRICS)}


def _given(coarse: str) -> Path | None:
    """The file of a coarse model that is given; None for the name or the file of a pipeline.  Raises DataError."""
    path = Path(coarse)
    if path.is_dir() or (path.is_file() and detect(path)):
        require_model(path)
        return raw_model(model_path(path))
    return None


# A partition, and the state of its runs, as tables in text.

HEADINGS = ("block", "owns", "starts from", "views", "of these by place", "pairs", "MiB at first")
GUESS = "memory and time are those of the beginning, up to the time with the most Gaussians; how many grow is a guess"
TIME = "time, by growth"


def table(found: dict[str, Any]) -> str:
    """Return a manifest as lines of text; MiB are those on the device at the beginning of a training.

    The time of a block goes from that of no growth to that of the most Gaussians.
    """
    whole = ["whole", *[f"{found['gaussians']:,}"] * 2, str(found["views"]), "", "100 %", _mib(found["memory"])]
    times = [one["seconds"] for one in found["blocks"] if "seconds" in one]
    if not times:
        return text_table([HEADINGS, *map(_cells, found["blocks"]), whole])
    rows = [[*_cells(block), minutes_text(seconds)] for block, seconds in zip(found["blocks"], times, strict=True)]
    low, high = (sum(ends) for ends in zip(*times, strict=True))
    total = [*whole, f"{minutes_text((low, high))}, one after the other"]
    return f"{text_table([[*HEADINGS, TIME], *rows, total])}\n{GUESS}"


def status_table(found: dict[str, Any]) -> str:
    """Return what `blocks_status` found as lines of text, a run a line."""
    done = sum(part["state"] == "done" for part in found["parts"])
    lines = [f"{found['in_blocks']}: {found['state']}, {done} of {len(found['parts'])} runs are done"]
    for part in found["parts"]:
        first = status_text(part).partition("\n")[0] if "run" in part else f"{part['name']}: {part['state']}"
        lines.append(f"{first}; {part['message']}" if part.get("message") else first)
    return "\n  ".join(map(one_line, lines))


def _cells(block: dict[str, Any]) -> list[str]:
    by_place = sum(view["why"] == "place" for view in block["views"])
    counts = [f"{block['gaussians']:,}", f"{block['start']:,}", str(len(block["views"])), str(by_place)]
    return [block["name"], *counts, f"{100 * block['pairs']:.0f} %", _mib(block["memory"])]


def _mib(size: int) -> str:
    return f"{size / 2**20:,.0f}"


# The plan of a scene in blocks before anything is trained: by the dataset's points, each a Gaussian.


def plan_blocks(
    scene: Path, blocks: int, pipeline: str = "blocks", device: str | Device | None = None
) -> dict[str, Any]:
    """Return the manifest of a partition by the scene's points, with the time of each block; nothing is kept.

    Raises ConfigError for a number of blocks out of bounds, DataError where the scene has no points, or too few.
    """
    settings = load(pipeline, [f"scene.path={as_setting(photographs_of(scene))}", "init.file=points"]).settings
    with log_level(logging.ERROR):  # it is read again, and told then
        original = read_run_scene(settings.scene, settings.scene.folder).original
        points = original.points
    if points is None or not len(points):
        raise DataError(f"{scene}: has no points to cut by; `clsplat blocks --plan` trains a coarse model first")
    with tempfile.TemporaryDirectory() as made:
        model = Path(made, "points.ply")
        tables = from_points(points, Init().opacity, settings.model.sh_degree)
        Model(**tables, rendering=NUMBERS, sky=None, origin=original.origin).save(model)
        work = Blocks(scene, Path(made), BlocksPlan(pipeline, str(model), blocks), device)
        try:
            return work.plan_data(work.partition())
        except DataError as error:
            raise DataError(f"{scene}, by its {pluralize(len(points), 'point')}: {error}") from error
