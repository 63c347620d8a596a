"""Decay opacities between steps, as in Binocular3DGS (Han et al. 2024)."""

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator

from clsplat.core.schedule import Bounded, Positive, at_step
from clsplat.gaussians.gaussians import Gaussians
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled


class DecayOpacity(Scheduled):
    """Lower all opacities slightly, instead of a reset; training raises those of needed Gaussians (Binocular3DGS, Han
    et al. 2024).

    The published factor is 0.995 per step, for 3 to 8 images.  Ours applies to a pass over the training images, because
    with more images, a Gaussian is seen in a smaller fraction of steps.
    """

    stage: Literal["decay_opacity"] = "decay_opacity"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"per_pass"})

    per_pass: Annotated[Positive, AfterValidator(Bounded(0, maximum=1))] = 0.975
    """Factor on the opacities over as many steps as there are training images; 1 changes nothing."""

    def run(self, run: Run) -> None:
        factor = at_step(self.per_pass, run.step) ** ((self.every or 1) / len(run.scene.split("train")))
        if factor < 1:
            decay_opacity(run.model.gaussians, factor)


def decay_opacity(gaussians: Gaussians, factor: float) -> None:
    """Multiply all opacities by a factor in (0, 1)."""
    gaussians.device.program("density.cl").decay_opacity(
        items=gaussians.count,
        logit_opacity=gaussians["logit_opacity"],
        fall=1 - factor,
        count=gaussians.count,
    )
