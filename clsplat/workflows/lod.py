"""Levels of detail of a model: each merged from the one before, trained where photographs are there, and written."""

import logging
import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from clsplat.core.errors import ConfigError, DataError, pluralize
from clsplat.core.files import new_folder, require_free
from clsplat.core.reading import sha256
from clsplat.core.text_table import text_table
from clsplat.density.mixture import Floats, Mixtures, Rows, log_scales_of, mass_of, merge, surface
from clsplat.formats.splats import not_finite, require_in_range, require_static, unit
from clsplat.formats.streamed_sog import LOD_META, write_lod
from clsplat.formats.table import model_bytes, model_file
from clsplat.gaussians.model import Model, load
from clsplat.gaussians.sky import sky_path, write_sky_file
from clsplat.runs.model_file import ModelFile, photographs_of, run_of
from clsplat.scene.detect import read_scene
from clsplat.workflows.finetune import Measurer, Tuning, claim_folder, require_steps

# The training of levels: what is asked for, and run folders beside the folder of the levels.

MAX_LEVELS = 12  # levels; halves of a million Gaussians are 500 then
STEPS = 500
STAGES = ("init", "optimize", "take_average")  # of the recipe
RECORD = "lod.json"


@dataclass(frozen=True)
class LodPlan:
    """What is asked for."""

    levels: int = 4
    keep: float = 0.5  # share of the Gaussians of the level before
    steps: int | None = None  # of training each level; 0: none; None: STEPS where there are photographs
    downscale: float | None = None  # divisor of their size in this training; None: as the model was trained

    def __post_init__(self) -> None:
        if not 1 <= self.levels <= MAX_LEVELS:
            raise ConfigError(f"--levels {self.levels}: expected 1 to {MAX_LEVELS}")
        if not 0.01 <= self.keep < 1:
            raise ConfigError(
                f"--keep {self.keep:g}: expected a share of the Gaussians from 0.01 to below 1, such as 0.5"
            )
        if self.steps:
            require_steps(self.steps)
        if self.downscale is not None and not 1 <= self.downscale < math.inf:
            raise ConfigError(f"--downscale {self.downscale:g}: expected a divisor of at least 1")
        if self.downscale is not None and self.steps == 0:
            raise ConfigError(f"--downscale {self.downscale:g}: belongs to a training; expected --steps above 0")


@dataclass(frozen=True)
class DetailLevel:
    """One level; PSNR in dB, before it is quantized, where there are photographs."""

    model: Model
    merged_psnr: float | None = None  # before it was trained
    psnr: float | None = None


class LevelTrainer:
    """Trains and measures levels."""

    def __init__(self, opened: ModelFile, place: Path, plan: LodPlan) -> None:
        self.place, self.plan, self.source = place, plan, opened.source
        self.steps = STEPS if plan.steps is None else plan.steps
        self.measurer = Measurer(opened)
        self.tuning = Tuning("lod", opened.source, opened.gaussians, self.steps, opened.device)

    def locked(self) -> AbstractContextManager[None]:
        """Hold the folder of the training in a block, where anything is trained."""
        if not self.steps or self.plan.levels == 1:
            return nullcontext()
        question: dict[str, Any] = {"sha256": sha256(model_file(self.source.file)), "scene": str(self.source.folder)}
        question |= {"keep": self.plan.keep, "steps": self.steps, "downscale": self.plan.downscale}
        question["photographs"] = self.measurer.identity()
        return claim_folder(self.place, question, RECORD, "the training of levels", "the name of another folder")

    def measured(self, model: Model) -> DetailLevel:
        """Return a level that is not trained."""
        psnr = self.measurer.figures(model)[0]
        return DetailLevel(model, psnr, psnr)

    def train(self, number: int, model: Model) -> DetailLevel:
        """Return a level after its training."""
        merged = self.measured(model)
        if not self.steps:
            return merged
        file = self.place / f"level_{number}.ply"
        model.save(file)
        size = {"scene.downscale": self.plan.downscale} if self.plan.downscale else {}
        pipeline = self.tuning.pipeline(STAGES, {"init.file": str(file.resolve()), **size})
        found = load(self.tuning.train(pipeline, self.place / f"level_{number}"))
        return DetailLevel(found, merged.psnr, self.measured(found).psnr)


NEIGHBORS = 8  # of a Gaussian, among which its partner is
BLOCK = 1 << 16  # pairs whose costs are computed together
LOG_SCALES, LOGIT = (-17.0, 60.0), 80.0  # beyond which numbers that follow from them leave float64
Tables = dict[str, Floats]


def decimate(model: Model, keep: float = 0.5) -> Model:
    """Return a model with a share of the Gaussians, one at least, of which neighbors are merged.

    A world filter is baked.  Raises ConfigError for what is no share, DataError for values that are not finite.
    """
    if not 0 < keep <= 1:
        raise ConfigError(f"--keep {keep:g}: expected a share of the Gaussians above 0, up to 1")
    plain = model.baked()
    if bad := int(not_finite(plain.tables()).sum()):
        raise DataError(f"{bad} Gaussians hold values that are not finite; drop them with `clsplat convert`")
    target = min(len(plain), max(1, int(keep * len(plain) + 0.5)))
    if target == len(plain):
        return plain
    tables = _settled(plain)
    while (count := len(tables["means"])) > target:
        first, second = match_pairs(tables)
        tables = _joined(tables, first[: count - target], second[: count - target])
    fewer: dict[str, Any] = {name: table.astype(np.float32) for name, table in tables.items()}
    return replace(plain, **fewer)


def match_pairs(tables: Tables) -> tuple[Rows, Rows]:
    """Return pairs of rows, the cheapest first, of which none shares a row: one at least, where there are two rows."""
    one, two = _neighbors(tables["means"])
    cost = pair_cost(tables, one, two)
    order = np.lexsort((two, one, np.where(np.isfinite(cost), cost, np.inf)))
    free = bytearray(b"\1") * len(tables["means"])
    chosen = []
    for start in range(0, len(order), BLOCK):
        some = order[start : start + BLOCK]
        for at, i, j in zip(some.tolist(), one[some].tolist(), two[some].tolist(), strict=True):
            if free[i] and free[j]:
                free[i] = free[j] = 0
                chosen.append(at)
    return one[chosen], two[chosen]


def pair_cost(tables: Tables, first: Rows, second: Rows) -> Floats:
    """Return what merging changes, [pairs]; symmetric in the pair up to rounding."""
    mass, size = mass_of(tables, surface), tables["log_scales"].sum(axis=1)  # of all rows: once, not for each block
    blocks = [slice(start, start + BLOCK) for start in range(0, len(first), BLOCK)]
    return np.concatenate([_block_cost(tables, mass, size, first[block], second[block]) for block in blocks])


def _block_cost(tables: Tables, mass: Floats, size: Floats, first: Rows, second: Rows) -> Floats:
    mixtures = Mixtures.from_pairs(tables, mass, first, second)
    share = mixtures.share[:, 0]
    variances = np.linalg.eigvalsh(mixtures.covariance).astype(np.float64)
    cost: Floats = log_scales_of(variances).sum(axis=1) - (1 - share) * size[first] - share * size[second]
    for name in ("sh_base", "sh_rest"):
        cost += np.square(tables[name][first] - tables[name][second]).sum(axis=1)
    return cost


def _neighbors(means: Floats) -> tuple[Rows, Rows]:
    """Pairs of a row and one of its nearest neighbors, the lower row first, each once and in ascending order.

    Of rows in one place, each has the next one, and the first one has neighbors in other places.
    """
    places, first, place = np.unique(means, axis=0, return_index=True, return_inverse=True)
    found = cKDTree(places).query(places, k=min(NEIGHBORS + 1, len(places)))[1].reshape(len(places), -1)
    one, two = first[np.repeat(np.arange(len(places)), found.shape[1])], first[found.ravel()]
    by_place = np.argsort(place.ravel(), kind="stable")
    same = np.diff(place.ravel()[by_place]) == 0
    one = np.concatenate([one, by_place[:-1][same]])
    two = np.concatenate([two, by_place[1:][same]])
    count, apart = len(means), one != two
    pairs = np.unique(np.minimum(one, two)[apart].astype(np.int64) * count + np.maximum(one, two)[apart])
    return pairs // count, pairs % count


def _settled(model: Model) -> Tables:
    """The tables in float64, with what the formulas can hold."""
    tables = {name: table.astype(np.float64) for name, table in model.tables().items()}
    tables["quats"] = unit(tables["quats"])
    tables["log_scales"] = np.clip(tables["log_scales"], *LOG_SCALES)
    tables["logit_opacity"] = np.clip(tables["logit_opacity"], -LOGIT, LOGIT)
    return tables


def _joined(tables: Tables, first: Rows, second: Rows) -> Tables:
    """The tables with mixtures at the rows `first`, and without the rows `second`."""
    kept = np.ones(len(tables["means"]), bool)
    kept[second] = False
    mixtures = merge(tables, first, second, surface)
    for name, values in mixtures.items():
        tables[name][first] = values
    return {name: table[kept] for name, table in tables.items()}


LOG = logging.getLogger("clsplat")
FEW = 1_000_000  # Gaussians, below which PlayCanvas advises one SOG


def levels_of_detail(
    model: Path, folder: Path, scene: Path | None = None, plan: LodPlan | None = None, device: Any = None
) -> dict[str, Any]:
    """Write the levels of a model as streamed SOG; return its `folder`, `bytes`, the `split` measured, and `levels`.

    Where photographs are known, each coarser level is trained before the next one is merged from it, in run folders in
    FOLDER.training: what was interrupted goes on.  Raises ConfigError, DataError, OutputError.
    """
    plan = plan or LodPlan()
    require_free(folder)
    opened, first = _opened(model, scene, plan, device)
    if not len(first):
        raise DataError(f"{model}: the model holds no Gaussians; expected some to merge")
    require_static(model, first.to_splat_file(), "SOG")
    require_in_range(model, first.to_splat_file(), "SOG")
    if len(first) < FEW:
        told = pluralize(len(first), "Gaussian")
        LOG.warning("%s: has %s; below a million one SOG is better: `clsplat convert`", model, told)
    training = LevelTrainer(opened, folder.with_name(f"{folder.name}.training"), plan) if opened else None
    with new_folder(folder) as place:
        with training.locked() if training else nullcontext():
            levels = _levels(first, plan, training)
        digest = write_lod(place, [level.model.to_splat_file() for level in levels])
        write_sky_file(first.sky, place / LOD_META, digest)
    if first.sky:
        told = sky_path(folder / LOD_META).name
        LOG.info("%s: the sky of the finest level is in %s, which clsplat alone draws", folder, told)
    return {
        "folder": str(folder),
        "bytes": model_bytes(folder),
        "split": training.measurer.split if training else None,
        "levels": [_figures(folder, number, level) for number, level in enumerate(levels)],
    }


def _opened(model: Path, scene: Path | None, plan: LodPlan, device: Any) -> tuple[ModelFile | None, Model]:
    """The model with its photographs, or alone where there are none, and its Gaussians."""
    run = run_of(model) if scene is None else None
    if scene is None and run is None:
        alone = _alone(model, plan, device, "no photographs are known")
        LOG.info("%s: no photographs: merged alone", model)
        return None, alone
    try:
        opened = ModelFile(model, scene, device)
    except DataError as error:
        if run is None or (fault := _fault_of_photographs(run)) is None:
            raise
        if plan.steps != 0:
            raise DataError(f"{fault} (--scene DIR names another; --steps 0 needs none)") from error
        alone = _alone(model, plan, device, "its photographs cannot be read")
        LOG.warning("%s; levels are merged alone, and not measured", fault)
        return None, alone
    return opened, opened.gaussians.baked()


def _alone(model: Path, plan: LodPlan, device: Any, why: str) -> Model:
    """The Gaussians of a model without photographs.  Raises ConfigError for what needs them."""
    alone = load(model).baked()
    given = {"--steps": plan.steps, "--downscale": plan.downscale, "--device": device}
    if names := ", ".join(name for name, value in given.items() if value):
        raise ConfigError(f"{model}: {why}, needed for {names}; give --scene, or leave that out")
    return alone


def _fault_of_photographs(run: Path) -> DataError | None:
    """Why those of a run cannot be read."""
    try:
        read_scene(photographs_of(run))
    except DataError as error:
        return error
    return None


def _levels(first: Model, plan: LodPlan, training: LevelTrainer | None) -> list[DetailLevel]:
    levels = [training.measured(first) if training else DetailLevel(first)]
    for number in range(1, plan.levels):
        fewer = decimate(levels[-1].model, plan.keep)
        LOG.info("level %d: %s", number, pluralize(len(fewer), "Gaussian"))
        levels.append(training.train(number, fewer) if training else DetailLevel(fewer))
    return levels


def _figures(folder: Path, number: int, level: DetailLevel) -> dict[str, Any]:
    """Counts, size and PSNR of a level that was written."""
    size = sum(file.stat().st_size for file in folder.glob(f"{number}_*/*"))
    figures = {"level": number, "gaussians": len(level.model), "bytes": size}
    return {**figures, "merged_psnr": level.merged_psnr, "psnr": level.psnr}


# Levels of detail as a table in text.

HEADINGS = ("level", "Gaussians", "MB", "PSNR, dB", "before training")


def table(found: dict[str, Any]) -> str:
    """Return what `levels_of_detail` returns as lines of text."""
    used = len(HEADINGS) if found["split"] else 3
    return text_table([HEADINGS[:used], *(_cells(level)[:used] for level in found["levels"])])


def _cells(level: dict[str, Any]) -> list[str]:
    size, psnr = f"{level['bytes'] / 1e6:.3g}", [level["psnr"], level["merged_psnr"]]
    return [str(level["level"]), f"{level['gaussians']:,}", size, *("" if db is None else f"{db:.2f}" for db in psnr)]
