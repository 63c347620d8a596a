"""The memory plan: its accuracy, its limits, and refusals."""

import pytest

from clsplat.conformance.scenes import random_case
from clsplat.core.errors import MemoryLimitError
from clsplat.gaussians.structs import GaussianGradients
from clsplat.training import memory
from clsplat.training.memory import FRAME_GAUSSIAN, MemoryPlan
from tests.support.commands import clsplat
from tests.support.runs import FEW, digest, train

SMALL = MemoryPlan(
    gaussian=1000, pair=88, fixed=10_000_000, largest_table=180, memory=100_000_000, allocation=50_000_000
)


def test_planned_bytes_match_the_tables(device, rng):
    def plan(gaussians, *numbers, **more):
        return memory.plan(device.info, gaussians.components, *numbers, **more)

    gaussians = random_case(rng, 100).model(device).gaussians
    parameters = 4 * (3 + 4 + 3 + 1 + 3 + 45 + 1)  # with the filter's variance
    gradients = GaussianGradients(gaussians)
    held = sum(array.nbytes for array in (*gradients.arrays.values(), gradients.mean2d))
    frame = FRAME_GAUSSIAN + 4 * 9 + held // gaussians.capacity
    assert plan(gaussians, 0, 0).gaussian == parameters + frame
    assert plan(gaussians, 0, 0, pixel_sums=13).gaussian == parameters + frame + 4 * 4
    gaussians.add("more", 7)
    assert plan(gaussians, 0, 0).gaussian == parameters + frame + 28
    assert plan(gaussians, 1000, 256).fixed == 1000 + 256 * 120
    assert plan(gaussians, 0, 0).largest_table == 180


def test_limit_is_exact():
    assert SMALL.required_bytes(SMALL.limit) <= SMALL.memory < SMALL.required_bytes(SMALL.limit + 1)
    SMALL.check(SMALL.limit)
    with pytest.raises(MemoryLimitError, match=r"fit in 95 MiB.*start from fewer points"):
        SMALL.check(SMALL.limit + 1)


def test_single_buffer_may_be_too_large():
    narrow = MemoryPlan(gaussian=10, pair=88, fixed=0, largest_table=180, memory=10**12, allocation=27_000_000)
    assert narrow.limit == 84_375  # records of 5 pairs of 64 bytes


def test_training_that_cannot_fit_is_refused_before_it_starts(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.training.run.plan", lambda *_: SMALL)
    with pytest.raises(MemoryLimitError):
        train(tiny_scene, tmp_path / "run", "init.source=random", "init.count=80000")


@pytest.mark.parametrize("bytes_each", [500, 1e-6])
def test_too_many_random_points_are_not_drawn(bytes_each, info, tiny_scene, tmp_path, monkeypatch):
    def made(*_):
        raise AssertionError("random points are made")

    monkeypatch.setattr("clsplat.stages.init.random_points", made)
    count = int(info.memory / bytes_each)  # a Gaussian takes more
    with pytest.raises(MemoryLimitError, match=f"for {count:,} Gaussians .* start from fewer points"):
        train(tiny_scene, tmp_path / "run", "init.source=random", f"init.count={count}")


def test_too_many_points_are_refused_before_neighbor_search(tiny_scene, tmp_path, monkeypatch):
    def looked_for(*_):
        raise AssertionError("neighbors are looked for")

    monkeypatch.setattr("clsplat.gaussians.conversion.neighbor_distance2", looked_for)
    tight = MemoryPlan(gaussian=1000, pair=0, fixed=0, largest_table=1, memory=9000, allocation=10**9)
    monkeypatch.setattr("clsplat.training.run.plan", lambda *_: tight)
    with pytest.raises(MemoryLimitError):
        train(tiny_scene, tmp_path / "run")


def test_first_plan_has_the_tables_that_training_adds(tiny_scene, tmp_path):
    run = train(tiny_scene, tmp_path / "run", "optimize.steps=1")
    present = run.model.gaussians.components
    first = memory.table_widths(run.model_settings.sh_degree)
    assert first == {name: present[name] for name in first}
    assert run.memory_plan(first).limit >= run.memory_plan().limit


def test_growth_stops_at_the_memory_limit(tiny_scene, tmp_path, monkeypatch):
    free = train(tiny_scene, tmp_path / "free").model.gaussians.count
    fits = MemoryPlan(gaussian=0, pair=0, fixed=0, largest_table=1, memory=9000, allocation=10**9)
    monkeypatch.setattr("clsplat.training.run.plan", lambda *_: fits)
    assert 8000 < train(tiny_scene, tmp_path / "tight").model.gaussians.count <= 9000 < free


def test_uncached_images_train_to_the_same_bits(tiny_scene, few_steps, tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.photos.photographs.BUDGET_FRACTION", 1e-10)
    assert train(tiny_scene, tmp_path / "tight", *FEW).photographs.budget < 100
    assert digest(tmp_path / "tight") == digest(few_steps)


def test_run_logs_how_many_gaussians_fit(tiny_scene, tmp_path):
    clsplat("run", "smoke", "--scene", tiny_scene, "--out", tmp_path / "run", "--set", "optimize.steps=1")
    log = (tmp_path / "run" / "log.txt").read_text()
    assert "memory: " in log
    assert " fit in " in log


def test_bands_and_short_launches_train_to_the_same_bits(tiny_scene, few_steps, tmp_path):
    cut = train(tiny_scene, tmp_path / "cut", *FEW, "rasterizer.pair_budget=1", "rasterizer.launch_tiles=2")
    assert len(cut.rasterizer._split(cut.photographs.camera(cut.scene.views[0]))) > 1
    assert digest(tmp_path / "cut") == digest(few_steps)
