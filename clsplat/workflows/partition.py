"""The partition of a scene by a coarse model: cells, the views and first Gaussians of each block, and the manifest."""

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, amount, in_shell, one_line
from clsplat.core.files import END_STATES, check_result, write_text
from clsplat.core.reading import read_json
from clsplat.core.schedule import divided, values_of
from clsplat.density.control import Box
from clsplat.density.survey import WEIGHT, Look
from clsplat.gaussians.model import MODEL, Model
from clsplat.opencl.device import Device
from clsplat.photos.photographs import BUDGET_SHARE, Photographs
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline, checked
from clsplat.pipeline.stretching import of_trainings, stretched
from clsplat.pipeline.yaml_file import Document
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs import verify as file_checks
from clsplat.runs import verify as runs_check
from clsplat.runs.state import has_state
from clsplat.runs.status import run_status
from clsplat.runs.verify import look_at
from clsplat.runs.verify import verify as verify_run
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.stages.densify import Densify
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.sweeps.status import is_store, store_status
from clsplat.training.memory import first_tables, plan
from clsplat.training.stage import Stage

# What the folder of a scene in blocks holds: the state of its runs, and whether its files are whole.

RECORD, COARSE, MERGED, MANIFEST = "blocks.json", "coarse", "merged", "partition.json"


def block_name(number: int) -> str:
    """Return the name of the folder of a block, and of its first Gaussians."""
    return f"block_{number:02d}"


def is_in_blocks(folder: Path) -> bool:
    """Whether a folder holds a scene in blocks."""
    return (folder / RECORD).is_file()


def status_of(folder: Path, html: Path | None = None) -> dict[str, Any]:
    """Return the state of what a folder holds: a scene in blocks, a store of cells, or a run.

    html: a page to be written of a store.  Raises DataError; ConfigError where the page is of something else.
    """
    if html is not None and not is_store(folder):
        raise ConfigError(f"--html: {folder} is no store of cells; a run and a matrix have pages in their folders")
    if is_in_blocks(folder):
        return blocks_status(folder)
    if not is_store(folder):
        return run_status(folder)
    found = store_status(folder)
    if html is not None:
        from clsplat.sweeps.status import write_page  # and what fills templates, which a look does not need

        check_result(html, ".html")
        write_page(found, html)
    return found


def check(pipeline: str) -> dict[str, Any]:
    """Check a scene in blocks as `verify_blocks`, and all else as `clsplat.runs.verify`."""
    return verify_blocks(Path(pipeline)) if is_in_blocks(Path(pipeline)) else runs_check.check(pipeline)


def blocks_status(out: Path) -> dict[str, Any]:
    """Return the `state` of a scene in blocks, and `parts`: what `run_status` returns, and the name, of each run.

    The state is that of the merged model; before it is done running, failed, or unfinished.
    Raises DataError where the record is damaged.
    """
    parts = [{"name": name, **_status(out / name)} for name in _parts(out)]
    states = [part["state"] for part in parts]
    going = any(state not in (*END_STATES, "killed", "waiting", "unknown") for state in states)
    state = "done" if states[-1] == "done" else "running" if going else "failed" if "failed" in states else "unfinished"
    return {"in_blocks": str(out), "state": state, "parts": parts}


def verify_blocks(out: Path) -> dict[str, Any]:
    """Return what `verify` returns, of all runs of a scene in blocks and of the files beside them, with a `remedy`."""
    state = blocks_status(out)["state"]
    objects = list(_objects(out, state == "done"))
    return {
        "run": str(out),
        "state": state,
        "whole": all(one["whole"] for one in objects),
        "objects": objects,
        "remedy": f"give its `clsplat blocks … --out {in_shell(out)}` again, which makes again what is lost",
    }


def _parts(out: Path) -> list[str]:
    """The folders of its runs, in the order in which they are trained."""
    record = read_json(out / RECORD)
    if not (isinstance(record, dict) and type(record.get("blocks")) is int):
        raise DataError(f"{out / RECORD}: expected the number of blocks; remove {out}, or put that file back")
    return [*([COARSE] if COARSE in record else []), *map(block_name, range(record["blocks"])), MERGED]


def _status(folder: Path) -> dict[str, Any]:
    try:
        return run_status(folder) if has_state(folder) else {"state": "waiting"}
    except DataError as error:
        return {"state": "unknown", "message": one_line(error)}


def _objects(out: Path, done: bool) -> Iterator[dict[str, Any]]:
    """What is found of each file; those that a scene that is done has must be there."""

    def manifest(path: Path) -> str:
        found = read_json(path)
        if not (isinstance(found, dict) and isinstance(found.get("blocks"), list)):
            raise DataError("expected the blocks, and what they hold")
        return f"of {len(found['blocks'])} blocks"

    parts = _parts(out)
    looks: dict[str, Callable[[Path], str]] = {MANIFEST: manifest}
    looks |= {f"{name}.ply": partial(file_checks.output, None) for name in parts if name != COARSE}
    for name, look in looks.items():
        if done or (out / name).exists():
            yield look_at(out, name, look)
    for part in parts:
        if has_state(out / part):
            yield from ({**one, "file": f"{part}/{one['file']}"} for one in verify_run(out / part)["objects"])
        elif done:
            yield {"file": part, "whole": False, "detail": "is missing"}


# Space cut into cells by the Gaussians of a coarse model: a kd-tree whose leaves hold equal shares of a weight.

Floats = NDArray[np.float64]
CORE = (0.01, 0.99)  # quantiles of the weight between which a cell has its size: a few Gaussians lie far away
DIGITS = 9  # of a cut: more than single precision has


@dataclass(frozen=True)
class Cell:
    """A part of space, and the size of what lies in it."""

    box: Box
    size: Floats  # [3] scene units, between quantiles of its Gaussians

    def grown(self, share: float) -> Box:
        """Return the box with each of its bounds farther out by half of this share of its size."""
        step = 0.5 * share * self.size
        low = [None if one is None else _short(one - by) for one, by in zip(self.box.low, step, strict=True)]
        high = [None if one is None else _short(one + by) for one, by in zip(self.box.high, step, strict=True)]
        return Box(low=low, high=high)


def cells(means: NDArray[np.floating], weights: Floats, count: int) -> list[Cell]:
    """Return `count` cells, each with about the same share of the weights, [N], of Gaussians at `means`, [N, 3].

    A cell of several shares is cut across its longest side.  Raises DataError where so many are not to be had.
    """
    if not len(means):
        raise DataError("the model holds no Gaussians; expected one at least")
    weights = weights if weights.any() else np.ones(len(means))
    return _cut(means.astype(np.float64), weights, Box(), count)


def owners(means: NDArray[np.floating], found: list[Cell]) -> NDArray[np.int64]:
    """Return the number of the cell in which each of the points, [N, 3], lies, [N].

    Raises DataError for points that are not numbers, which lie in none.
    """
    owner = np.full(len(means), -1)
    for number, cell in enumerate(found):
        owner[cell.box.holds(means)] = number
    if (owner < 0).any():
        lost = f"{int((owner < 0).sum()):,} of {amount(len(owner), 'Gaussian')}"
        raise DataError(f"{lost} of the coarse model have places that are not finite; train it again")
    return owner


def quantile(values: Floats, weights: Floats, share: float) -> float:
    """Return the first of the values, [N], up to which, in ascending order, this share of the weights lies."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(total, share * total[-1])), len(order) - 1)]])


def _cut(means: Floats, weights: Floats, box: Box, count: int) -> list[Cell]:
    """The cells of a box, in which these Gaussians lie."""
    bounds = np.array([[quantile(means[:, axis], weights, share) for axis in range(3)] for share in CORE])
    size = bounds[1] - bounds[0]
    if count == 1:
        return [Cell(box, size)]
    axis, first = int(size.argmax()), count // 2
    place = _short(quantile(means[:, axis], weights, first / count))
    below = means[:, axis] < place
    if below.all() or not below.any() or not (weights[below].any() and weights[~below].any()):
        raise DataError(
            f"the model cannot be cut: {amount(len(means), 'Gaussian')} for {count} blocks; give fewer --blocks"
        )
    parts = ((below, "high", first), (~below, "low", count - first))
    return [
        cell
        for chosen, side, shares in parts
        for cell in _cut(means[chosen], weights[chosen], _with_bound(box, side, axis, place), shares)
    ]


def _with_bound(box: Box, side: str, axis: int, place: float) -> Box:
    bounds = list(getattr(box, side))
    bounds[axis] = place
    return box.model_copy(update={side: bounds})


def _short(value: float) -> float:
    """The value with as many digits as files show."""
    return float(f"{value:.{DIGITS}g}")


# Which views a block is trained on: those that stand in its cell, and those of which it makes a share.

Why = Literal["place", "sight", "best"]


@dataclass(frozen=True)
class Membership:
    """Which of V views belong to which of B blocks."""

    share: Floats  # [V, B] of a view's pixels that the Gaussians of a cell make, by their blending weight
    inside: NDArray[np.bool_]  # [V, B] whether its camera stands in the cell
    sight: float  # share above which a view belongs to a block

    @property
    def of_views(self) -> NDArray[np.bool_]:
        """The blocks of each view, [V, B]: one at least, that of which it shows most."""
        best = np.arange(self.share.shape[1]) == self.share.argmax(axis=1)[:, None]
        return np.asarray(best | self.inside | (self.share > self.sight))

    @property
    def chosen(self) -> NDArray[np.bool_]:
        """The same, with the view that shows most of it for a block that has none."""
        found = self.of_views
        for block in np.flatnonzero(~found.any(axis=0)):
            found[self.share[:, block].argmax(), block] = True
        return found

    def why(self, view: int, block: int) -> Why:
        """Return the reason for which a view belongs to a block."""
        if self.inside[view, block]:
            return "place"
        return "sight" if self.share[view, block] > self.sight else "best"


def pairs_of(looks: Iterable[Look], count: int, tile: int) -> Floats:
    """Return the (tile, Gaussian) pairs of N = `count` Gaussians over views, [N]: what their training costs.

    It is an estimate by the radius of a splat, which an image's sides bound.
    """
    total = np.zeros(count)
    for look in looks:
        camera, radius = look.photograph.camera, look.radius().astype(np.float64)
        sides = [np.minimum(2 * radius / tile + 1, -(-side // tile)) for side in (camera.width, camera.height)]
        total += np.where(radius > 0, sides[0] * sides[1], 0)
    return total


def share_of(look: Look, owner: NDArray[np.int64], blocks: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the share of a view's pixels that the Gaussians of each block make, [B], and which are seen, [N].

    owner: the block of each Gaussian, [N].  Pixels that a mask leaves out do not count.
    """
    weight = look.sum(WEIGHT)
    pixels = max(int(look.counted().sum()), 1)
    return np.bincount(owner, weight.astype(np.float64), blocks) / pixels, weight > 0


LOG = logging.getLogger("clsplat")
Bits = NDArray[np.bool_]
NEAR_CELL, GROWTH = 0.2, 0.2  # shares of a cell's size by which it is grown: for cameras, and for growth of Gaussians
SIGHT = 0.05  # share of a view's pixels


@dataclass(frozen=True)
class Block:
    """One part of the scene."""

    number: int
    cell: Cell
    gaussians: int  # of the coarse model that it owns
    pairs: float  # share of those of the whole
    start: Bits  # [N] the Gaussians that it starts from: its own, and those that its views see, or none
    views: list[dict[str, Any]]  # name, why, share of pixels
    memory: int  # bytes on the device at the beginning

    @property
    def name(self) -> str:
        """The name of its folder."""
        return block_name(self.number)

    def data(self) -> dict[str, Any]:
        """Return what the manifest says of it."""
        grown = {"cell": self.cell.box, "growth": self.cell.grown(GROWTH)}
        return {
            "name": self.name,
            **{name: box.model_dump() for name, box in grown.items()},
            "gaussians": self.gaussians,
            "start": int(self.start.sum()),
            "pairs": self.pairs,
            "memory": self.memory,
            "views": self.views,
        }


@dataclass(frozen=True)
class Partition:
    """All blocks, and what the whole scene is."""

    blocks: list[Block]
    model: Model  # the coarse one
    coarse: str  # SHA-256 of its file
    extent: float  # scene units
    memory: int  # bytes on the device of the coarse model with all views
    views: int

    def data(self) -> dict[str, Any]:
        """Return the manifest."""
        whole = {"gaussians": len(self.model), "views": self.views, "extent": self.extent, "memory": self.memory}
        return {"coarse": self.coarse, **whole, "blocks": [block.data() for block in self.blocks]}

    def write(self, folder: Path) -> None:
        """Write the manifest and, beside it, the Gaussians from which each block starts."""
        for block in self.blocks:
            self.model[block.start].save(folder / f"{block.name}.ply")
        write_text(folder / MANIFEST, json.dumps(self.data(), indent=1) + "\n")


class Partitioner:
    """A coarse model at the training views of a scene."""

    def __init__(self, model: Model, scene: Scene, device: Device, photographs: Photographs) -> None:
        self.model, self.device, self.photographs = model, device, photographs
        self.views: Sequence[View] = [view for view in scene.split("train") if view.downscale == scene.downscales[0]]
        self.extent = scene.extent
        self._rasterizer, self._uploaded = Rasterizer(device), model.upload(device)

    def partition(self, count: int, coarse: str, sight: float = SIGHT) -> Partition:
        """Cut the model into `count` blocks.  coarse: SHA-256 of its file; sight: share of pixels of Membership.

        Each view is rendered twice.  Raises DataError where so many blocks are not to be had.
        """
        means, total = self.model.means, len(self.model)
        pairs = pairs_of(self._looks(self.views), total, int(self.device.tuning["TILE"]))
        found = cells(means, pairs, count)
        owner = owners(means, found)
        members, seen = self._members(owner, found, sight)
        blocks = [
            Block(
                number,
                cell,
                int((owner == number).sum()),
                float(pairs[owner == number].sum() / (pairs.sum() or 1)),
                start := seen[number] | (owner == number),
                self._listed(members, number),
                self._memory(int(start.sum()), np.flatnonzero(members.chosen[:, number]).tolist()),
            )
            for number, cell in enumerate(found)
        ]
        memory = self._memory(total, range(len(self.views)))
        return Partition(blocks, self.model, coarse, self.extent, memory, len(self.views))

    def _members(self, owner: NDArray[np.int64], found: list[Cell], sight: float) -> tuple[Membership, Bits]:
        """The views of each block, and the Gaussians that these see, or no view sees, [B, N]."""
        places = np.stack([view.position for view in self.views])
        inside = np.stack([cell.grown(NEAR_CELL).holds(places) for cell in found], axis=1)
        shares, seen = np.zeros(inside.shape), np.zeros((len(found), len(owner)), bool)
        for view, look in enumerate(self._looks(self.views)):
            shares[view], visible = share_of(look, owner, len(found))
            seen[Membership(shares[[view]], inside[[view]], sight).of_views[0]] |= visible
        members = Membership(shares, inside, sight)
        for view, block in np.argwhere(members.chosen & ~members.of_views):
            (look,) = self._looks([self.views[view]])
            seen[block] |= share_of(look, owner, len(found))[1]
        return members, seen | ~seen.any(axis=0)  # what is hidden from all views may come to light in any

    def _looks(self, views: Sequence[View]) -> Iterator[Look]:
        photographs = (self.photographs.get(view) for view in views)
        return Look.each(self._rasterizer, self._uploaded, photographs, self.photographs.background)

    def _listed(self, members: Membership, block: int) -> list[dict[str, Any]]:
        """The views of a block, in the order of the scene, with reasons."""
        return [
            {
                "name": self.views[view].name,
                "why": members.why(view, block),
                "share": round(float(members.share[view, block]), 4),
            }
            for view in np.flatnonzero(members.chosen[:, block]).tolist()
        ]

    def _memory(self, gaussians: int, views: Sequence[int]) -> int:
        """Bytes on the device of a training that begins with so many Gaussians and these views."""
        cameras = [self.views[view].camera for view in views]
        sizes = [4 * camera.width * camera.height for camera in cameras]
        held = min(int(BUDGET_SHARE * self.device.info.memory), sum(sizes))
        motion = self.model.motion
        tables = first_tables(self.model.sh_degree, 0 if motion is None else motion.shape[1])
        return plan(self.device.info, tables, held, max(sizes) // 4).needed(gaussians)


# The pipeline of a block, and that of the merged model: parts of one file, with other settings.


def require_divisible(pipeline: Pipeline) -> None:
    """Raise ConfigError for a pipeline whose blocks would not fit together, or that does not start from a model."""
    settings, first = pipeline.settings, pipeline.stages[0]
    trainings = [stage for stage in pipeline.stages if isinstance(stage, Optimize)]
    faults = {
        "prepare": (settings.prepare, "run it first, and give the folder of that run as --scene"),
        "choices": (settings.choices, "each block would choose by its own photographs; write the settings out"),
        "model.time": (settings.model.time, "a cell holds Gaussians at their own time, not at all times; leave it out"),
        "model.background": (settings.model.background, "each block would learn its own sky; leave it out"),
        "scene.levels": (settings.scene.levels > 1, "a block has views of one size; set it to 1"),
        "scene.train": (settings.scene.train, "blocks choose their views; leave it out"),
        "scene.validation": (settings.scene.validation != 0, "a block has no views to choose by; set it to 0"),
        "scene.extent": (settings.scene.extent, "blocks have that of the whole scene; leave it out"),
        "optimize.modules": (
            any("blocks" in one.conflicts for stage in trainings for one in stage.modules),
            "some would differ from block to block; leave them out",
        ),
        "densify.budget": (
            any(getattr(one.budget, "gaussians", None) for one in _densities(pipeline.stages)),
            "it counts the Gaussians of the whole; give densify.max_gaussians, which blocks share",
        ),
        "densify.per_pixel": (
            any(one.per_pixel for one in _densities(pipeline.stages)),
            "photographs of blocks differ; give densify.max_gaussians, which blocks share",
        ),
        "densify.inside": (any(one.inside for one in _densities(pipeline.stages)), "blocks set it; leave it out"),
    }
    for key, (is_set, remedy) in faults.items():
        if is_set:
            raise ConfigError(f"{pipeline.path}: {key} is not for blocks: {remedy}")
    if not (isinstance(first, Init) and first.source == "model" and trainings):
        raise ConfigError(f"{pipeline.path}: expected `init: {{source: model}}` first, and a stage 'optimize'")


def of_block(pipeline: Pipeline, block: Block, start: Path, extent: float, share: Fraction = Fraction(1)) -> Pipeline:
    """Return the training of a block from its first Gaussians, up to its model, cropped to its cell.

    extent: of the whole scene; share: of the pipeline's steps that are trained, with the rates of `_shared`.
    """
    data, last, cell = pipeline.resolved(), _last(pipeline), block.cell.box.model_dump()
    stages = [_growing(stage, block) for stage in _starting(data["stages"][:last], start)]
    names = [view["name"] for view in block.views]
    scene = {**data["scene"], "holdout": 0, "train": {"names": names}, "extent": extent}
    changed = {**data, "name": f"{pipeline.settings.name}_{block.name}", "scene": scene}
    changed["stages"] = [*stages, {"crop": {"inside": cell}}, {"export": {"file": MODEL}}]
    found = checked(pipeline.path, Document(changed))
    return found if share == 1 else replace(found, settings=_shared(found.settings, share))


def of_merged(pipeline: Pipeline, file: Path) -> Pipeline:
    """Return what comes after the training, for the merged model: it is measured, exported, shown."""
    data, last = pipeline.resolved(), _last(pipeline)
    stages = [*_starting(data["stages"][:1], file), *(data["stages"][last:] or [{"export": {"file": MODEL}}])]
    return checked(pipeline.path, Document({**data, "stages": stages}))


def of_coarse(coarse: Pipeline, pipeline: Pipeline) -> Pipeline:
    """Return the pipeline of the coarse model with the photographs, filters and seed of that of the blocks."""
    data = pipeline.resolved()
    same = {key: data[key] for key in ("scene", "model", "rasterizer", "seed") if key in data}
    return checked(coarse.path, Document({**coarse.resolved(), **same}))


def without_start(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline without the file of its first model."""
    first, *others = pipeline.stages
    stages = [first.model_copy(update={"file": None}), *others]
    return replace(pipeline, settings=pipeline.settings.model_copy(update={"stages": stages}))


def _shared(settings: PipelineFile, share: Fraction) -> PipelineFile:
    """Settings with a share of the steps, and rates that are larger as its root is smaller.

    Adam divides by the root of the mean square of gradients over steps.  Where a share p of the views show a
    Gaussian, it has gradients in that share of the steps, and each moves it as 1 / √p.  In a block p is larger by
    1 / share.
    """

    def changed(training: Optimize) -> Optimize:
        if training.update != "all":  # rows that are not seen keep their moments
            return training
        return training.model_copy(update={"rates": training.rates.times(float(share) ** -0.5)})

    return of_trainings(stretched(settings, share), Optimize, changed)


def _last(pipeline: Pipeline) -> int:
    """The number of stages up to the last that changes the model."""
    return max(i for i, stage in enumerate(pipeline.stages, 1) if stage.edits or isinstance(stage, Optimize))


def _densities(stages: Iterable[Stage]) -> Iterator[Densify]:
    for stage in stages:
        yield from (one for one in (stage, *getattr(stage, "during", ())) if isinstance(one, Densify))


def _starting(stages: list[Any], file: Path) -> list[Any]:
    """Stages of a resolved file whose first, `init`, reads this model."""
    first, *others = stages
    return [{"init": {**first["init"], "file": str(file.resolve())}}, *others]


def _growing(stage: dict[str, Any], block: Block) -> dict[str, Any]:
    """A stage of a resolved file that lets Gaussians grow in a block alone, up to its part of their number."""
    ((name, fields),) = stage.items()
    if name == "densify":
        limited = _limited(Densify.model_validate(fields), block).model_dump(mode="json")
        return {name: {key: limited[key] for key in fields}}
    if "during" in fields:
        return {name: {**fields, "during": [_growing(inner, block) for inner in fields["during"]]}}
    return stage


def _limited(densify: Densify, block: Block) -> Densify:
    """The stage in a block: Gaussians grow in its cell, up to its share, by pairs, of the number of the whole."""
    changed: dict[str, Any] = {"inside": block.cell.grown(GROWTH)}
    if densify.max_gaussians is not None:
        changed["max_gaussians"] = divided(densify.max_gaussians, 1 / block.pairs)
        if min(values_of(changed["max_gaussians"])) < 1:
            told = f"densify.max_gaussians: {block.name} has none of so few Gaussians"
            raise ConfigError(f"{told}; expected more of them, or fewer --blocks")
    return densify.model_copy(update=changed)
