"""A palette of harmonics, as a SOG holds it: drawn, and trained."""

import logging
from collections.abc import Collection, Mapping
from functools import partial
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import amount
from clsplat.density.visible_error import VisibleError
from clsplat.formats.sog import Harmonics
from clsplat.formats.sog_quantize import (
    log_weights,
    rounded,
    rounded_quats,
    weighed_means,
)
from clsplat.formats.splats import Quality
from clsplat.gaussians.gaussians import ALIGNMENT, Gaussians
from clsplat.opencl.device import Device, constants
from clsplat.training.run import Run
from clsplat.training.stage import ALL_HARMONICS, Scheduled, Stage

LOG = logging.getLogger("clsplat")
FILE = "clusters.cl"
TOGETHER = int(constants(FILE)["TOGETHER"])
BLOCK = 1 << 16  # points on the device at once: they have many components
AT_ONCE = 1024  # vectors of a launch: they stay in a core's cache


class PaletteSh(Scheduled):
    """Give each Gaussian one of the vectors of a palette of harmonics, as a SOG holds them.

    Errors count by how they show in the training views: by what a Gaussian contributes there, in the directions from
    which it is seen, and without what the base color takes up, which is changed by it.  Training that follows with a
    rate of 0 for `sh_rest` adapts the other tables to them, and the SOG then loses nothing of its harmonics.  Harmonics
    that are vectors of a palette already keep it, and are rounded to the numbers that a SOG has.
    """

    stage: Literal["palette_sh"] = "palette_sh"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    makes: ClassVar[frozenset[str]] = frozenset({"palette"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"quality", "step"})

    quality: Quality = "balanced"
    """Of the SOG: `small`, `balanced` or `high`, which have 1,024, 4,096 and 16,384 vectors at most."""
    step: Annotated[float, Field(gt=0)] | None = None
    """Step of the coefficients of the vectors, where that makes 256 different ones at most: a larger one makes the
    file smaller."""

    def stale(self, run: Run) -> Collection[str]:
        return "sh_base", "sh_rest"

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        if not gaussians.sh_degree:
            return
        rest, error = gaussians.get("sh_rest"), visible_error(run)
        better = partial(error.palette, rest, nearest=partial(most_alike, run.device))
        found = Harmonics.few(rest, self.quality, error.weights, better, self.step)
        gaussians.set("sh_rest", found.values)
        gaussians.set("sh_base", gaussians.get("sh_base") + error.base_change(rest - found.values))
        set_clusters(gaussians, found.labels, error.weights)
        if run.adam is not None:
            run.adam.forget("sh_rest")
        LOG.info("%s of %s", amount(len(found.palette), "harmonic"), amount(gaussians.count, "Gaussian"))


class SharePalette(Scheduled):
    """Move each vector of the palette to the mean of the harmonics of its Gaussians, which get it again.

    The mean is by what the Gaussians contributed to the training views when `palette_sh` drew the palette.  On a
    cadence, with a rate for `sh_rest`, the vectors are trained: each Gaussian moves its own, and those that share one
    agree.  It belongs right behind such a training too, since no edit follows the last step.
    """

    stage: Literal["share_palette"] = "share_palette"
    needs: ClassVar[frozenset[str]] = frozenset({"model", "palette"})
    edits: ClassVar[bool] = True
    conflicts = ALL_HARMONICS

    def excluded(self) -> Mapping[str, str]:
        return self.conflicts if self.every else {}  # not after a training

    def run(self, run: Run) -> None:
        if run.model.gaussians.sh_degree:
            share(run.model.gaussians, "sh_rest")


def visible_error(run: Run) -> VisibleError:
    """Return how errors of the harmonics show in the training views."""
    views, gaussians = run.scene.split("train"), run.model.gaussians
    looks = run.survey().looks(run.status.counted(views, "views", len(views)))
    positions = (view.position for view in views)
    coefficients = gaussians.tables["sh_rest"].components // 3
    return VisibleError.of(zip(looks, positions, strict=False), gaussians.get("means"), coefficients)


def most_alike(device: Device, points: NDArray[np.float32], vectors: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the vector, of [E, c], with the largest product for each point, of [N, c], the first of equal ones."""
    blocks = (points[start : start + BLOCK] for start in range(0, len(points), BLOCK))
    return np.concatenate([_most_alike(device, block, vectors) for block in blocks])


def _most_alike(device: Device, points: NDArray[np.float32], vectors: NDArray[np.float32]) -> NDArray[np.int64]:
    count, components = points.shape
    stride = -(-count // ALIGNMENT) * ALIGNMENT
    planes = np.zeros((components, stride), np.float32)
    planes[:, :count] = points.T
    entries = -(-len(vectors) // TOGETHER) * TOGETHER
    padded = np.concatenate([vectors, np.repeat(vectors[:1], entries - len(vectors), axis=0)])  # the first counts
    label, largest = device.empty(stride), device.empty(stride)
    uploaded, all_vectors = device.upload(planes), device.upload(np.ascontiguousarray(padded, np.float32))
    for first in range(0, entries, AT_ONCE):
        device.program(FILE).most_alike(
            items=-(-count // int(device.tuning["LANES"])),
            points=uploaded,
            vectors=all_vectors,
            label=label,
            largest=largest,
            components=components,
            first=first,
            end=min(first + AT_ONCE, entries),
            stride=stride,
            count=count,
        )
    return label.get()[:count].astype(np.int64)


# Gaussians in clusters whose members share values; which cluster, and with which weight, is in tables next to them.

LABEL, WEIGHT = "cluster/label", "cluster/weight"  # [1] a whole number below 2^24, [1] at least 0


def set_clusters(gaussians: Gaussians, labels: NDArray[np.integer], weights: NDArray[np.floating]) -> None:
    """Note the cluster of each Gaussian, [N], and how much it counts there, [N]."""
    for name, column in ((LABEL, labels), (WEIGHT, weights)):
        if name not in gaussians.tables:
            gaussians.add(name, 1)
        gaussians.set(name, column[:, None])


def share(gaussians: Gaussians, name: str) -> None:
    """Replace each row of a table by the weighted mean of its cluster's rows, summed in their order."""
    labels = gaussians.get(LABEL)[:, 0].astype(np.int64)
    order, first = np.argsort(labels, kind="stable"), np.concatenate([[0], np.cumsum(np.bincount(labels))])
    gaussians.device.program("members.cl").share_mean(
        items=(len(first) - 1, gaussians.tables[name].components),
        values=gaussians[name],
        weight=gaussians[WEIGHT],
        member=gaussians.device.upload(order.astype(np.uint32)),
        first=gaussians.device.upload(first.astype(np.uint32)),
        stride=gaussians.capacity,
        clusters=len(first) - 1,
    )


# Tables of a model in fewer different values, which a SOG holds in fewer bytes.

Step = Annotated[float, Field(gt=0)]
Levels = Annotated[int, Field(ge=1, le=64)]


class RoundTables(Stage):
    """Round tables to steps, as a SOG then holds them in fewer bytes.

    Tables without a step stay.  Training that follows with rates of 0 for what was rounded adapts the others to it.
    """

    stage: Literal["round_tables"] = "round_tables"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"means", "quats", "log_scales", "sh_base"})

    means: Step | None = None
    """Step of positions, as a share of the size of each Gaussian (the geometric mean of three standard deviations);
    larger where it weighs little."""
    quats: Levels | None = None
    """Levels of 255 from one to the next; the axes of each Gaussian are named anew, so that it is turned least."""
    log_scales: Step | None = None
    """Step of the logarithms of standard deviations."""
    sh_base: Step | None = None
    """Step of the coefficients of band 0; 1 changes a color by 0.28."""

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        tables = {name: gaussians.get(name) for name in self._changed()}
        if self.means:
            p = {name: gaussians.get(name) for name in ("means", "log_scales", "logit_opacity")}
            tables["means"] = weighed_means(p["means"], p["log_scales"], log_weights(p), self.means)
        if self.quats:
            tables["quats"], tables["log_scales"] = rounded_quats(tables["quats"], tables["log_scales"], self.quats)
        if self.log_scales:
            tables["log_scales"] = rounded(tables["log_scales"], self.log_scales)
        if self.sh_base:
            tables["sh_base"] = rounded(tables["sh_base"], self.sh_base)
        for name, table in tables.items():
            gaussians.set(name, table)
        run.refresh_filter()

    def _changed(self) -> Collection[str]:
        steps = {
            "means": self.means,
            "quats": self.quats,
            "log_scales": self.log_scales or self.quats,
            "sh_base": self.sh_base,
        }
        return [name for name, step in steps.items() if step]
