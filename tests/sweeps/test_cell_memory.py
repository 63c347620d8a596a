"""Cells are given to devices whose memory holds the plan of their training."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from clsplat.pipeline import matrix
from clsplat.pipeline.loading import load
from clsplat.scene.detect import read_scene
from clsplat.stages.init import Init
from clsplat.sweeps.batch import wanted_cell
from clsplat.sweeps.cell import Scenes
from clsplat.sweeps.devices import DeviceSlot
from clsplat.sweeps.engines import Drive
from clsplat.sweeps.memory_need import Need
from clsplat.sweeps.store import Store
from clsplat.sweeps.task import Outcome, run_cell
from clsplat.training.memory import plan
from tests.support.cells import WRITES, Fake, command, wanted

NEED = Need(degree=3, photographs=1 << 20, budget=None, pixels=1 << 16, first=1000, most=100_000)


def held(gaussians: int, name: str, bits: str = "x") -> DeviceSlot:
    """A device that holds about so many Gaussians."""
    memory = 8192 * gaussians + (14 << 20)
    return DeviceSlot("w", name, bits, memory=memory, allocation=memory)


def test_cell_runs_where_its_memory_is_and_others_go_on(store, terms):
    small, large, told = held(10, "small"), held(200_000, "large"), {}
    engine = Fake(*[Outcome("published")] * 3, places=(small, large))
    (grows, huge, free) = wanted(1, 3, 2)
    cells = [replace(grows, need=NEED), replace(huge, need=replace(NEED, first=10**7, most=10**7)), free]

    def ended(cell, outcome):
        told[cell.name] = outcome

    Drive(store, engine, True, terms, ended=ended).run(cells)
    assert ("1", "large", "x") in engine.started
    assert [name for name, *_ in engine.started] == ["2", "1"]
    assert (told["3"].state, told["3"].exit_code) == ("failed", 5)
    assert "no device of the sweep holds it; of the largest, memory: " in told["3"].message
    (failed,) = [folder for folder in store.folders() if folder.failed()]
    assert failed.failed()["exit_code"] == 5


@pytest.mark.parametrize("joins", [True, False])
def test_cell_waits_for_a_larger_device_that_may_join(store, terms, caplog, monkeypatch, joins):
    monkeypatch.setattr("clsplat.sweeps.engines.LOOK", 0.0)
    engine, told, looks = Fake(Outcome("published"), places=(held(10, "small"),)), [], []

    def may_join(waited):
        looks.append(waited)
        if joins and len(looks) == 5:
            engine._places = (*engine._places, held(200_000, "large"))
        return len(looks) < 9

    engine.may_join = may_join
    (one,) = wanted(1)
    one = replace(one, need=replace(NEED, first=100_000))
    Drive(store, engine, True, terms, ended=lambda cell, end: told.append(end.state)).run([one])
    assert told == ["published" if joins else "failed"]
    assert engine.started == [("1", "large", "x")] * joins
    assert [record.message for record in caplog.records] == ["no device holds 1 cell: 1; waiting for a larger one"]
    assert len(looks) == (5 if joins else 9)
    assert looks[0] == 0 < looks[-1]


def test_device_that_holds_the_start_takes_an_unholdable_cell(store, terms):
    engine = Fake(Outcome("published"), places=(held(10, "small"), held(20_000, "middle")))
    (one,) = wanted(1)
    Drive(store, engine, True, terms).run([replace(one, need=replace(NEED, first=5000))])
    assert engine.started == [("1", "middle", "x")]


def test_what_is_published_needs_no_memory(store, terms):
    (one,) = wanted(1)
    run_cell(one.on("x"), store, command(WRITES), terms)
    engine = Fake(Outcome("published"), places=(held(10, "small"),))
    Drive(store, engine, True, terms).run([replace(one, need=NEED)])
    assert engine.started == [("1", "small", "x")]


def test_the_need_of_a_cell_is_the_plan_of_its_training(tiny_scene, tmp_path):
    own = [f"scene.path={tiny_scene}", "init.source=random", "init.count=700", "densify.max_gaussians=9000"]
    need = wanted_cell(matrix.Cell("x", load("smoke", own)), Scenes(tmp_path), Store(tmp_path)).need
    assert (need.first, need.most, need.degree) == (700, 9000, load("smoke").settings.model.sh_degree)
    whole = read_scene(tiny_scene).split("train")
    assert need.photographs == sum(4 * view.camera.width * view.camera.height for view in whole)
    assert need.plan(held(10**5, "a")).limit >= 10**5 / 2


def test_need_of_motion_is_the_plan_its_first_stage_requires(tiny_scene):
    pipeline = load("dynamic_7k", ["init.source=random", "init.count=700"])
    need, limits, asked = Need.of(pipeline, read_scene(tiny_scene)), held(10**5, "a"), []

    def memory_plan(tables, harmonics):
        asked.append(plan(limits, tables, need.photographs, need.pixels, harmonics=harmonics))
        return asked[-1]

    run = SimpleNamespace(model_settings=pipeline.settings.model, memory_plan=memory_plan)
    run.harmonics, run.device = need.harmonics, SimpleNamespace(info=limits)
    run.pipeline = pipeline.resolved()
    Init._require_memory(run, 700)
    assert asked == [need.plan(limits)]


def test_cell_with_offloaded_sh_needs_less_device_memory():
    apart, open_one = held(10_000, "a"), replace(NEED, harmonics="auto")
    assert open_one.limit_on(apart) > NEED.limit_on(apart)
    assert open_one.limit_on(replace(apart, unified=True)) == NEED.limit_on(apart)
