"""Choose settings based on the photos (`adapt:`).  Classes decide from measurements, and explain their decisions."""

import json
from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Literal

from pydantic import Field

from clsplat.core.errors import pluralize
from clsplat.core.settings import Settings
from clsplat.scene.quality import Measures, is_transparent
from clsplat.stages.optimize import Optimize


class Decision(Settings):
    """A setting that was chosen from the photos."""

    key: str
    """Key of the setting, as in `--set`, in the model or a stage."""
    value: Any
    """Its value, as in `--set`; may be null."""
    reason: str
    """The measurement and its consequence, in one sentence."""
    matters: bool = True
    """Whether the decision changes this run; only then is the reason logged."""

    @property
    def override(self) -> str:
        """The decision in the form KEY=VALUE, as for `--set`."""
        return f"{self.key}={json.dumps(self.value)}"


class Adaptation(Settings):
    """Decide settings based on the photos, before the first step of a run."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"decisions"})

    type: str
    keep: list[str] = Field([])
    """Keys for which no decision is made; `--set KEY=VALUE` adds KEY."""
    decisions: list[Decision] | None = None
    """Decisions, written by a run.  A run with decisions does not make new ones."""

    @abstractmethod
    def decide(self, training: Optimize, measures: Measures) -> Iterator[Decision]:
        """Yield a decision for each key.  Decisions are validated like `--set`.

        The keys must belong to the model or to a stage, and must not depend on `measures`.
        training: the first stage that trains Gaussians.
        """

    def keys(self, training: Optimize) -> list[str]:
        """Return the keys of all decisions, which are the same for all photos."""
        return [decision.key for decision in self.decide(training, Measures(0))]


FEW_PHOTOS = 40  # training photos; the hull of fewer silhouettes is too large
DROPOUT = 0.25  # probability, multiplied by 1 - photos / FEW_PHOTOS
MAX_DROPOUT = 0.2  # largest probability
DROPOUT_UNTIL = 1460 / 3400  # fraction of the training steps over which the probability rises
MIN_PHOTOS_FOR_SKY = 12  # training photos; fewer show too little of the background
MAX_ERROR = 1.0  # px, mean reprojection error at the training size; poses are optimized if it is this large
POSES_START = 500 / 3400  # fraction of the training steps after which poses are optimized


class Photos(Adaptation):
    """Decide settings for folders of photos: a sky if they show one, optimized poses if the reprojection error is a
    pixel or more, and a random start and dropout for fewer than 40 photos with transparency."""

    type: Literal["photos"] = "photos"

    def decide(self, training: Optimize, measures: Measures) -> Iterator[Decision]:
        is_small = measures.photograph_count < FEW_PHOTOS
        count = pluralize(measures.photograph_count, "training photo")
        has_alpha = measures.scene is not None and is_transparent(measures.scene)
        lacks_points = measures.scene is not None and measures.scene.points is None

        reason = "the hull of few silhouettes is too large, so points start at random"
        reason = f"{count}: {reason if is_small else 'points start in the hull of the silhouettes'}"
        yield Decision(
            key="init.transparent",
            value="random" if is_small else "hull",
            reason=reason,
            matters=has_alpha and lacks_points,
        )
        yield Decision(key="init.count", value=100_000 if is_small else 60_000, reason=reason, matters=False)

        probability = min(MAX_DROPOUT, round(DROPOUT * (1 - measures.photograph_count / FEW_PHOTOS), 3))
        rise = [[0, 0.0], [round(DROPOUT_UNTIL * training.steps), probability]]
        dropout = {"probability": rise} if is_small and has_alpha else None
        reason = f"{count} {'with' if has_alpha else 'without'} transparency: {'' if dropout else 'no '}dropout"
        yield Decision(key="optimize.modules.dropout", value=dropout, reason=reason, matters=dropout is not None)
        random_background = {"when": "transparent"} if is_small else None
        reason = f"{count}: {'random' if is_small else 'no random'} colors behind transparent pixels"
        yield Decision(
            key="optimize.modules.random_background",
            value=random_background,
            reason=reason,
            matters=is_small and has_alpha,
        )

        # The modules log what they choose for the sky and for exposures.
        sky = {"type": "auto"} if measures.photograph_count >= MIN_PHOTOS_FOR_SKY else None
        reason = "a sky, if they show one" if sky else "too few for a sky"
        yield Decision(key="model.background", value=sky, reason=f"{count}: {reason}", matters=False)

        error = measures.reprojection_error
        is_large = error is not None and error >= MAX_ERROR
        fit = "the reprojection error is unknown" if error is None else f"cameras fit the points to {error:,.4g} px"
        poses = {"start": round(POSES_START * training.steps)} if is_large else None
        reason = f"{fit}: poses {'are optimized' if is_large else 'stay as they are'}"
        yield Decision(key="optimize.modules.camera_optimizer", value=poses, reason=reason, matters=error is not None)
        exposure = {"when": "auto"} if is_large else {"when": "auto", "min_spread": 0.2}
        reason = f"{fit}: {'small' if is_large else 'only large'} differences of exposure are corrected"
        yield Decision(key="optimize.modules.exposure", value=exposure, reason=reason, matters=False)
