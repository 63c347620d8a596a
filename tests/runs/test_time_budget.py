"""Runs with a time limit: the chosen number of steps, and the bits of the resulting pipeline."""

import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import clsplat
from clsplat.core.errors import ConfigError, Interrupted
from clsplat.core.progress import Progress
from clsplat.pipeline.loading import Pipeline, load
from clsplat.runs import time_budget
from clsplat.runs.time_budget import Rehearsal
from clsplat.sweeps import experiment
from clsplat.training.run import Run
from tests.support.runs import digest


def test_steps_follow_from_a_rehearsal():
    rehearsal = Rehearsal(200, [0.01, 0.03], overhead=3.0, after=2.0)
    assert rehearsal.steps_in(25.0) == 1000
    assert rehearsal.steps_in(4.0) == 0
    assert replace(rehearsal, trend=0.5).steps_in(5 + 600 * 0.02 * 3**0.5) == pytest.approx(600, abs=1)
    assert rehearsal.later_step_times(0.2) == (2, 3)
    assert rehearsal.later_step_times(0.99) == (1, 1)


@pytest.mark.parametrize("minutes", [2.0, 10.0, 60.0])
@pytest.mark.parametrize(("growth", "until_share"), [(0.0, 0.5), (3.0, 0.5), (3.0, 0.9), (30.0, 0.5)])
def test_run_takes_the_given_time(monkeypatch, minutes, growth, until_share):
    """By a made-up clock: steps take longer as Gaussians grow, more in a long training run than in a rehearsal."""
    clock, done, planned = [0.0], [0], list[int]()

    def cost(step: int, steps: int) -> float:
        return 0.01 * (1 + growth * (steps / 7000) ** 0.4 * min(1, step / steps / until_share))

    def rehearse(pipeline: Pipeline, run: Run, steps: int, *given: float) -> Rehearsal:
        course = [cost(step, steps) for step in range(0, steps, steps // 20)]
        clock[0] += 3 + 2 + steps * sum(course) / len(course)
        return Rehearsal(steps, course, overhead=3.0, after=2.0)

    def execute(pipeline: Pipeline, run: Run, start: str, show: time_budget.Show) -> None:
        steps = pipeline.settings.training.steps
        planned.append(steps)
        assert start == ("new" if len(planned) == 1 else "resume")
        while done[0] < steps:
            done[0] += 1
            now = cost(done[0], planned[0])
            clock[0] += now + 3 / planned[0]
            if done[0] % pipeline.settings.training.log_every == 0 or done[0] == steps:
                show(Progress(done[0], steps, 0.0, 0.0, 0, 1e3 * now, seconds_left=1.0))
            if run.interrupted:
                raise Interrupted("")
        clock[0] += 2

    monkeypatch.setattr(time_budget, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(time_budget, "rehearse", rehearse)
    monkeypatch.setattr(time_budget, "new_run", lambda *given: SimpleNamespace(interrupted=False))
    monkeypatch.setattr(time_budget, "write_pipeline", lambda *given: None)
    monkeypatch.setattr(time_budget, "check_run", lambda *given: None)
    time_budget.execute_within(minutes, load("splat_7k"), SimpleNamespace(), "new", lambda progress: None, execute)
    assert clock[0] == pytest.approx(60 * minutes, rel=0.05)
    assert len(planned) == 1 + len(time_budget.CORRECTIONS)
    assert done[0] == planned[-1]


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """One rehearsal in 10 steps, after which 60 fit, whatever the clock says."""

    def rehearse(pipeline: Pipeline, run: Run, *given: float) -> Rehearsal:
        return time_budget.rehearse(pipeline, run, 10, math.inf, math.inf)

    monkeypatch.setattr(time_budget, "rehearse_enough", rehearse)
    monkeypatch.setattr(time_budget, "STEPS", 10)
    monkeypatch.setattr(Rehearsal, "steps_in", lambda *given: 60)


@pytest.mark.slow
def test_run_in_minutes_has_the_bits_of_its_pipeline(tiny_scene, tmp_path, monkeypatch, few):
    """Its steps are corrected while it trains; it is stopped after a correction and goes on by no clock."""
    execute = experiment.runner.execute

    def stop(pipeline: Pipeline, run: Run, start: str, show: time_budget.Show) -> None:
        def shown(progress: Progress) -> None:
            show(progress)
            run.interrupted |= start == "resume" and progress.step >= progress.steps - 10

        execute(pipeline, run, start, shown)

    out = tmp_path / "run"
    monkeypatch.setattr(experiment.runner, "execute", stop)
    with pytest.raises(Interrupted):
        clsplat.run("smoke", tiny_scene, out, minutes=0.05)
    monkeypatch.setattr(experiment.runner, "execute", execute)
    text = (out / "pipeline.yaml").read_text()
    steps, known = re.search(r"# --minutes 0\.05: ([\d,]+) steps, corrected at step ([\d,]+)", text).groups()
    known, steps = (int(number.replace(",", "")) for number in (known, steps))
    assert known < steps == load(str(out / "pipeline.yaml")).settings.training.steps
    clsplat.resume(out)
    assert (out / "pipeline.yaml").read_text().endswith(text[text.index("\nname: ") :])
    assert "from here on the bits" not in (out / "log.txt").read_text()
    assert not (out / "rehearsal").exists()
    again = clsplat.run(out / "pipeline.yaml", out=tmp_path / "again")
    assert digest(out) == digest(again)
    assert clsplat.check(out)["whole"]


@pytest.mark.slow
def test_run_killed_at_a_correction_keeps_the_chosen_steps(tiny_scene, tmp_path, monkeypatch, few):
    """The pipeline is written before the checkpoint, which is of the corrected one."""
    execute = experiment.runner.execute

    def die(pipeline: Pipeline, run: Run, start: str, show: time_budget.Show) -> None:
        if start == "resume":
            raise KeyboardInterrupt
        execute(pipeline, run, start, show)

    monkeypatch.setattr(experiment.runner, "execute", die)
    with pytest.raises(Interrupted):
        clsplat.run("smoke", tiny_scene, tmp_path / "run", minutes=0.05)
    monkeypatch.setattr(experiment.runner, "execute", execute)
    steps = load(str(tmp_path / "run" / "pipeline.yaml")).settings.training.steps
    clsplat.resume(tmp_path / "run")
    assert "from here on the bits" not in (tmp_path / "run" / "log.txt").read_text()
    assert clsplat.status(tmp_path / "run")["step"] == steps


@pytest.mark.slow
def test_too_long_rehearsal_is_shortened(tiny_scene, tmp_path, monkeypatch, few):
    """What follows them is rehearsed all the same; the rest is taken to be like the last."""
    results: list[Rehearsal] = []

    def seen(rehearsal: Rehearsal, seconds: float) -> int:
        results.append(rehearsal)
        return 0

    brief = lambda pipeline, run, *given: time_budget.rehearse(pipeline, run, 10, 0.0, math.inf)  # noqa: E731
    monkeypatch.setattr(time_budget, "rehearse_enough", brief)
    monkeypatch.setattr(Rehearsal, "steps_in", seen)
    with pytest.raises(ConfigError, match="too short"):
        clsplat.run("smoke", tiny_scene, tmp_path / "run", minutes=1.0)
    (rehearsal,) = results
    assert len(rehearsal.step_times) == 10
    assert len({*rehearsal.step_times[2:]}) == 1
    assert rehearsal.after > 0


@pytest.mark.slow
def test_too_few_minutes_are_refused_in_the_rehearsal(tiny_scene, tmp_path, few_steps):
    """A run that is done stays so, and a new one leaves nothing."""
    told = r"--minutes 1e-06: too short for the minimum of 200 steps on this device; use more minutes"
    with pytest.raises(ConfigError, match=told):
        clsplat.run("smoke", tiny_scene, tmp_path / "new", minutes=1e-6)
    assert not list(tmp_path.iterdir())
    out = clsplat.run("smoke", tiny_scene, tmp_path / "run", set={"optimize.steps": 2})
    with pytest.raises(ConfigError, match="too short"):
        clsplat.run("smoke", tiny_scene, out, start="restart", minutes=1e-6)
    assert clsplat.status(out)["state"] == "done"
    assert clsplat.check(out)["whole"]


def test_training_keeps_enough_steps_to_separate_edits():
    assert time_budget.min_training_steps(load("splat")) == 300
    assert time_budget.min_training_steps(load("mip_nerf")) == 20


def test_impossible_time_budget_is_refused(tiny_scene, tmp_path, few_steps):
    with pytest.raises(ConfigError, match="omit it to continue"):
        clsplat.run(few_steps / "pipeline.yaml", out=few_steps, start="resume", minutes=1)
    with pytest.raises(ConfigError, match="for a matrix, set"):
        clsplat.run(Path("examples/growth.yaml").absolute(), tiny_scene, tmp_path / "m", minutes=1)
    with pytest.raises(ConfigError, match="found 3"):
        clsplat.run("compress", tiny_scene, tmp_path / "c", set={"init.file": few_steps / "point_cloud.ply"}, minutes=1)
    refit = {"optimize.keep": "best", "scene.validation": "auto", "optimize.refit": True}
    with pytest.raises(ConfigError, match=r"add --set optimize\.refit=false"):
        clsplat.run("smoke", tiny_scene, tmp_path / "r", set=refit, minutes=1)
    for wrong in (0, -1, math.nan, math.inf):
        with pytest.raises(ConfigError, match="--minutes"):
            clsplat.run("smoke", tiny_scene, tmp_path / "w", minutes=wrong)
    assert not list(tmp_path.iterdir())
