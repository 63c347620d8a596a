"""A scene trained in blocks by one command: a coarse model, its partition, runs of blocks, the merged model."""

import hashlib
import json
import logging
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from clsplat.blocks.folder import COARSE, MERGED, RECORD
from clsplat.blocks.partition import SIGHT, Block, Partition, Partitioner
from clsplat.blocks.pipelines import of_block, of_coarse, of_merged, require_divisible, without_start
from clsplat.blocks.seams import write_seams
from clsplat.blocks.times import block_seconds
from clsplat.cluster.batch import Batch
from clsplat.cluster.store import Store
from clsplat.conformance.quick import open_correct
from clsplat.errors import ClsplatError, ConfigError, DataError, NoneInsideError, amount, in_shell, quoted
from clsplat.formats.ply_joining import join_plys
from clsplat.formats.table import detect
from clsplat.gaussians.model import load as load_model
from clsplat.gaussians.run_model import as_trained, model_at
from clsplat.names import METRICS
from clsplat.opencl.device import Device
from clsplat.pipeline.execution import Execution
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.matrix import Cell
from clsplat.pipeline.places import placeless
from clsplat.reading import read_json, sha256
from clsplat.runs.failures import Failures
from clsplat.runs.scenes import read_run_scene
from clsplat.runs.source import as_setting, photographs_of, require_model
from clsplat.tuning.folder import claimed
from clsplat.tuning.tuning import is_trained, trained
from clsplat.views.photographs import Photographs

LOG = logging.getLogger("clsplat")
MOST = 99  # blocks
Steps = Literal["each", "shared"]


@dataclass(frozen=True)
class Plan:
    """What is asked for."""

    pipeline: str = "blocks"
    coarse: str = "blocks_coarse"  # a pipeline, or a model
    blocks: int = 4
    sight: float = SIGHT  # share of a view's pixels from which on it belongs to a block
    steps: Steps = "each"  # of a block: those of the pipeline, or its share of them by its views
    overrides: list[str] = field(default_factory=list)
    coarse_overrides: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not 1 <= self.blocks <= MOST:
            raise ConfigError(f"--blocks {self.blocks}: expected 1 to {MOST}")
        if not 0 <= self.sight < 1:
            raise ConfigError(f"--sight {self.sight:g}: expected a share of a view's pixels from 0 to below 1")
        if self.steps not in get_args(Steps):
            raise ConfigError(f"--steps {quoted(self.steps)}: expected one of {', '.join(get_args(Steps))}")


class Blocks:
    """The work in a folder."""

    def __init__(
        self, scene: Path, out: Path, plan: Plan, device: str | Device | None, execution: Execution | None = None
    ) -> None:
        """execution: where blocks are trained; without it one after the other in this process."""
        if execution is not None and execution.keeps is None:
            raise ConfigError("--on: blocks are trained as cells of a store; expected the key store, or another engine")
        self.out, self.plan, self.execution = out, plan, execution
        self._name = device if isinstance(device, str) else None
        where = [f"scene.path={as_setting(photographs_of(scene))}"]
        self.pipeline = load(plan.pipeline, [*where, "init.file=coarse", *plan.overrides])
        require_divisible(self.pipeline)
        self.given = _given(plan.coarse)
        self.coarse = None if self.given else of_coarse(load(plan.coarse, plan.coarse_overrides), self.pipeline)
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
        texts = {name: json.dumps(placeless(one), sort_keys=True) for name, one in pipelines.items()}
        digests = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
        asked = {"blocks": self.plan.blocks, "sight": self.plan.sight, "steps": self.plan.steps}
        model = {"model": sha256(self.given)} if self.given else {}
        return {**asked, "photographs": self.scene.identity.digest, **model, **digests}

    def partition(self) -> Partition:
        """Train the coarse model where that is not done, and cut it; write the manifest."""
        file = self.given
        if file is None and self.coarse is not None:
            LOG.info("the coarse model")
            file = as_trained(trained(self.coarse, self.out / COARSE, self.device))
        assert file is not None
        photographs = Photographs(self.device, self.scene.background, budget=0)  # each is used once in a pass
        work = Partitioner(load_model(file), self.scene.scene, self.device, photographs)
        found = work.partition(self.plan.blocks, sha256(file), self.plan.sight)
        found.write(self.out)
        return found

    def plan_of(self, partition: Partition) -> dict[str, Any]:
        """Return the manifest with the time that the training of each block takes, roughly."""
        pipelines = {block.name: self.of_block(block, partition) for block in partition.blocks}
        sizes = sorted((view.camera.width, view.camera.height) for view in self.scene.scene.split("train"))
        units, size = self.device.info.units, sizes[len(sizes) // 2]
        found, times = partition.data(), block_seconds(partition.blocks, pipelines, size, units)
        return {**found, "blocks": [{**block, "seconds": times[block["name"]]} for block in found["blocks"]]}

    def of_block(self, block: Block, partition: Partition) -> Pipeline:
        """Return the pipeline of a block."""
        share = Fraction(len(block.views), partition.views) if self.plan.steps == "shared" else Fraction(1)
        return of_block(self.pipeline, block, self.out / f"{block.name}.ply", partition.extent, share)

    def train(self, partition: Partition) -> list[tuple[Block, Path]]:
        """Train the blocks that are not done; return them with their models, in order.

        One in whose cell no Gaussian is left has no model.  One that fails does not stop the others; at the end an
        error names the first, and has its exit code.
        """
        files, failures = [], Failures("blocks")
        pipelines = {block.name: self.of_block(block, partition) for block in partition.blocks}
        if self.execution:
            self._train_as_cells(self.execution, pipelines, failures)
        for block in partition.blocks:
            if block.name in failures:
                continue
            LOG.info("%s of %d: %s", block.name, len(pipelines), amount(len(block.views), "view"))
            with failures.kept(block.name):
                try:
                    model = trained(pipelines[block.name], self.out / block.name, self.device)
                    files.append((block, as_trained(model)))
                except NoneInsideError:
                    LOG.warning("%s: no Gaussian is left in its cell; the model goes on without it", block.name)
        if failures:
            remedy = "when that is mended, the same command trains them, and leaves the others alone"
            kept = in_shell(self.out / COARSE)
            other = f"other settings need another --out; --coarse {kept} keeps the coarse model there"
            whole = failures.whole(len(pipelines))
            error = ClsplatError(f"{whole}; {remedy if self.given else f'{remedy}; {other}'}")
            error.exit_code = whole.exit_code
            raise error
        if not files:
            raise NoneInsideError("no Gaussian is left in any block; expected another pipeline, with another --out")
        return files

    def _train_as_cells(self, execution: Execution, pipelines: dict[str, Pipeline], failures: Failures) -> None:
        """Train the blocks that are not done as cells of a store, and put their runs into the folders of blocks."""
        cells = [
            Cell(name, pipeline) for name, pipeline in pipelines.items() if not is_trained(pipeline, self.out / name)
        ]
        if cells:
            name, store = f"{self.pipeline.settings.name}-{self.out.name}", Store(execution.keeps or Path())
            Batch(name, str(self.out.resolve()), cells, self.out, store, failures).run(execution, self._name)

    def merge(self, parts: list[tuple[Block, Path]]) -> Path:
        """Write the models of all blocks as one, in the order of their numbers; return its file."""
        file = self.out / f"{MERGED}.ply"

        def check(number: int, means: NDArray[np.float32]) -> None:
            block, path = parts[number]
            if not block.cell.box.holds(means).all():
                raise DataError(f"{path}: holds Gaussians outside its cell; remove its folder, and train it again")

        count = join_plys(file, [path for _, path in parts], check)
        LOG.info("%s of %s merged", amount(count, "Gaussian"), amount(len(parts), "block"))
        return file

    def finish(self, file: Path, partition: Partition) -> Path:
        """Run what follows a training on the merged model, and write where borders lie in it; return its folder."""
        run = self.out / MERGED
        trained(of_merged(self.pipeline, file), run, self.device)
        write_seams([block.cell for block in partition.blocks], load_model(file), self.scene.scene, self.device, run)
        return run


def train_in_blocks(
    scene: Path,
    out: Path,
    plan: Plan | None = None,
    device: str | Device | None = None,
    *,
    only_plan: bool = False,
    execution: Execution | None = None,
) -> dict[str, Any]:
    """Train a scene in blocks, in a folder; return the manifest, and beside it `run`, the folder of the merged model.

    What an earlier call has finished is left alone, and what it has begun goes on.  only_plan: stop after the
    partition; execution: where blocks are trained as cells of a store.  Raises ClsplatError; one of a block names it.
    """
    work = Blocks(scene, out, plan or Plan(), device, execution)
    with claimed(out, work.question(), RECORD, "a scene in blocks", "another --out"):
        partition = work.partition()
        if only_plan:
            return {**work.plan_of(partition), "run": None}
        run = work.finish(work.merge(work.train(partition)), partition)
    return {**partition.data(), "run": str(run), "metrics": read_json(run / METRICS)}


def _given(coarse: str) -> Path | None:
    """The file of a coarse model that is given; None for the name or the file of a pipeline.  Raises DataError."""
    path = Path(coarse)
    if path.is_dir() or (path.is_file() and detect(path)):
        require_model(path)
        return as_trained(model_at(path))
    return None
