"""A rehearsal ends where it tells enough, or that there is too little time."""

from types import SimpleNamespace

import pytest

import clsplat
from clsplat.core.errors import ConfigError
from clsplat.core.progress import Progress
from clsplat.pipeline.loading import load
from clsplat.pipeline.stretching import in_steps
from clsplat.runs import time_budget
from clsplat.runs.time_budget import Limit, Rehearsal


@pytest.mark.slow
def test_too_little_time_is_refused_before_the_rehearsal_ends(tiny_scene, tmp_path, monkeypatch):
    """Each report says how long the fewest steps take; what comes before them is done twice."""
    reports = []
    show = time_budget.Watch.show

    def shown(watch: time_budget.Watch, progress: Progress) -> None:
        reports.append(progress.step)
        show(watch, progress)

    monkeypatch.setattr(time_budget.Watch, "show", shown)
    with pytest.raises(
        ConfigError, match=r"expected [\d.]+ or more for this scene on this device, in which 200 steps fit"
    ):
        clsplat.run("smoke", tiny_scene, tmp_path / "run", minutes=1e-4)
    assert len(reports) <= 1
    assert not list(tmp_path.iterdir())


def watch(minutes: float, spent: dict[str, float], clock: float, monkeypatch: pytest.MonkeyPatch) -> time_budget.Watch:
    """A rehearsal that began at 0 s, when its run had `minutes`, and has spent times in stages, at a later time."""
    monkeypatch.setattr(time_budget, "time", SimpleNamespace(perf_counter=lambda: clock))
    counting = SimpleNamespace(status=SimpleNamespace(count=lambda *values: None))
    status = SimpleNamespace(seconds=spent)
    return time_budget.Watch(Limit(minutes, 60 * minutes, 200), counting, status, "optimize", began=0.0)


def reported(step: int, ms: float) -> Progress:
    return Progress(step, 200, 0.0, 0.0, 0, ms, seconds_left=0.0)


def test_refusal_comes_by_the_second_report_that_shows_it(monkeypatch):
    """Set-up takes 4 s, and 20 steps 2 s: at 6 s the run needs 4 s more, and 20 s for 200 steps.  The first report may
    be of a step that builds kernels."""
    for given in (0.5, 0.4):
        at_work = watch(given, {"init": 4.0}, 6.0, monkeypatch)
        at_work.show(reported(10, 5000.0))
        if given == 0.5:
            at_work.show(reported(20, 100.0))
    with pytest.raises(ConfigError, match=r"--minutes 0\.4: expected 0\.5 or more"):
        at_work.show(reported(20, 100.0))


def test_setup_that_takes_more_than_half_the_time_is_refused(monkeypatch):
    watch(0.5, {"init": 14.9}, 15.0, monkeypatch).look()
    with pytest.raises(ConfigError, match=r"expected 0\.6 or more"):
        watch(0.5, {"init": 15.1}, 15.2, monkeypatch).look()


@pytest.mark.parametrize("clock", [15.9, 16.1])
def test_the_steps_of_a_rehearsal_end_after_a_fifth_of_the_time(clock, monkeypatch):
    at_work = watch(1.0, {"init": 3.0, "densify": 1.0}, clock, monkeypatch)
    at_work.show(reported(10, 100.0))
    at_work.show(reported(20, 100.0))
    if clock < 16:
        at_work.show(reported(30, 100.0))
        return
    with pytest.raises(time_budget._Enough):
        at_work.show(reported(30, 100.0))


@pytest.mark.slow
def test_stopped_rehearsal_runs_the_other_stages_and_continues(tiny_scene, tmp_path, monkeypatch):
    """It is not known when its growth ends: the number is corrected twice.  Edits that did not come are counted."""
    found: list[Rehearsal] = []

    def stop(rehearsals: list[Rehearsal], seconds: float) -> int:
        found.extend(rehearsals)
        raise ConfigError("seen")

    monkeypatch.setattr(time_budget, "LONGEST", 0.0)
    monkeypatch.setattr(time_budget, "SHARE", 1e-9)  # one rehearsal, however fast the machine is
    monkeypatch.setattr(time_budget, "FIRST", 10)
    monkeypatch.setattr(time_budget, "most_steps", stop)
    with pytest.raises(ConfigError, match="seen"):
        clsplat.run("smoke", tiny_scene, tmp_path / "run", minutes=1.0)
    (rehearsal,) = found
    assert (rehearsal.steps, len(rehearsal.course), rehearsal.growth) == (10, 10, 1.0)
    assert len({*rehearsal.course[2:]}) == 1
    assert rehearsal.after > 0
    assert rehearsal.known == time_budget.TWICE


def test_edits_that_did_not_come_are_counted():
    """In 200 steps of splat the 144 edits of growth fall on 96, and half of them come in the first 50."""
    full = load("splat").settings.training
    short = in_steps(load("splat").settings, 200).training
    assert time_budget._times("densify", full, short, 200) == 144 / 96
    assert time_budget._times("densify", full, short, 50) == 144 / 47
    assert time_budget._times("init", full, short, 200) == 1
    noisy, brief = load("mcmc_7k").settings, in_steps(load("mcmc_7k").settings, 200).training
    assert time_budget._times("add_noise", noisy.training, brief, 200) == 1
