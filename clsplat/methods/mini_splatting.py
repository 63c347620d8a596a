"""Prune and hide Gaussians by their blend weights in each view, and reinitialize them from depth.

From Mini-Splatting and Mini-Splatting2 (Fang and Wang 2024).
"""

import logging
from collections.abc import Mapping
from dataclasses import asdict
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import NumericError
from clsplat.density.control import Change
from clsplat.density.edit import Edit, Rule
from clsplat.density.importance import Weights, heaviest, sampling_order, weights
from clsplat.density.survey import WEIGHT, Survey
from clsplat.density.thresholds import Share
from clsplat.gaussians.conversion import from_points
from clsplat.gaussians.gaussians import HIDDEN, HIDDEN_VIEWS, Gaussians, hide
from clsplat.metrics.images import to_8_bits
from clsplat.scene.scene import PointCloud
from clsplat.scene.view import View
from clsplat.training.memory import first_tables, last_place
from clsplat.training.modules.base import color_model, learned_scene
from clsplat.training.run import Run
from clsplat.training.sh_offload import more_room
from clsplat.training.stage import Scheduled, Stage

LOG = logging.getLogger("clsplat")
Floats = NDArray[np.float64]


def sampled_weights(survey: Survey, weight_per_view: float | None = None, number: int | None = None) -> Weights:
    """Return the weights in training views.

    weight_per_view: as in `weights`.  number: of sampled views; None: all views.
    """
    views = survey.views if number is None else survey.sample_views(number)
    return weights(survey.render(views), survey.count, weight_per_view)


def useless(survey: Survey, weight_per_view: float) -> NDArray[np.bool_]:
    """Return for each view the Gaussians that it sees but does not need, [V, N].

    It needs the heaviest, which add up to the share `weight_per_view` of its weight.
    """
    hidden = np.zeros((len(survey.views), survey.count), bool)
    for row, look in zip(hidden, survey.render(survey.views), strict=True):
        row[:] = (look.radius() > 0) & ~heaviest(look.sum(WEIGHT).astype(np.float64), weight_per_view)
    return hidden


class PruneUseless(Rule):
    """Remove Gaussians that are useful in few training views, and the Gaussians with the smallest weights.

    The weight of a Gaussian in a view is the sum of alpha T over the pixels.  The heaviest ones that together make up
    `weight_per_view` of the view's weight are useful in it.
    """

    type: Literal["prune_useless"] = "prune_useless"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"weight_per_view", "weight_total", "views", "views_below"})

    weight_per_view: Share = 0.99
    """Fraction of a view's weight that its useful Gaussians make up."""
    views: Annotated[int, Field(ge=1)] | None = None
    """Number of training views, sampled by seed and step; default: all."""
    views_below: Annotated[int, Field(ge=0)] = 2
    """A Gaussian that is useful in fewer views is removed."""
    weight_total: Share = 0.999
    """Fraction of the weight in all views that is kept; the smallest weights are removed."""

    def mark(self, edit: Edit) -> None:
        weights = edit.survey.cached(sampled_weights, self.weight_per_view, self.views)
        kept = heaviest(weights.total, self.weight_total) & (weights.views >= self.views_below)
        edit.choose(~kept, copies=0, kept=0)


class HideUseless(Scheduled):
    """Skip, in the steps on each training view, the Gaussians that contribute little to it, to save time
    (Mini-Splatting2, Fang and Wang 2024).

    The heaviest Gaussians that together make up `weight_per_view` of a view's weight, alpha T over all pixels, stay.
    New Gaussians are hidden in the views in which their source was.  Other renders, and all renders after the training,
    show every Gaussian.
    """

    stage: Literal["hide_useless"] = "hide_useless"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"weight_per_view"})
    edits: ClassVar[bool] = True

    weight_per_view: Share = 0.99
    """Fraction of a view's weight that its visible Gaussians make up."""

    def attach(self, run: Run) -> None:
        if HIDDEN not in run.model.gaussians.tables:
            run.model.gaussians.add(HIDDEN, -(-len(run.scene.split("train")) // HIDDEN_VIEWS))

    def run(self, run: Run) -> None:
        hide(run.model.gaussians, useless(run.survey(), self.weight_per_view))


# New Gaussians on the surfaces that a model shows (Mini-Splatting2).


class SampledPixels(NamedTuple):
    """Sampled pixels of one image, as points in the scene."""

    positions: Floats  # [n, 3] scene units
    colors: Floats  # [n, 3] in [0, 1]
    pixel: Floats  # [n] side of a pixel at its depth, scene units
    spacing: Floats  # [n] approximate distance to the next sampled pixel, scene units


class ReinitFromDepth(Stage):
    """Replace all Gaussians by new ones on the surfaces that the training images show, between two trainings
    (Mini-Splatting2, Fang and Wang 2024).  This evens out clusters and removes floaters.

    Each image contributes the same number of distinct pixels, sampled by their alpha; masked pixels are not sampled.
    The paper calls this weight 1 − accum_alpha, where accum_alpha is the transmittance, as in the code of 3DGS.

    A new Gaussian is at the mean depth of its pixel, weighted by alpha T; at an edge this is between two surfaces.  The
    paper uses the middle of the ray's segment in the Gaussian with the largest weight.  The color is that of the
    image, or of the render where training learns exposures.  Poses are the optimized ones.  The standard deviation is
    the mean distance to the three nearest neighbors, as in `init`, but at least one pixel and at most the distance to
    the next sampled pixel.  Adam's moments, statistics and averages are reset; the active SH degree stays, with zero
    coefficients.
    """

    stage: Literal["reinit_from_depth"] = "reinit_from_depth"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    takes: ClassVar[frozenset[str]] = frozenset({"adam", "stats", "average", "palette", "metrics"})
    edits: ClassVar[bool] = True
    edits_last: ClassVar[bool] = True
    conflicts: ClassVar[Mapping[str, str]] = {"motion": "depths are of one timestamp; remove the stage or model.time"}

    count: Annotated[int, Field(gt=0)] | None = None
    """Largest number of new Gaussians; default: the current number.  Images with few covered pixels give fewer."""
    opacity: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Opacity of the new Gaussians."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Factor of the new sizes."""

    def run(self, run: Run) -> None:
        before, degree, width = run.model.gaussians.count, run.model.degree, run.model.gaussians.sh_degree
        count = self.count or before
        run.memory_plan(first_tables(width), last_place(run.harmonics, run.device.info)).check(count, more_room(run))
        samples = self._sample(run, count)
        positions, colors, pixel, spacing = (np.concatenate(parts) for parts in zip(*samples, strict=True))
        if not len(positions):
            raise NumericError(
                "reinit_from_depth: the model covers no pixel of the training images; train longer before this stage"
            )
        points = PointCloud(positions.astype(np.float32), colors.astype(np.float32))
        parameters = from_points(points, self.opacity, width)
        size = np.clip(np.exp(parameters["log_scales"][:, 0].astype(np.float64)), pixel, spacing)
        parameters["log_scales"][:] = np.log(self.scale * size)[:, None]
        model = run.model_settings.model(Gaussians(run.device, parameters), degree)
        with run.editing_tables():
            run.adam, run.stats, run.metrics = None, None, {}  # they belong to the earlier model
            run.model = model
            run.refresh_filter()
        change = Change(before, len(points), {self.stage: before}, {})
        run.records.add(run.step, "densify", **asdict(change))
        LOG.info("%s Gaussians from depth replace %s", f"{change.after:,}", f"{before:,}")

    @staticmethod
    def _sample(run: Run, count: int) -> list[SampledPixels]:
        """Sample pixels of each training image; random numbers depend on the seed, the step and the image's index."""
        views = learned_scene(run).downscaled(run.downscale).split("train")
        painter, samples, has_exposures = run.painter(), list[SampledPixels](), color_model(run) is not None
        for number, view in enumerate(run.status.counted(views, "photographs", len(views))):
            photograph = run.photographs.get(view)
            layers = painter.layers(photograph.camera, depth=True)
            assert layers.depth is not None  # since depth=True
            mask, pixels = photograph.counted(), count // len(views) + (number < count % len(views))
            alpha = np.where(layers.depth > 0, layers.alpha, 0) * (1 if mask is None else mask)
            random = np.random.default_rng([run.seed, run.step, number])
            image = to_8_bits(layers.image) if has_exposures else photograph.image()
            samples.append(sample_pixels(view, alpha, layers.depth, image, pixels, random))
        return samples


def sample_pixels(
    view: View,
    alpha: NDArray[np.floating],
    depth: NDArray[np.floating],
    image: NDArray[np.uint8],
    count: int,
    random: np.random.Generator,
) -> SampledPixels:
    """Sample `count` distinct pixels of a view by alpha, or all covered ones if there are fewer.

    alpha, depth: [height, width], in [0, 1] and in scene units along the axis; image: [height, width, 3].
    """
    weights = alpha.astype(np.float64).ravel()
    pixels = np.sort(sampling_order(weights > 0, weights, random)[:count])
    camera, (rows, columns) = view.camera, np.divmod(pixels, alpha.shape[1])
    z = depth[rows, columns].astype(np.float64)
    rays = np.stack(
        [(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, np.ones(len(z))], axis=1
    )
    rotation, translation = view.world_to_camera[:, :3], view.world_to_camera[:, 3]
    pixel = z / np.sqrt(camera.fx * camera.fy)
    fraction = np.minimum(1, len(pixels) * weights[pixels] / (weights.sum() or 1))  # of pixels sampled around this one
    positions = (rays * z[:, None] - translation) @ rotation
    return SampledPixels(positions, image[rows, columns] / 255.0, pixel, pixel / np.sqrt(fraction))
