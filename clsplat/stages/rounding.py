"""Tables of a model in fewer different values, which a SOG holds in fewer bytes."""

from collections.abc import Collection
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.formats.sog_steps import rounded, rounded_means, rounded_opacities, rounded_quats
from clsplat.stages.base import Stage
from clsplat.training.run import Run

Step = Annotated[float, Field(gt=0)]
Levels = Annotated[int, Field(ge=1, le=64)]


class RoundTables(Stage):
    """Round tables to steps, as a SOG then holds them in fewer bytes.

    Tables without a step stay.  Training that follows with rates of 0 for what was rounded adapts the others to it.
    """

    stage: Literal["round_tables"] = "round_tables"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})
    edits: ClassVar[bool] = True
    training_keys: ClassVar[frozenset[str]] = frozenset({"means", "quats", "log_scales", "sh_base", "opacity"})

    means: Step | None = None
    """Largest step of positions, as a share of the size (the geometric mean of three standard deviations) below which
    a quarter of the Gaussians are."""
    quats: Levels | None = None
    """Levels of 255 from one to the next; the axes of each Gaussian are named anew, so that it is turned least."""
    log_scales: Step | None = None
    """Step of the logarithms of standard deviations."""
    sh_base: Step | None = None
    """Step of the coefficients of band 0; 1 changes a colour by 0.28."""
    opacity: Levels | None = None
    """Levels of 255 from one to the next."""

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        tables = {name: gaussians.get(name) for name in self._changed()}
        if self.means:
            tables["means"] = rounded_means(tables["means"], gaussians.get("log_scales"), self.means)
        if self.quats:
            tables["quats"], tables["log_scales"] = rounded_quats(tables["quats"], tables["log_scales"], self.quats)
        if self.log_scales:
            tables["log_scales"] = rounded(tables["log_scales"], self.log_scales)
        if self.sh_base:
            tables["sh_base"] = rounded(tables["sh_base"], self.sh_base)
        if self.opacity:
            tables["logit_opacity"] = rounded_opacities(tables["logit_opacity"], self.opacity)
        for name, table in tables.items():
            gaussians.set(name, table)
        run.refresh_filter()

    def _changed(self) -> Collection[str]:
        steps = {
            "means": self.means,
            "quats": self.quats,
            "log_scales": self.log_scales or self.quats,
            "sh_base": self.sh_base,
            "logit_opacity": self.opacity,
        }
        return [name for name, step in steps.items() if step]
