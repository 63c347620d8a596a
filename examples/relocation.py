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
    """Move faint Gaussians to opaque ones; all that share a place together keep its opacity (eqs. 8 and 9)."""

    type: Literal["relocate"] = "relocate"
    opacity_below: Positive = 0.005
    """Opacity of Gaussians that are moved; by step."""
    growth: Annotated[float, Field(ge=1)] = 1.05
    """Number of Gaussians after an edit by the number before; `max_gaussians` limits it too."""

    def mark(self, edit: Edit) -> None:
        gaussians, rows = edit.gaussians, edit.rows()
        logit, log_scales = (gaussians.get(name).astype(np.float64) for name in ("logit_opacity", "log_scales"))
        opacity = np.minimum(1 / (1 + np.exp(-logit[:, 0])), 1 - 1e-7)
        faint = opacity < edit.at(self.opacity_below)
        weights = np.where(faint | (rows != 1), 0, opacity)
        if not weights.any():
            return
        more = min(int(self.growth * len(rows)) - len(rows), np.inf if edit.room is None else edit.room)
        drawn = edit.random().multinomial(max(0, more + int(rows[faint].sum())), weights / weights.sum())
        sources, copies = np.flatnonzero(drawn), np.minimum(drawn[drawn > 0] + 1, 50)
        new = np.clip(1 - (1 - opacity[sources]) ** (1 / copies), edit.at(self.opacity_below), 1 - 1e-6)
        series = (comb(copies, j) * (-1.0) ** (j - 1) * new**j / np.sqrt(j) for j in range(1, 51))
        edit.set_rows("logit_opacity", sources, np.log(new / (1 - new))[:, None])
        edit.set_rows("log_scales", sources, log_scales[sources] + np.log(opacity[sources] / sum(series))[:, None])
        edit.zero_moments(sources)
        edit.choose(faint | (drawn > 0), copies=np.where(faint, 0, drawn + 1), kept=1)


class AddNoise(Scheduled):
    """Add noise to the means; a lower opacity gets more of it."""

    stage: Literal["add_noise"] = "add_noise"
    edits: ClassVar[bool] = True
    rate: NonNegative = 80.0
    """Noise by the scene's extent: 5e5 times the learning rate of the means; by step."""
    opacity_below: Positive = 0.005
    """Opacity at which the noise is half, in [0, 1]; by step."""

    def run(self, run: Run) -> None:
        gaussians, step = run.model.gaussians, run.step
        rate, below = at_step(self.rate, step) * run.scene.extent, at_step(self.opacity_below, step)
        tables = {name: gaussians[name] for name in ("means", "quats", "log_scales", "logit_opacity")}
        others = {"seed": run.seed, "step": step, "stride": gaussians.capacity, "count": gaussians.count}
        program = run.device.program(Path(__file__).with_suffix(".cl"))
        program.add_noise(items=gaussians.count, **tables, rate=rate, opacity_below=below, **others)
