"""The memory that a cell needs, by the plan of training, and whether a device holds it.

It is known before any run: how many Gaussians a training begins with, and where its growth ends at the latest.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from clsplat.core.schedule import at_step
from clsplat.photos.photographs import BUDGET_SHARE
from clsplat.pipeline.loading import Pipeline
from clsplat.scene.scene import Scene
from clsplat.stages.densify import Densify
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.training.memory import (
    DeviceLimits,
    Harmonics,
    MemoryPlan,
    bytes_of_modules,
    first_tables,
    last_place,
    most_pixels,
    plan,
)
from clsplat.training.stage import Stage

TILE = 16  # px a side, the larger of those that devices take


@dataclass(frozen=True)
class Need:
    """What the training of a cell takes on a device."""

    degree: int  # of spherical harmonics
    photographs: int  # bytes of all that are trained on
    budget: int | None  # bytes of them on the device at most; None: a share of its memory
    pixels: int  # of the largest, whole tiles
    first: int  # Gaussians that it begins with
    most: int  # Gaussians at which its growth ends; where nothing says so, those that it begins with
    motion: int = 0  # columns of the motion; 0 where nothing moves
    harmonics: Harmonics = "device"
    modules: int = 0  # bytes that modules of a training take

    @classmethod
    def of(cls, pipeline: Pipeline, scene: Scene) -> "Need | None":
        """Return the need of a pipeline on a scene; None where it begins with no Gaussians, as of a field.

        Raises DataError where its model cannot be read.
        """
        first = next((stage for stage in pipeline.stages if isinstance(stage, Init)), None)
        if first is None:
            return None
        settings, trainings = pipeline.settings, [one for one in pipeline.stages if isinstance(one, Optimize)]
        views = scene.downscaled(settings.scene.downscale).split("train")
        budget, begins = settings.scene.image_budget, first.expected_count(scene)
        steps = sum(stage.steps for stage in trainings)
        ends = [at_step(one.max_gaussians, steps) for one in _densities(trainings) if one.max_gaussians is not None]
        return cls(
            settings.model.sh_degree,
            sum(4 * view.camera.width * view.camera.height for view in views),
            None if budget is None else budget << 20,
            most_pixels(views, TILE),
            begins,
            max(begins, int(max(ends, default=0))),
            settings.model.time.width if settings.model.time else 0,
            settings.harmonics,
            bytes_of_modules(trainings, views, TILE),
        )

    def plan(self, limits: DeviceLimits) -> MemoryPlan:
        """Return the plan of its training on a device."""
        budget = int(limits.memory * BUDGET_SHARE) if self.budget is None else self.budget
        tables, held = first_tables(self.degree, self.motion), min(budget, self.photographs) + self.modules
        return plan(limits, tables, held, self.pixels, harmonics=last_place(self.harmonics, limits))

    def limit_on(self, limits: DeviceLimits) -> int:
        """Return the largest number of Gaussians that a device holds."""
        return self.plan(limits).limit

    def begins_on(self, limits: DeviceLimits) -> bool:
        """Whether a device holds what it begins with, without which its run would be refused."""
        return self.limit_on(limits) >= self.first

    def ends_on(self, limits: DeviceLimits) -> bool:
        """Whether a device holds it when its growth ends."""
        return self.limit_on(limits) >= self.most

    def refusal(self, limits: DeviceLimits) -> str:
        """Return why no device takes it; limits: of the one that holds most."""
        return (
            f"no device of the sweep holds it; of the largest, {self.plan(limits).text(self.first)}; offer a larger "
            "one, start from fewer points, or use smaller images (scene.downscale) or fewer runs at a time "
            "(execution.packing)"
        )


def _densities(trainings: Iterable[Optimize]) -> "list[Densify]":
    inner: list[Stage] = [stage for training in trainings for stage in training.during]
    return [stage for stage in inner if isinstance(stage, Densify)]
