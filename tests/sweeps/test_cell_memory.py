"""A cell that does not fit on a device moves to a larger one."""

import pytest

from clsplat.sweeps.devices import DeviceSlot
from clsplat.sweeps.engines import Dispatcher
from clsplat.sweeps.task import Outcome
from tests.support.cells import Fake, pending_cells

FULL, DONE = Outcome("failed", "", 5, "memory: too small"), Outcome("published")
SMALL, LARGE = (DeviceSlot("w", name, "x", memory=memory) for name, memory in (("s", 1), ("l", 2)))
OTHER = DeviceSlot("w", "o", "y", memory=3)


def states(store, options, engine, is_same=True, costs=(1,)):
    results = []
    Dispatcher(store, engine, is_same, options, on_end=lambda cell, end: results.append(end.state)).run(
        pending_cells(*costs)
    )
    return results


def test_longest_cell_gets_the_largest_device(store, options):
    engine = Fake(DONE, DONE, slots=(SMALL, LARGE))
    assert states(store, options, engine, costs=(1, 2)) == ["published"] * 2
    assert engine.started == [("2", "l", "x"), ("1", "s", "x")]


def test_cell_that_does_not_fit_goes_to_a_larger_device(store, options, caplog):
    engine = Fake(DONE, FULL, DONE, slots=(LARGE, SMALL))
    assert states(store, options, engine, costs=(1, 2)) == ["published"] * 2
    assert engine.started[1:] == [("1", "s", "x"), ("1", "l", "x")]
    assert [record.message for record in caplog.records] == ["cell 1: memory: too small; trying a larger device"]


@pytest.mark.parametrize(("is_same", "ends"), [(True, ["failed"]), (False, ["published"])])
def test_only_devices_that_may_run_a_cell_are_tried(store, options, is_same, ends):
    (first,) = pending_cells(1)
    store.add(first.in_class("x"))
    engine = Fake(FULL, *[DONE] * (not is_same), slots=(SMALL, OTHER) if not is_same else (SMALL,))
    assert states(store, options, engine, is_same) == ends
    assert [device for _, device, _ in engine.started] == (["s"] if is_same else ["s", "o"])
