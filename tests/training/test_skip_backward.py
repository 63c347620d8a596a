"""Steps that skip the backward pass of converged views: the rule, and the unchanged state."""

import json
import logging
import math
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from clsplat.core.errors import ConfigError
from clsplat.gaussians.structs import moment_tables
from clsplat.losses.base import ViewGradients, ViewLosses
from clsplat.opencl.device import Array
from clsplat.pipeline.loading import load
from clsplat.pipeline.stretching import stretch
from clsplat.runs import opening
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.training.modules.skip_backward import SkipBackward, SkipBackwardState
from clsplat.training.run import Run
from clsplat.training.trainer import StepTrainer
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow

SKIP = "optimize.modules.skip_backward"
FROM_5 = SKIP + "={start: 5, warm_up: 12, min_fraction: 0.25}"  # of the fifty steps of smoke, on eight photographs
HAAR = "optimize.modules.haar={learn: filter}"
PENALTY = "optimize.losses=[l1, {type: dssim, weight: 0.3}, {type: anisotropy, above: 2.0, weight: 0.01}]"
NO_EDITS = ("densify.every=1000", "raise_sh.every=1000", "reset_opacity.every=1000", "optimize.evaluate.every=1000")


# ---- the rule


def slow_rule(skip: SkipBackward, visits: list[tuple[str, float]]) -> list[bool]:
    """Which of the steps after `start` are skipped: every sum from all visits before, again at every step."""

    def converged(at: int) -> bool:
        """Return whether the loss of a step is at most the average of earlier losses of its view."""
        view, loss = visits[at]
        earlier = [value for name, value in visits[:at] if name == view]
        ages = range(len(earlier) - 1, -1, -1)
        weights = [skip.decay**age * (1 if age == len(earlier) - 1 else 1 - skip.decay) for age in ages]
        return bool(earlier) and loss <= math.fsum(w * value for w, value in zip(weights, earlier, strict=True))

    share = sum(not converged(at) for at in range(skip.warm_up)) / skip.warm_up
    least = share if skip.min_fraction == "auto" else skip.min_fraction
    skipped: list[bool] = []
    for now in range(len(visits)):
        whole = skipped.count(False)
        skipped.append(now >= skip.warm_up and converged(now) and whole >= least * (now + 1))
    return skipped


def decisions(skip: SkipBackward, visits: list[tuple[str, float]]) -> list[bool]:
    """What the rule decides, step by step, with what it keeps between them."""
    scalars: dict[str, float] = {}
    found = []
    for name, loss in visits:
        before = dict(scalars)
        visit = skip.decide(name, loss, scalars)
        assert scalars == before
        scalars.update(visit.scalars)
        found.append(visit.skipped)
    return found


def random_losses(rng: np.random.Generator, views: int, steps: int, noise: float) -> list[tuple[str, float]]:
    """Losses of views in random order, which fall and are noisy."""
    falling = np.exp(-np.arange(steps) / steps) * (1 + noise * rng.standard_normal(steps))
    return [(f"view {rng.integers(views)}", float(loss)) for loss in falling]


@pytest.mark.parametrize(
    ("views", "noise", "decay", "least"),
    [
        *((1, 0.1, 0.95, "auto"), (7, 0.02, 0.95, "auto"), (7, 0.3, 0.5, "auto"), (30, 0.1, 0.0, "auto")),
        *((7, 0.3, 0.5, 0), (7, 0.3, 0.5, 0.4), (7, 0.3, 0.5, 1), (1, 0.1, 0.95, 0.4)),
    ],
)
def test_rule_matches_plain_sums(rng, least, views, noise, decay):
    skip = SkipBackward(start=0, warm_up=40, decay=decay, min_fraction=least)
    visits = random_losses(rng, views, 160, noise)
    found = decisions(skip, visits)
    assert found == slow_rule(skip, visits)
    assert not any(found[:40])
    assert any(found) == (least != 1)


@pytest.mark.parametrize("least", [0.1, 0.9])
def test_minimum_fraction_of_full_steps_is_respected(least):
    """All steps with decreasing losses would be skipped."""
    visits = [(f"view {step % 9}", 1 / (1 + step)) for step in range(2000)]
    found = np.array(decisions(SkipBackward(start=0, warm_up=100, min_fraction=least), visits))
    whole = np.cumsum(~found) / np.arange(1, len(found) + 1)
    assert whole.min() >= least
    assert whole[-1] == pytest.approx(max(least, 100 / 2000), abs=1e-3)
    assert not decisions(SkipBackward(start=0, warm_up=9), visits)[9:].count(True), "a warm-up of first visits alone"


def test_nonfinite_loss_changes_nothing():
    skip, scalars = SkipBackward(start=0, warm_up=1, min_fraction=0), {}
    scalars.update(skip.decide("a", 1.0, scalars).scalars)
    for loss in (math.nan, math.inf):
        visit = skip.decide("a", loss, scalars)
        assert (visit.skipped, dict(visit.scalars)) == (False, {})
    assert skip.decide("a", 1.0, scalars).skipped, "a loss that is the average is not above it"


def test_view_has_an_average_per_size_and_none_before_the_start():
    state = SkipBackwardState(SkipBackward(start=8), [View("a.png", Camera(40, 30, 1, 1, 1, 1), np.eye(3, 4))])
    for step, width in ((8, 40), (9, 40), (10, 20), (11, 40)):
        camera = SimpleNamespace(width=width, height=30)
        saved: list[Any] = []
        now = SimpleNamespace(number=step, view=0, camera=camera, loss=float(step), skipped=False)
        now.save, now.saved = (
            (lambda _, visit, saved=saved: saved.append(visit)),
            (lambda _, saved=saved: (saved or [None])[0]),
        )
        state.after_losses(now)
        state.update(now)
    averages = {name: value for name, value in state.scalars.items() if name.startswith("skip/loss/")}
    expected = {"skip/loss/40x30/a.png": 0.95 * 9 + 0.05 * 11, "skip/loss/20x30/a.png": 10.0}
    assert averages == pytest.approx(expected)


# ---- the setting


@pytest.mark.parametrize("least", ["2", "-0.1", "much", "[1]", "null"])
def test_invalid_fraction_is_refused(least):
    with pytest.raises(ConfigError, match=r"skip_backward\.min_fraction=.*: expected auto, or a number from 0 to 1"):
        load(
            "smoke", ["optimize.modules.skip_backward.start=9", f"optimize.modules.skip_backward.min_fraction={least}"]
        )


def test_stretched_recipe_skips_later_with_the_same_warm_up():
    skip = stretch(load("splat_7k", ["optimize.modules.skip_backward.start=4000"]).settings, 2.0).training.modules[0]
    assert skip == SkipBackward(start=8000, decay=0.95, warm_up=500, min_fraction="auto")
    assert load("splat_7k").settings.training.modules == []


# ---- steps


def start_run(scene: Path, out: Path, *overrides: str) -> tuple[Run, Iterator[ViewLosses]]:
    """A run before its first step, and its steps."""
    checked = load("smoke", [f"scene.path='{scene}'", *overrides])
    run = opening.open_run(checked, out, None)
    checked.stages[0].run(run)
    return run, checked.stages[1].iterate(run)


def state(run: Run) -> dict[str, Any]:
    """Everything that an update changes."""
    gaussians = run.model.gaussians
    tables = {name: gaussians.get(name).tobytes() for name in gaussians.tables}
    of_filter = run.modules["haar"].scalars if "haar" in run.modules else {}
    return {**tables, "updates": dict(run.adam.updates) if run.adam else {}, **of_filter}


@pytest.mark.parametrize("more", [(), (PENALTY,), (HAAR,)], ids=["losses", "a penalty", "a filter that learns"])
def test_skipped_step_changes_nothing(tiny_scene, tmp_path, more):
    run, steps = start_run(tiny_scene, tmp_path, FROM_5, *NO_EDITS, *more)
    before, skipped = state(run), []
    for view in steps:
        after = state(run)
        skipped.append(not isinstance(view, ViewGradients))
        if skipped[-1]:
            assert after == before
            assert "anisotropy" not in [loss.name for loss in view.losses]
        else:
            changed = {name for name in after if after[name] != before.get(name)}
            assert changed >= {"means", *moment_tables("means"), "stats/seen", "stats/screen_grad", "updates"}
            assert "haar/scale" in changed or not more or more[0] != HAAR
        before = after
    assert not any(skipped[: 5 + 12])
    assert 8 < sum(skipped) <= 0.75 * 45
    assert run.adam.updates["means"] == run.step - sum(skipped) == 50 - sum(skipped)


def test_each_size_of_a_resolution_schedule_has_own_averages(tiny_scene, tmp_path):
    """Photographs are half as large up to step 19."""
    sizes = "optimize.views.resolution={points: [[0, 2], [20, 1]], between: steps}"
    run, steps = start_run(tiny_scene, tmp_path, SKIP + "={start: 2, warm_up: 40}", sizes, *NO_EDITS)
    for _ in range(36):
        next(steps)
    averages = [name.split("/")[2] for name in run.modules["skip_backward"].scalars if name.startswith("skip/loss/")]
    assert set(averages) == {"20x20", "40x40"}
    assert len(averages) > 8, "photographs"


def test_failure_after_the_decision_saves_the_previous_step(tiny_scene, tmp_path, monkeypatch):
    run, steps = start_run(tiny_scene, tmp_path, FROM_5)
    for _ in range(9):
        next(steps)
    before = state(run), dict(run.modules["skip_backward"].scalars)

    def broken(trainer: StepTrainer, view: ViewLosses) -> ViewGradients:
        raise MemoryError

    monkeypatch.setattr(StepTrainer, "backward", broken)
    with pytest.raises(MemoryError):
        next(steps)
    assert (run.step, (state(run), dict(run.modules["skip_backward"].scalars))) == (9, before)


def test_no_loss_is_read_before_the_start(tiny_scene, tmp_path, monkeypatch):
    """Reading a value waits for the device."""
    reads, get = Counter(), Array.get

    def counted(array: Array) -> Any:
        reads[name] += 1
        return get(array)

    monkeypatch.setattr(Array, "get", counted)
    for name, settings in {
        "none": (),
        "later": (f"{SKIP}.start=9",),
        "from 5": (FROM_5,),
    }.items():
        _, steps = start_run(tiny_scene, tmp_path / name, *settings, *NO_EDITS)
        for _ in range(9):
            next(steps)
    assert reads["none"] == reads["later"] == reads["from 5"] - 4 * 2, "four steps, with two losses"


# ---- runs


def test_skipping_run_resumes_bit_for_bit(tiny_scene, tmp_path, caplog):
    caplog.set_level(logging.INFO, "clsplat")
    settings = (FROM_5, "optimize.checkpoint.keep=9", "densify.stop=30")
    first = train(tiny_scene, tmp_path / "first", *settings)
    (told,) = first.records.read("skip")
    assert told["steps"] == 45
    assert told["min_fraction"] == 0.25
    assert 8 < told["skipped"] <= 0.75 * 45
    line = f"skipped {told['skipped']} of 45 steps after step 5; at least 25.0% had to be full steps"
    assert caplog.text.count(line) == 1
    whole = digest(first.out)
    again = shutil.copytree(first.out, tmp_path / "again")
    for step in (30, 40, 50):
        (again / "checkpoints" / f"step_{step:06d}.npz").unlink()
    for name in ("point_cloud.ply", "metrics.json", "checksums.json"):
        (again / name).unlink()
    resumed = train(tiny_scene, tmp_path / "again", *settings, resume=True)
    assert digest(resumed.out) == whole
    assert resumed.modules["skip_backward"].scalars == first.modules["skip_backward"].scalars
    assert resumed.records.read("skip") == [told]


def test_auto_measures_its_fraction_in_the_warm_up(tiny_scene, tmp_path):
    """Of forty steps on eight photographs, the first visits at least."""
    settings = (SKIP + "={start: 2, warm_up: 40}", "optimize.steps=80", *NO_EDITS)
    run = train(tiny_scene, tmp_path / "run", *settings)
    (told,) = run.records.read("skip")
    assert 8 / 40 <= told["min_fraction"] == run.modules["skip_backward"].scalars["skip/above"] / 40
    assert told["steps"] == 78
    assert 0 < told["skipped"] <= (1 - told["min_fraction"]) * 78


def test_skipping_changes_no_bits_before_its_start(tiny_scene, few_steps, tmp_path):
    run = train(tiny_scene, tmp_path / "run", *FEW, "optimize.modules.skip_backward.start=12")
    assert digest(run.out) == digest(few_steps)
    assert [line["steps"] for line in run.records.read("skip")] == [0]
    assert not run.modules["skip_backward"].scalars


def test_run_may_resume_with_skipping(tiny_scene, killed_run, caplog):
    run = train(
        tiny_scene,
        killed_run,
        *FEW,
        SKIP + "={start: 8, warm_up: 1, min_fraction: 0}",
        resume=True,
    )
    assert caplog.text.count("from here on, bits differ from a run without this change") == 1
    assert json.loads((killed_run / "metrics.json").read_text())["steps"] == 12
    assert run.modules["skip_backward"].scalars["skip/steps"] == 4
