"""Settings that follow from the photographs (`adapt:`): a class looks at what is measured, and decides with reasons."""

import json
from abc import abstractmethod
from collections.abc import Iterator
from typing import Any, ClassVar, Literal

from pydantic import Field

from clsplat.core.errors import pluralize
from clsplat.core.settings import Settings
from clsplat.scene.quality import Measures
from clsplat.stages.densify import Densify
from clsplat.stages.optimize import Optimize


class Decision(Settings):
    """A setting that follows from the photographs."""

    key: str
    """Place of the setting, as in `--set`: a key of the model or of a stage."""
    value: Any
    """Its value, as in `--set`; null too."""
    reason: str
    """What was measured, and why the value follows."""

    @property
    def override(self) -> str:
        """KEY=VALUE, as in `--set`."""
        return f"{self.key}={json.dumps(self.value)}"

    @property
    def text(self) -> str:
        """The setting and its reason."""
        return f"{self.override}, since {self.reason}"


class Adaptation(Settings):
    """Decides settings by the photographs, before the first step of a run."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"decisions"})

    type: str
    keep: list[str] = Field([])
    """Keys that are not decided; `--set` of a key adds it here."""
    decisions: list[Decision] | None = None
    """Written by a run: what was decided.  A run that has some decides no more."""

    @abstractmethod
    def decide(self, training: Optimize, measures: Measures) -> Iterator[Decision]:
        """Yield a decision for each key: the same keys whatever the measures are, keys of the model or of stages.

        training: the first stage that trains Gaussians.  They are validated like `--set`.
        """

    def keys(self, training: Optimize) -> list[str]:
        """Return the keys that it decides."""
        return [one.key for one in self.decide(training, Measures(0))]


FEW = 40  # training photographs; a model learns fewer by heart
FEWEST_FOR_SKY = 12  # training photographs; fewer show too little of what is far away
MOST = ((0.5, 0.1), (0.25, 0.3), (0.0, 0.6))  # from a share of photographs with sky on: Gaussians per pixel, at most
POSES_FROM = 1.0  # px of mean reprojection error at the size of training
STEPS = 3400  # of `photos`, by which the steps below are counted
DROPOUT_UNTIL, POSES_START = 1460, 500


class Photos(Adaptation):
    """Decides for folders of photographs.  Fewer than 40: dropout, fewer Gaussians, perhaps a sky.  Cameras that miss
    the points by a pixel: poses are learned."""

    type: Literal["photos"] = "photos"

    def decide(self, training: Optimize, measures: Measures) -> Iterator[Decision]:
        count, few = measures.photographs, measures.photographs < FEW
        counted = pluralize(count, "training photograph")
        hull = "few leave too large a hull" if few else "many leave a small hull"
        why = f"{counted}; of transparent photographs, the silhouettes of {hull}"
        yield Decision(key="init.transparent", value="random" if few else "hull", reason=why)
        yield Decision(key="init.count", value=100_000 if few else 60_000, reason=why)

        why = f"{counted}; {'few are' if few else 'so many are not'} learned by heart"
        dropout = {"probability": [[0, 0.0], [DROPOUT_UNTIL * training.steps // STEPS, 0.2]]} if few else None
        yield Decision(key="optimize.modules.dropout", value=dropout, reason=why)
        drawn = {"where": "transparent"} if few else None
        yield Decision(key="optimize.modules.random_background", value=drawn, reason=why)

        first = next((i for i, stage in enumerate(training.during) if isinstance(stage, Densify)), 0)
        most, why = _most_per_pixel(measures) if few else (None, "so many hold up as many Gaussians as grow")
        yield Decision(key=f"optimize.during.{first}.per_pixel", value=most, reason=f"{counted}; {why}")

        sky = {"type": "auto", "photographs": 0.25} if FEWEST_FOR_SKY <= count < FEW else None
        why = "what is far away is seen by few, and hangs near the cameras of others"
        if not sky:
            why = "too few for what is far away" if few else "so many show what is far away"
        yield Decision(key="model.background", value=sky, reason=f"{counted}; {why}")

        error = measures.reprojection_error
        miss = error is not None and error >= POSES_FROM
        why = "cameras are good to a pixel, and colors cost more PSNR than exposures that differ little"
        if miss:
            why = "cameras miss what photographs show, and exposures that differ would pull at them"
        px = "the dataset has no reprojection error" if error is None else f"{error:,.4g} px of mean reprojection error"
        poses = {"start": POSES_START * training.steps // STEPS} if miss else None
        yield Decision(key="optimize.modules.camera_optimizer", value=poses, reason=f"{px}; {why}")
        exposure = {"when": "auto"} if miss else {"when": "auto", "above": 0.2}
        yield Decision(key="optimize.modules.exposure", value=exposure, reason=f"{px}; {why}")


def _most_per_pixel(measures: Measures) -> tuple[float, str]:
    """How many Gaussians few photographs hold up, per pixel of one, and why."""
    sky = measures.sky
    most = next(most for share, most in MOST if (sky or 0.0) >= share)
    seen = "the dataset does not say whether they show a sky" if sky is None else f"{sky:.0%} of them show a sky"
    return most, f"{seen}; few hold up few Gaussians{', fewer far away' if most < MOST[-1][1] else ''}"
