"""Runs that share the cores of a CPU."""

import json
import os
import sys
from dataclasses import replace

import pytest

from clsplat.conformance.host import code_variables
from clsplat.core import machine
from clsplat.core.errors import ConfigError
from clsplat.opencl.discovery import DeviceInfo
from clsplat.sweeps import devices
from clsplat.sweeps.child import supervise
from clsplat.sweeps.devices import find_slots, split_device_cores
from clsplat.sweeps.store import CellAttempt

CPU = DeviceInfo("a", "b", "CPU", "1", 4, 1 << 30, 1 << 29, 1 << 15, 64, 8, (0, 0))
GPU = replace(CPU, name="g", kind="GPU")


def test_cores_are_split_into_equal_contiguous_parts():
    assert machine.split_cores((0, 1, 2, 5, 6, 7), 2) == [(0, 1, 2), (5, 6, 7)]
    assert machine.split_cores(range(6), 4) == [(0,), (1,), (2,), (3,)], "all have as many"


def test_threads_match_cores_and_devices_need_no_second_check(monkeypatch):
    result = machine.limited_environment((3, 4), {"a": "b"})
    assert result == {"a": "b", **dict.fromkeys(machine.THREAD_VARIABLES, "2")}
    before = code_variables()
    for name in machine.THREAD_VARIABLES:
        monkeypatch.setenv(name, "1")
    assert code_variables() == before


def test_only_cpus_run_one_cell_per_core(monkeypatch):
    monkeypatch.setattr(machine, "usable_cores", lambda: tuple(range(4)))
    assert split_device_cores([CPU, GPU], 4) == [machine.split_cores(range(4), 4), [()]]
    assert split_device_cores([CPU], 1) == [[()]], "kept to no cores"
    with pytest.raises(ConfigError, match=r"execution.packing: 5 runs cannot share 4 cores; set at most 4"):
        split_device_cores([CPU], 5)


def test_runs_sharing_a_device_get_separate_slots(monkeypatch):
    monkeypatch.setattr(machine, "usable_cores", lambda: (0, 1, 2, 3))
    monkeypatch.setattr(devices, "list_devices", lambda: [CPU])
    monkeypatch.setattr(devices, "choose_device", lambda name: CPU)
    monkeypatch.setattr(devices, "find_bits_class", lambda info, infos: "b")
    result = find_slots("local", ["a"], 2)
    assert [slot.cores for slot in result] == [(0, 1), (2, 3)]
    assert len({*result}) == 2
    assert len({slot.device for slot in result}) == 1


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system keeps no process to cores")
def test_run_of_a_cell_is_limited_to_its_cores(tmp_path):
    attempt, own = CellAttempt(tmp_path / "attempt"), (machine.usable_cores()[-1],)
    attempt.path.mkdir()
    attempt.take_lease("a", 0.0)
    code = "import os, sys, json, time; time.sleep(0.3)\n"
    code += "json.dump([sorted(os.sched_getaffinity(0)), os.environ['POCL_MAX_PTHREAD_COUNT']], open(sys.argv[1], 'w'))"
    command = [sys.executable, "-c", code, str(tmp_path / "told.json")]
    assert supervise(attempt, command, lambda: False, own) == 0
    assert json.loads((tmp_path / "told.json").read_text()) == [[*own], "1"]
