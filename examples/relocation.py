"""Relocation and noise of 3DGS-MCMC (Kheradmand et al. 2024), as a density rule and a stage of `during`."""

from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field
from scipy.special import comb

from clsplat.density.edit import Edit, Rule
from clsplat.schedule import NonNegative, Positive, at_step
from clsplat.stages.base import Scheduled
from clsplat.training.run import Run


class Relocate(Rule):
    """Move faint Gaussians to opaque ones: those share their place, and together look as before (eqs. 8 and 9)."""

    type: Literal["relocate"] = "relocate"
    opacity_below: Positive = 0.005
    """Opacity of Gaussians that are moved; by step."""
    growth: Annotated[float, Field(ge=1)] = 1.05
    """Number of Gaussians after an edit, by the number before."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        logit, log_scales = (gaussians.get(name).astype(np.float64) for name in ("logit_opacity", "log_scales"))
        opacity = 1 / (1 + np.exp(-logit[:, 0]))
        alive = opacity >= edit.at(self.opacity_below)
        if not alive.any():
            return
        fresh = int(self.growth * len(alive)) - int(alive.sum())
        drawn = edit.random().multinomial(fresh, np.where(alive, opacity, 0) / opacity[alive].sum())
        sources = np.flatnonzero(drawn)
        copies = np.minimum(drawn[sources] + 1, 50)
        new = np.clip(1 - (1 - opacity[sources]) ** (1 / copies), edit.at(self.opacity_below), 1 - 1e-6)
        terms = [
            comb(copies, j) * (-1.0) ** (j - 1) * new**j / np.sqrt(j) for j in range(1, int(copies.max(initial=1)) + 1)
        ]
        edit.set_rows("logit_opacity", sources, np.log(new / (1 - new))[:, None])
        edit.set_rows("log_scales", sources, log_scales[sources] + np.log(opacity[sources] / sum(terms))[:, None])
        edit.zero_moments(sources)
        edit.choose(~alive, copies=0, kept=0)
        edit.choose(drawn > 0, copies=drawn + 1, kept=1)


class AddNoise(Scheduled):
    """Let faint Gaussians wander."""

    stage: Literal["add_noise"] = "add_noise"
    edits: ClassVar[bool] = True
    rate: NonNegative = 80.0
    """Noise by the scene's extent: 5e5 times the learning rate of the means; by step."""

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        rate = at_step(self.rate, run.step) * run.scene.extent
        tables = {name: gaussians[name] for name in ("means", "quats", "log_scales", "logit_opacity")}
        size = {"stride": gaussians.capacity, "count": gaussians.count}
        program = run.device.program(Path(__file__).with_suffix(".cl"))
        program.add_noise(items=gaussians.count, **tables, rate=rate, seed=run.seed, step=run.step, **size)
