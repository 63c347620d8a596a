"""Importance by blend weights, view by view, and new Gaussians from depths (Mini-Splatting and Mini-Splatting2, Fang
and Wang 2024)."""

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


def drawn_weights(survey: Survey, weight_per_view: float | None = None, drawn: int | None = None) -> Weights:
    """Return the weights in training views.

    weight_per_view: as in `weights`.  drawn: the number of views; None: all.
    """
    views = survey.views if drawn is None else survey.sample_views(drawn)
    return weights(survey.render(views), survey.count, weight_per_view)


def useless(survey: Survey, weight_per_view: float) -> NDArray[np.bool_]:
    """Return for each view the Gaussians that it sees but does not need, [V, N].

    It needs the heaviest, which add up to the share `weight_per_view` of its weight.
    """
    found = np.zeros((len(survey.views), survey.count), bool)
    for here, look in zip(found, survey.render(survey.views), strict=True):
        here[:] = (look.radius() > 0) & ~heaviest(look.sum(WEIGHT).astype(np.float64), weight_per_view)
    return found


class PruneUseless(Rule):
    """Remove Gaussians that are useful in few training views, and those that together have little weight.

    In a view those are useful that make most of its weight, alpha T over all pixels, the largest first.
    """

    type: Literal["prune_useless"] = "prune_useless"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"weight_per_view", "weight_total", "views", "views_below"})

    weight_per_view: Share = 0.99
    """Share of a view's weight that is made by what is useful in it."""
    views: Annotated[int, Field(ge=1)] | None = None
    """Number of training views, drawn by seed and step; all of them without a number, or where there are no more."""
    views_below: Annotated[int, Field(ge=0)] = 2
    """Number of views below which a Gaussian is removed."""
    weight_total: Share = 0.999
    """Share of the weight in all views that stays; the smallest weights go."""

    def mark(self, edit: Edit) -> None:
        found = edit.survey.cached(drawn_weights, self.weight_per_view, self.views)
        kept = heaviest(found.total, self.weight_total) & (found.views >= self.views_below)
        edit.choose(~kept, copies=0, kept=0)


class HideUseless(Scheduled):
    """Leave out of the steps on each training view the Gaussians that make little of it, which saves time
    (Mini-Splatting2, Fang and Wang 2024).

    Useful in a view are those that make most of its weight, alpha T over all pixels, the largest first.  What is new
    later is hidden where its source was.  All are drawn in other pictures, and in all after the training.
    """

    stage: Literal["hide_useless"] = "hide_useless"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    training_keys: ClassVar[frozenset[str]] = frozenset({"weight_per_view"})
    edits: ClassVar[bool] = True

    weight_per_view: Share = 0.99
    """Share of a view's weight that is made by what it shows."""

    def attach(self, run: Run) -> None:
        if HIDDEN not in run.model.gaussians.tables:
            run.model.gaussians.add(HIDDEN, -(-len(run.scene.split("train")) // HIDDEN_VIEWS))

    def run(self, run: Run) -> None:
        hide(run.model.gaussians, useless(run.survey(), self.weight_per_view))


# New Gaussians on the surfaces that a model shows (Mini-Splatting2).


class Drawn(NamedTuple):
    """What was drawn of one photograph."""

    positions: Floats  # [n, 3] scene units
    colors: Floats  # [n, 3] in [0, 1]
    pixel: Floats  # [n] side of a pixel at its depth, scene units
    apart: Floats  # [n] distance to the next that was drawn, about, scene units


class ReinitFromDepth(Stage):
    """Replace all Gaussians by new ones on the surfaces that the training photographs show, between two trainings
    (Mini-Splatting2, Fang and Wang 2024).  Clusters become even, and floaters behind and before surfaces go.

    Each photograph has the same number of them, at pixels that are drawn, none twice, by the share alpha of a pixel
    that the model covers: what nothing covers has no depth.  That is what is published as 1 − accum_alpha, an array
    that holds the transmittance, 1 − alpha, as in the code of 3DGS.  Pixels that a mask leaves out are not drawn.

    A Gaussian lies at the mean depth of what covers its pixel, weighted by alpha T, which at an edge falls between
    two surfaces; published is the middle of the ray's way through the Gaussian of the largest weight. It has the
    photograph's color; where photographs have learned colors of their own, that of the model's picture, which has
    none of them. A learned camera counts where it was learned to be. The Gaussian's standard deviation is the mean
    distance to the three nearest neighbors, as `init` has it, but at least a pixel and at most the distance to the
    next drawn pixel. Adam's moments, statistics and averages begin anew; the active degree of the harmonics stays,
    with zeros.
    """

    stage: Literal["reinit_from_depth"] = "reinit_from_depth"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    takes: ClassVar[frozenset[str]] = frozenset({"adam", "stats", "average", "palette", "metrics"})
    edits: ClassVar[bool] = True
    changes_last: ClassVar[bool] = True
    conflicts: ClassVar[Mapping[str, str]] = {"motion": "a depth is of one moment; leave the stage or model.time out"}

    count: Annotated[int, Field(gt=0)] | None = None
    """Number of new Gaussians, at most; without it, as many as there are.  Photographs of which little is
    covered give fewer."""
    opacity: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Opacity of the new Gaussians."""
    scale: Annotated[float, Field(gt=0)] = 1.0
    """Factor of the new sizes."""

    def run(self, run: Run) -> None:
        before, degree, width = run.model.gaussians.count, run.model.degree, run.model.gaussians.sh_degree
        count = self.count or before
        run.memory_plan(first_tables(width), last_place(run.harmonics, run.device.info)).check(count, more_room(run))
        drawn = self._drawn(run, count)
        positions, colors, pixel, apart = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        if not len(positions):
            raise NumericError(
                "reinit_from_depth: the model covers no pixel of the training photographs; train longer before it"
            )
        points = PointCloud(positions.astype(np.float32), colors.astype(np.float32))
        parameters = from_points(points, self.opacity, width)
        size = np.clip(np.exp(parameters["log_scales"][:, 0].astype(np.float64)), pixel, apart)
        parameters["log_scales"][:] = np.log(self.scale * size)[:, None]
        model = run.model_settings.model(Gaussians(run.device, parameters), degree)
        with run.changing():
            run.adam, run.stats, run.metrics = None, None, {}  # which were of the earlier model
            run.model = model
            run.refresh_filter()
        change = Change(before, len(points), {self.stage: before}, {})
        run.records.add(run.step, "densify", **asdict(change))
        LOG.info("%s Gaussians from depths in the place of %s", f"{change.after:,}", f"{before:,}")

    @staticmethod
    def _drawn(run: Run, count: int) -> list[Drawn]:
        """What is drawn of each training photograph; random numbers are of the seed, the step and its place."""
        views = learned_scene(run).downscaled(run.downscale).split("train")
        painter, found, own_colors = run.painter(), list[Drawn](), color_model(run) is not None
        for number, view in enumerate(run.status.counted(views, "photographs", len(views))):
            photograph = run.photographs.get(view)
            layers = painter.layers(photograph.camera, depth=True)
            assert layers.depth is not None  # as it was asked for
            mask, own = photograph.counted(), count // len(views) + (number < count % len(views))
            alpha = np.where(layers.depth > 0, layers.alpha, 0) * (1 if mask is None else mask)
            random = np.random.default_rng([run.seed, run.step, number])
            image = to_8_bits(layers.image) if own_colors else photograph.image()
            found.append(drawn_of(view, alpha, layers.depth, image, own, random))
        return found


def drawn_of(
    view: View,
    alpha: NDArray[np.floating],
    depth: NDArray[np.floating],
    image: NDArray[np.uint8],
    count: int,
    random: np.random.Generator,
) -> Drawn:
    """Draw `count` pixels of a view by alpha, none twice, and return what lies there; all where fewer have any.

    alpha, depth: [height, width], in [0, 1] and in scene units along the axis; image: [height, width, 3].
    """
    chances = alpha.astype(np.float64).ravel()
    places = np.sort(sampling_order(chances > 0, chances, random)[:count])
    camera, (rows, columns) = view.camera, np.divmod(places, alpha.shape[1])
    z = depth[rows, columns].astype(np.float64)
    rays = np.stack(
        [(columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, np.ones(len(z))], axis=1
    )
    rotation, translation = view.world_to_camera[:, :3], view.world_to_camera[:, 3]
    pixel = z / np.sqrt(camera.fx * camera.fy)
    share = np.minimum(1, len(places) * chances[places] / (chances.sum() or 1))  # of the pixels there that are drawn
    positions = (rays * z[:, None] - translation) @ rotation
    return Drawn(positions, image[rows, columns] / 255.0, pixel, pixel / np.sqrt(share))
