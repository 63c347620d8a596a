"""Runs that share the cores of a CPU: how they are timed, what sweeps take, and the same bits."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from clsplat.api import tools
from clsplat.cli.tools import bench
from clsplat.conformance.bench import packing
from clsplat.conformance.bench.packing import Packing, Packings, known_packing, measure_packings, task_of
from clsplat.conformance.host import code_variables
from clsplat.core import machine, terminal
from clsplat.core.errors import ConfigError, DeviceError, MemoryLimitError
from clsplat.opencl.discovery import DeviceInfo, choose
from clsplat.sweeps import devices
from clsplat.sweeps.child import supervise
from clsplat.sweeps.devices import places, shares_of
from clsplat.sweeps.store import CellAttempt

CPU = DeviceInfo("a", "b", "CPU", "1", 4, 1 << 30, 1 << 29, 1 << 15, 64, 8, (0, 0))
SIZE = (64, 48, 300)  # width, height, Gaussians
GPU = replace(CPU, name="g", kind="GPU")


@pytest.fixture(autouse=True)
def caches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(packing, "cache_folder", lambda: tmp_path)
    return tmp_path


def test_cores_are_shared_in_equal_parts_of_neighbours():
    assert [machine.packings(count) for count in (1, 2, 6, 8)] == [[1], [1, 2], [1, 2, 4, 6], [1, 2, 4, 8]]
    assert machine.shares((0, 1, 2, 5, 6, 7), 2) == [(0, 1, 2), (5, 6, 7)]
    assert machine.shares(range(6), 4) == [(0,), (1,), (2,), (3,)], "all have as many"


def test_threads_match_cores_and_devices_need_no_second_check(monkeypatch):
    found = machine.limited((3, 4), {"a": "b"})
    assert found == {"a": "b", **dict.fromkeys(machine.LIMITS, "2")}
    before = code_variables()
    for name in machine.LIMITS:
        monkeypatch.setenv(name, "1")
    assert code_variables() == before


def measured(monkeypatch: pytest.MonkeyPatch, own: int, rates: dict[int, float | None]) -> Packings:
    """What is found on a machine of so many cores, with these steps per second by the number of processes."""
    monkeypatch.setattr(machine, "usable", lambda: tuple(range(own)))

    def together(task, parts):
        if (rate := rates[len(parts)]) is None:
            raise MemoryLimitError("it does not fit")
        return Packing(len(parts), len(parts[0]), rate, 1 << 20)

    monkeypatch.setattr(packing, "_together", together)
    return measure_packings(CPU, task_of(CPU, SIZE, "splat", 5, "auto"))


@pytest.mark.parametrize(
    ("rates", "best"),
    [({1: 10.0, 2: 10.1, 4: 9.0}, 1), ({1: 10.0, 2: 19.5, 4: 20.0}, 2), ({1: 1.0, 2: 2.0, 4: None}, 2)],
)
def test_sweep_takes_the_fewest_processes_of_about_equal_speed(rates, best, monkeypatch, caplog):
    assert known_packing(CPU) is None
    assert shares_of([CPU], "auto") == [[()]]
    found = measured(monkeypatch, 4, rates)
    assert found.best == best == known_packing(CPU) == found.data()["best"]
    assert f"best: {packing.told(best)}" in found.text()
    assert ("4 processes: it does not fit" in found.text()) == (rates[4] is None)
    caplog.set_level("INFO")
    (parts,) = shares_of([CPU], "auto")
    assert parts == (machine.shares(range(4), best) if best > 1 else [()])
    assert f"{packing.told(best)}; by `clsplat bench --packing`" in caplog.text
    assert shares_of([CPU, CPU], "auto") == [[()], [()]], "they have the same cores"
    assert shares_of([CPU, GPU], 4) == [machine.shares(range(4), 4), [()]]
    monkeypatch.setattr(machine, "usable", lambda: (0, 1))
    assert known_packing(CPU) is None, "it was found with other cores"
    with pytest.raises(ConfigError, match=r"execution.packing: 4 runs cannot share 2 cores; expected fewer"):
        shares_of([CPU], 4)


def test_each_run_that_shares_a_device_is_a_place_of_its_own(monkeypatch):
    monkeypatch.setattr(machine, "usable", lambda: (0, 1, 2, 3))
    monkeypatch.setattr(devices, "list_devices", lambda: [CPU])
    monkeypatch.setattr(devices, "choose", lambda name: CPU)
    monkeypatch.setattr(devices, "bits_class", lambda info, infos: "b")
    found = places("local", ["a"], 2)
    assert [place.cores for place in found] == [(0, 1), (2, 3)]
    assert len({*found}) == 2
    assert len({place.device for place in found}) == 1


def test_what_cannot_be_timed_is_refused():
    with pytest.raises(ConfigError, match=r"--packing: g .* is no CPU"):
        measure_packings(GPU, task_of(GPU, SIZE, "splat", 5, "auto"))
    with pytest.raises(ConfigError, match="--packing: expected one scene, of A, B, C"):
        tools.measure_packing("A,B")


def test_processes_are_timed_together_on_the_device(monkeypatch):
    name = os.environ.get("CLSPLAT_TEST_DEVICES", "").split(";")[0]
    if (info := choose(name or None)).kind != "CPU":
        pytest.skip("a CPU is needed")
    monkeypatch.setattr(machine, "usable", lambda: (0, 0))
    found = measure_packings(info, task_of(info, SIZE, "smoke", 1, "auto"), numbers=[2])
    (one,) = found.tried
    assert (one.processes, one.cores, found.best) == (2, 1, 2)
    assert one.rate > 0
    assert one.memory is None or one.memory > 1 << 25, "a device is open in it"


def test_a_process_that_says_nothing_is_told(monkeypatch):
    monkeypatch.setattr(packing, "MODULE", "clsplat.core.machine")
    with pytest.raises(DeviceError, match="a process of the packing ended with code 0, and no answer"):
        measure_packings(CPU, task_of(CPU, SIZE, "splat", 5, "auto"), numbers=[1])


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system keeps no process to cores")
def test_the_run_of_a_cell_is_kept_to_its_cores(tmp_path):
    attempt, own = CellAttempt(tmp_path / "attempt"), (machine.usable()[-1],)
    attempt.path.mkdir()
    attempt.take_lease("a", 0.0)
    code = "import os, sys, json, time; time.sleep(0.3)\n"
    code += "json.dump([sorted(os.sched_getaffinity(0)), os.environ['POCL_MAX_PTHREAD_COUNT']], open(sys.argv[1], 'w'))"
    command = [sys.executable, "-c", code, str(tmp_path / "told.json")]
    assert supervise(attempt, command, lambda: False, own) == 0
    assert json.loads((tmp_path / "told.json").read_text()) == [[*own], "1"]


def test_the_command_prints_a_table(monkeypatch, capsys):
    found = Packings("d", "A", "splat", [Packing(1, 2, 10.0, 1 << 20)], {})
    monkeypatch.setattr(tools, "measure_packing", lambda *words, **options: found)
    shown = []
    monkeypatch.setattr(terminal, "show", shown.append)
    bench(packing=True)
    assert "best: one run at a time" in shown[0]
    with pytest.raises(ConfigError, match="leave --model and --against out"):
        bench(packing=True, against=Path("a.json"))
