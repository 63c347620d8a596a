"""Plans: what is recorded and replayed, and what is not."""

import threading

import numpy as np
import pytest

from clsplat.core.errors import KernelError
from clsplat.opencl import plan as plan_module
from clsplat.opencl.plan import Plans
from tests.support.devices import on_one_setting


class Fill:
    """A part of one launch, which fills an array; it counts its runs."""

    def __init__(self, device):
        self.device, self.runs = device, 0
        self.target = device.zeros(16, np.uint32)

    def __call__(self, word, target=None):
        self.runs += 1
        self.device.program("fill.cl").fill_words(items=1, values=target or self.target, word=word, lines=1)
        return self.runs


def run(plans, part, word, target=None):
    target = target or part.target
    return plans.run("part", {"word": word, "values": target}, part, word, target)


@on_one_setting
def test_third_run_replays_with_new_arguments(device):
    plans, part, other = Plans(device), Fill(device), device.zeros(16, np.uint32)
    assert [run(plans, part, word) for word in (3, 4, 5, 6)] == [1, 2, 2, 2]
    np.testing.assert_array_equal(part.target.get(), 6)
    run(plans, part, 7, other)
    np.testing.assert_array_equal(other.get(), 7)
    np.testing.assert_array_equal(part.target.get(), 6)
    assert part.runs == 2


@on_one_setting
def test_other_launches_do_not_change_a_plan(device):
    plans, part = Plans(device), Fill(device)
    for _ in range(3):
        run(plans, part, 5)
    device.program("fill.cl").fill_words(items=1, values=device.zeros(16, np.uint32), word=9, lines=1)
    run(plans, part, 5)
    np.testing.assert_array_equal(part.target.get(), 5)


@on_one_setting
@pytest.mark.parametrize("command", ["allocate", "upload", "read", "read later"])
def test_part_that_copies_or_allocates_is_never_replayed(device, command):
    plans, part = Plans(device), Fill(device)
    commands = {
        "allocate": lambda: device.empty(4),
        "upload": lambda: part.target.set(np.zeros(16, np.uint32)),
        "read": lambda: part.target.get(),
        "read later": lambda: part.target.get_item_later(0)(),
    }
    for _ in range(5):
        plans.run("part", {}, lambda: (part(1), commands[command]()))
    assert part.runs == 5


@on_one_setting
def test_changes_have_the_type_and_the_value_of_the_launch(device):
    plans, part = Plans(device), Fill(device)
    plans.run("part", {"word": 1}, part, 1)
    with pytest.raises(KernelError, match="fill_words: the plan expects another value of word"):
        plans.run("part", {"word": 2}, part, 1)
    for _ in range(2):
        run(plans, part, 1)
    with pytest.raises(KernelError, match="fill_words: values is a Array of the wrong type"):
        run(plans, part, 1, device.zeros(16, np.float32))
    with pytest.raises(KernelError, match=r"the plan expects values of word, values; got word$"):
        plans.run("part", {"word": 1}, part, 1)
    with pytest.raises(KernelError, match="fill_words: word is a Array of the wrong type"):
        plans.run("part", {"word": part.target, "values": part.target}, part, 1)


@on_one_setting
def test_part_inside_of_a_part_is_recorded_with_it(device):
    plans, part, inner = Plans(device), Fill(device), Fill(device)
    for _ in range(4):
        plans.run("inner", {}, inner, 2)
    for _ in range(4):
        plans.run("outer", {}, lambda: (part(1), plans.run("inner", {}, inner, 2)))
    inner.target.fill(0)
    plans.run("outer", {}, lambda: None)
    np.testing.assert_array_equal(inner.target.get(), 2)


@on_one_setting
def test_launches_of_other_threads_are_not_recorded(device):
    plans, part, other = Plans(device), Fill(device), Fill(device)

    def launch():
        thread = threading.Thread(target=other, args=(8,))
        thread.start()
        thread.join()
        part(3)

    for _ in range(3):
        plans.run("part", {}, launch)
    assert (part.runs, other.runs) == (2, 2)


@on_one_setting
def test_kernels_of_forgotten_plans_are_used_again(device, monkeypatch):
    monkeypatch.setattr(plan_module, "MAX_PLANS", 4)
    plans, part, kernel = Plans(device), Fill(device), device.program("fill.cl").fill_words
    created = []
    create = kernel._create
    monkeypatch.setattr(kernel, "spare_kernels", [])
    monkeypatch.setattr(kernel, "_create", lambda: created.append(create()) or created[-1])
    for key in range(20):
        for _ in range(3):
            plans.run(key, {}, part, key)
        np.testing.assert_array_equal(part.target.get(), key)
    assert len(created) <= 4
