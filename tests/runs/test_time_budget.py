"""A run in a given time: how many steps are chosen, and that the bits are those of its pipeline."""

import hashlib
import json
import math
import re
from contextlib import nullcontext
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import pytest

import clsplat
from clsplat.core.errors import ConfigError, Interrupted
from clsplat.core.progress import Progress
from clsplat.pipeline.loading import Pipeline, load
from clsplat.runs import time_budget
from clsplat.runs.time_budget import Limit, Rehearsal, most_steps, pipeline_for, predicted
from clsplat.sweeps import experiment
from clsplat.training.run import Run


def rehearsal(steps: int, step: float) -> Rehearsal:
    return Rehearsal(steps, [step], during=3.0, after=2.0, growth=0.5)


def digest(out: Path) -> str:
    return hashlib.sha256((out / "point_cloud.ply").read_bytes()).hexdigest()


def test_one_rehearsal_is_continued_evenly():
    assert predicted([rehearsal(200, 0.02)], 3000) == pytest.approx(5 + 3000 * 0.02)


def test_two_rehearsals_tell_how_the_time_of_a_step_grows():
    found = [rehearsal(200, 0.02), rehearsal(600, 0.02 * 3**0.25)]
    assert predicted(found, 1800) == pytest.approx(5 + 1800 * 0.02 * 9**0.25)


@pytest.mark.parametrize(("later", "power"), [(0.2, time_budget.TREND), (0.002, -time_budget.TREND)])
def test_disturbed_rehearsal_claims_no_more_than_it_can(later, power):
    found = [rehearsal(200, 0.02), rehearsal(600, later)]
    assert predicted(found, 1200) == pytest.approx(5 + 1200 * later * 2**power)


@pytest.mark.parametrize("seconds", [9.0, 60.0, 1234.5])
def test_as_many_steps_are_chosen_as_fit(seconds):
    found = [rehearsal(200, 0.02), rehearsal(600, 0.023)]
    steps = most_steps(found, seconds)
    assert predicted(found, steps) <= seconds < predicted(found, steps + 1)


def test_too_little_time_is_refused_with_what_would_do():
    """200 steps take 5 + 4 s, and 60 have gone."""
    with pytest.raises(ConfigError, match=r"expected 1\.2 or more"):
        pipeline_for(load("splat_7k"), [rehearsal(200, 0.02)], seconds=0.0, minutes=1.0)


def test_short_training_reports_often_enough_to_be_corrected():
    training = pipeline_for(load("splat_7k"), [rehearsal(200, 0.01)], seconds=8.0, minutes=1.0).settings.training
    assert training.steps < 400
    assert training.log_every <= 0.05 * training.steps + 1


def test_choice_stretches_every_schedule_and_gives_its_reason():
    found = pipeline_for(load("splat_7k"), [rehearsal(200, 0.01)], seconds=40.0, minutes=1.0)
    training = found.settings.training
    assert training.steps == 3500
    assert [stage.every for stage in training.during[:2]] == [500, 50]
    assert found.reason == (
        "--minutes 1: 3,500 steps in the place of 7,000, which take about 0.7 minutes more, by a rehearsal in 200 steps"
    )


def test_less_than_a_quarter_of_the_steps_is_warned_of(caplog):
    """All 7 000 steps take 5 + 70 s, and some 22 of 60 s are left."""
    pipeline_for(load("splat_7k"), [rehearsal(200, 0.01)], seconds=22.6, minutes=1.0)
    assert "coarse" not in caplog.text
    pipeline_for(load("splat_7k"), [rehearsal(200, 0.01)], seconds=22.455, minutes=1.0)
    assert "1,745 of 7,000 steps make a coarse model: for all of them give --minutes 2" in caplog.text


@pytest.mark.parametrize(
    ("growth", "given", "until_share"),
    [
        *((0.0, 2.0, 0.5), (0.0, 10.0, 0.9), (0.0, 60.0, 0.5), (3.0, 2.0, 0.9), (3.0, 10.0, 0.5)),
        *((3.0, 60.0, 0.9), (30.0, 2.0, 0.5), (30.0, 10.0, 0.9), (30.0, 60.0, 0.9)),
    ],
)
def test_it_takes_the_time_that_was_given(monkeypatch, given, growth, until_share):
    """By a made-up clock: steps take longer as Gaussians grow, in long trainings more than in a rehearsal."""
    clock, done = [0.0], [0]

    def cost(step: int, planned: int) -> float:
        return 0.01 * (1 + growth * (planned / 7000) ** 0.4 * min(1, step / planned / until_share))

    def rehearse(pipeline: Pipeline, run: Run, factor: Fraction, limit: Limit) -> Rehearsal:
        steps = round(7000 * factor)
        course = [cost(step, steps) for step in range(0, steps, steps // 20)]
        clock[0] += 3 + 2 + steps * sum(course) / len(course)
        return Rehearsal(steps, course, during=3.0, after=2.0, growth=until_share)

    def execute(pipeline: Pipeline, run: Run, start: str, show: time_budget.Show) -> None:
        steps = pipeline.settings.training.steps
        planned.append(steps)
        assert start == ("new" if len(planned) == 1 else "resume")
        while done[0] < steps:
            done[0] += 1
            now = cost(done[0], planned[0])
            clock[0] += now + 3 / planned[0]
            if done[0] % 100 == 0 or done[0] == steps:
                show(Progress(done[0], steps, 0.0, 0.0, 0, 1e3 * now, seconds_left=2 * now * steps))
            if run.interrupted:
                raise Interrupted("")
        clock[0] += 2

    planned: list[int] = []
    monkeypatch.setattr(time_budget, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(time_budget, "rehearse", rehearse)
    monkeypatch.setattr(time_budget, "new_run", lambda *given: SimpleNamespace(interrupted=False))
    monkeypatch.setattr(time_budget, "write_pipeline", lambda *given: None)
    monkeypatch.setattr(time_budget, "check_in", lambda *given: None)
    run = SimpleNamespace(status=SimpleNamespace(stage=lambda name: nullcontext(), note=lambda **values: None))
    time_budget.execute_within(given, load("splat_7k"), run, "new", lambda progress: None, execute)
    assert clock[0] == pytest.approx(60 * given, rel=0.05)
    assert len(planned) == (2 if until_share == 0.5 else 3)
    assert done[0] == planned[-1]


@pytest.fixture
def short_rehearsals(monkeypatch):
    monkeypatch.setattr(time_budget, "FIRST", 10)
    monkeypatch.setattr(time_budget, "SHARE", 0.0)
    limit = Limit(1.0, math.inf, 1)
    monkeypatch.setattr(
        time_budget, "rehearsals_of", lambda *given: [time_budget.rehearse(*given[:2], Fraction(1, 5), limit)]
    )


@pytest.mark.slow
def test_run_in_minutes_has_the_bits_of_its_written_pipeline(tiny_scene, tmp_path, monkeypatch, short_rehearsals):
    """The steps are corrected while it trains, wherever the clock stands, and not again where it is stopped later and
    goes on; files of the rehearsal are gone."""
    monkeypatch.setattr(time_budget, "most_steps", lambda *given: 60)

    def stop(checked: Pipeline, run: Run, start: str, show: time_budget.Show) -> None:
        def shown(progress: Progress) -> None:
            show(progress)
            run.interrupted |= start == "resume" and progress.step >= progress.steps - 10

        execute(checked, run, start, shown)

    execute = experiment.runner.execute
    monkeypatch.setattr(experiment.runner, "execute", stop)
    out = tmp_path / "run"
    with pytest.raises(Interrupted):
        clsplat.run("smoke", tiny_scene, out, minutes=0.05)
    monkeypatch.setattr(experiment.runner, "execute", execute)
    text = (out / "pipeline.yaml").read_text()
    steps, known = re.search(r"# --minutes 0.05: (.+) steps, of which ([\d,]+) had shown what one takes", text).groups()
    steps, known = (int(number.replace(",", "")) for number in (steps, known))
    assert known < steps == load(str(out / "pipeline.yaml")).settings.training.steps
    clsplat.resume(out)
    assert [line for line in (out / "pipeline.yaml").read_text().splitlines() if line[0] != "#"] == [
        line for line in text.splitlines() if line[0] != "#"
    ]
    assert "from here on the bits" not in (out / "log.txt").read_text()
    again = clsplat.run(out / "pipeline.yaml", out=tmp_path / "again")
    assert digest(out) == digest(again)
    assert clsplat.check(out)["whole"]


@pytest.mark.slow
def test_run_that_dies_at_the_correction_keeps_what_was_chosen(tiny_scene, tmp_path, monkeypatch, short_rehearsals):
    """The pipeline is written before the checkpoint, which is of the corrected one."""
    monkeypatch.setattr(time_budget, "most_steps", lambda *given: 50)

    def die(checked: Pipeline, run: Run, start: str, show: time_budget.Show) -> None:
        if start == "resume":
            raise KeyboardInterrupt
        execute(checked, run, start, show)

    execute = experiment.runner.execute
    monkeypatch.setattr(experiment.runner, "execute", die)
    with pytest.raises(Interrupted):
        clsplat.run("smoke", tiny_scene, tmp_path / "run", minutes=0.2)
    monkeypatch.undo()
    out = tmp_path / "run"
    steps = load(str(out / "pipeline.yaml")).settings.training.steps
    assert "had shown what one takes" in (out / "pipeline.yaml").read_text()
    clsplat.resume(out)
    assert "from here on the bits" not in (out / "log.txt").read_text()
    assert json.loads((out / "metrics.json").read_text())["steps"] == steps


@pytest.mark.slow
def test_a_refused_beginning_leaves_a_run_that_is_done_done(tiny_scene, tmp_path):
    out = clsplat.run("smoke", tiny_scene, tmp_path / "run", set={"optimize.steps": 2})
    with pytest.raises(ConfigError, match="expected"):
        clsplat.run("smoke", tiny_scene, out, start="restart", minutes=1e-6)
    assert clsplat.status(out)["state"] == "done"
    assert clsplat.check(out)["whole"]


@pytest.mark.slow
def test_a_rehearsal_leaves_no_trace_in_the_run(tiny_scene, tmp_path, monkeypatch, short_rehearsals):
    """Of a training that ends before it can be corrected: the same bits as without a rehearsal."""
    monkeypatch.setattr(time_budget, "most_steps", lambda *given: 50)
    monkeypatch.setattr(time_budget, "EARLY", 1.0)
    monkeypatch.setattr(time_budget, "SOON", 1.0)
    out = clsplat.run("smoke", tiny_scene, tmp_path / "run", minutes=0.2)
    plain = clsplat.run("smoke", tiny_scene, tmp_path / "plain")
    assert digest(out) == digest(plain)
    names = ({file.name for file in folder.iterdir()} for folder in (out, plain))
    assert next(names) == next(names)


def test_training_is_not_cut_below_what_keeps_edits_apart():
    """The 300 of splat take 5 + 6 s."""
    found = [rehearsal(200, 0.02)]
    with pytest.raises(ConfigError, match=r"expected 1\.1 or more .* 300 steps fit"):
        pipeline_for(load("splat"), found, seconds=10.9, minutes=1.0)
    assert pipeline_for(load("splat"), found, seconds=12.0, minutes=1.0).settings.training.steps == 350


def test_what_cannot_be_fitted_is_refused(tiny_scene, tmp_path, few_steps):
    with pytest.raises(ConfigError, match="leave it out to go on"):
        clsplat.run(few_steps / "pipeline.yaml", out=few_steps, start="resume", minutes=1)
    with pytest.raises(ConfigError, match="a matrix has several"):
        clsplat.run(Path("examples/growth.yaml").absolute(), tiny_scene, tmp_path / "m", minutes=1)
    with pytest.raises(ConfigError, match="found 3"):
        clsplat.run("compress", tiny_scene, tmp_path / "c", set={"init.file": few_steps / "point_cloud.ply"}, minutes=1)
    for wrong in (0, -1, math.nan, math.inf):
        with pytest.raises(ConfigError, match="--minutes"):
            clsplat.run("smoke", tiny_scene, tmp_path / "w", minutes=wrong)
    assert not list(tmp_path.iterdir())
