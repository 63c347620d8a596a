"""Shipped recipes in few steps, without pictures and pages."""

import hashlib
import os
from pathlib import Path

from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.stretching import stretch
from clsplat.runs.state import RunState
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.optimize import Optimize
from clsplat.sweeps.experiment import run_pipeline
from clsplat.training.stage import Stage

STEPS = 24


SENSITIVE = {
    "auto": [f"stages.1.during.1.rules.{rule}.gradient_above=0.5" for rule in (0, 1)]
}  # so few steps promise little


ONE_THREAD = {"POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1", "CL_CONFIG_CPU_TBB_NUM_WORKERS": "1"}


def short(name: str, scene: Path, *overrides: str, saved: int = 4) -> Pipeline:
    """A recipe in STEPS steps, with edits every 4, a checkpoint every `saved`, without pictures and pages."""
    opaque, sensitive = "init.opacity=0.3", SENSITIVE.get(name.removesuffix("_7k"), [])  # faint ones have no time
    pipeline = load(name, [f"scene.path='{scene}'", opaque, *sensitive, *overrides])
    settings = stretch(pipeline.settings, STEPS / pipeline.settings.training.steps)
    pairs = zip(pipeline.stages, settings.stages, strict=True)
    stages = [with_frequent_edits(old, stage, saved) if isinstance(stage, Optimize) else stage for old, stage in pairs]
    kept = [stage for stage in stages if stage.stage in ("init", "optimize", "export")]
    return Pipeline(pipeline.path, settings.model_copy(update={"stages": kept}))


def with_frequent_edits(old: Stage, loop: Optimize, saved: int) -> Optimize:
    """Edits every few steps; without resets to faint, from which so few steps do not recover."""
    assert isinstance(old, Optimize)
    during = [
        stage.model_copy(
            update={
                "every": saved if stage.stage == "checkpoint" else 4,
                **({"start": 0} if stage.stage == "average" else {}),
            }
        )
        if before.every != 1 and stage.stage != "raise_sh"
        else stage
        for before, stage in zip(old.during, loop.during, strict=True)
        if not isinstance(stage, Evaluate) and getattr(stage, "value", 1) > 0.01
    ]
    return loop.model_copy(update={"during": during})


def train(pipeline: Pipeline, out: Path, resume: bool = False) -> str:
    """Train with a recipe; return the hash of its model."""
    run_pipeline(pipeline, RunState.read(out), os.environ.get("CLSPLAT_DEVICE"), "resume" if resume else "new")
    return digest(out)


def digest(out: Path) -> str:
    return hashlib.sha256(next(out.glob("point_cloud.ply")).read_bytes()).hexdigest()
