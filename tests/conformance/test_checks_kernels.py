"""The checks of `clsplat doctor` pass on the tested devices, and every kernel has a test."""

import io
import itertools
import queue
from dataclasses import replace
from typing import Any

import pytest

from clsplat.conformance import supervision, worker
from clsplat.conformance.check import Note
from clsplat.conformance.checks import BITONIC, ESSENTIAL_CHECKS, KERNELS
from clsplat.core.resources import resource_dir
from clsplat.opencl.device import parse_kernels
from tests.support.deviations import assert_within_bounds
from tests.support.devices import NAMES, TUNINGS


def cases() -> list[Any]:
    """Each check of the kernels with both schedules, the wide one with either number of lanes in turn; those before a
    run, which are smaller, with one setting.
    """
    wide = [(check, setting) for check, setting in zip(KERNELS, itertools.cycle(("wide16", "wide8")), strict=False)]
    small = zip((*ESSENTIAL_CHECKS, *BITONIC), itertools.cycle(TUNINGS), strict=False)
    actual = [*wide, *((check, "simt") for check in KERNELS), *small]
    return [
        pytest.param((name, setting), check, id=f"{name}-{setting}-{check.name.replace(' ', '_')}")
        for name in NAMES
        for check, setting in actual
    ]


@pytest.mark.usefixtures("cache_references")
@pytest.mark.parametrize(("device", "check"), cases(), indirect=["device"])
def test_check_passes(device, check):
    actual = list(check.deviations(device))
    assert_within_bounds(item for item in actual if not isinstance(item, Note))
    out, lines = io.StringIO(), queue.Queue()
    worker._run(out, replace(check, run=lambda *_: iter(actual)), lambda: device)
    worker._print(out, end=check.name, seconds=0.0)
    for line in out.getvalue().splitlines():
        lines.put(line)
    told = supervision.CheckResult(check.name, check.kernels)
    assert supervision._read_result(told, lines, 1) is None
    assert told.failures == []
    assert (len(told.deviations), len(told.notes)) == (
        sum(not isinstance(item, Note) for item in actual),
        len(actual) - len(told.deviations),
    )


def test_every_kernel_was_launched(launched):
    """With each schedule, except kernels for one schedule."""
    for schedule, other in (("wide", "simt"), ("simt", "wide")):
        kernels = {
            f"{path.name}:{name}"
            for path in resource_dir("cl_kernels").glob("*.cl")
            if not path.stem.endswith(other)
            for name in parse_kernels(path.read_text())
        }
        actual = {label for one, label in launched if one == schedule}
        assert not kernels - actual, f"no kernel test launches {', '.join(sorted(kernels - actual))}"
        assert actual == kernels
