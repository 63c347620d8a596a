"""`clsplat doctor`: verdicts, reports, and runtimes that die."""

import json
import re
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

import clsplat
from clsplat import cli
from clsplat.conformance import doctor, reference, supervision
from clsplat.conformance.check import Check, Deviation, Note
from clsplat.conformance.checks import BY_NAME, KERNELS, SPEED_CHECKS, whole
from clsplat.conformance.doctor import DeviceReport, examine, judge, report_page
from clsplat.conformance.supervision import CheckResult, run_checks
from clsplat.core.errors import ConfigError, MemoryLimitError, OutputError
from clsplat.core.machine import is_alive
from clsplat.opencl import runtimes
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import resolve_schedule
from tests.support.doctor_worker import worker
from tests.support.html_page import Page

WRONG = Deviation("blend_backward", "gradients of conics, 17 Gaussians", 3e-2, 2e-4)
RIGHT = Deviation("blend_backward", "gradients of colors", 1e-6, 2e-4)


def checks(*names: str) -> list[Check]:
    return [Check(name, ("blend_backward",), None) for name in names]


def result(*deviations: Deviation, fault: str | None = None) -> list[CheckResult]:
    return [CheckResult("a check", ("blend_backward",), 1.0, list(deviations), fault=fault)]


VERDICTS = {
    "all is right": ({"wide": result(RIGHT), "simt": result(RIGHT)}, True, "use it"),
    "the default is wrong": (
        {"wide": result(WRONG), "simt": result(RIGHT)},
        True,
        "use it with --set rasterizer.schedule=simt: with the wide schedule, blend_backward differs by 0.03 in "
        "gradients of conics, 17 Gaussians (at most 0.0002)",
    ),
    "the other one is wrong": (
        {"wide": result(RIGHT), "simt": result(WRONG)},
        True,
        "use it; this failure does not affect training: with the simt schedule, blend_backward differs by 0.03",
    ),
    "both are wrong": (
        {"wide": result(WRONG), "simt": result(fault="the runtime crashes with SIGABRT")},
        False,
        "do not use it: blend_backward differs by 0.03 in gradients of conics, 17 Gaussians (at most 0.0002); "
        "1 more failure",
    ),
    "a sort is wrong": (
        dict.fromkeys(("wide", "simt"), result(Deviation("sort_tiles", "order of 300 pairs", 2, 0, counts=True))),
        True,
        "use it with --set rasterizer.sort=radix: sort_tiles gives 2 wrong values in order of 300 pairs",
    ),
    "not a number": (
        {"wide": result(Deviation("exp", "x", float("nan"), 1.0))},
        False,
        "do not use it: exp differs by nan in x",
    ),
}


@pytest.mark.parametrize("case", VERDICTS)
def test_verdict_has_a_remedy(case):
    schedules, usable, text = VERDICTS[case]
    verdict = judge("wide", schedules, [])
    assert verdict.usable == usable
    assert verdict.text.startswith(text)
    assert bool(verdict.advice) == (case != "all is right")


def test_memory_faults_are_reported_although_kernels_pass():
    verdict = judge("wide", {"wide": result(RIGHT)}, result(Deviation("fill_words", "samples", 3, 0, counts=True)))
    assert verdict.text == "use it; this failure does not affect training: fill_words gives 3 wrong values in samples"


def test_checks_continue_after_a_runtime_crashes(monkeypatch, info):
    worker(monkeypatch)
    results = list(run_checks(info, "simt", checks("first", "dies", "second", "leaves", "third")))
    assert [item.name for item in results] == ["first", "dies", "second", "leaves", "third"]
    assert [item.passes for item in results] == [True, False, True, False, True]
    assert results[1].fault == "the runtime crashes with SIGABRT (noise of a runtime)"
    assert results[3].fault == "the process exits with code 3 (noise of a runtime)"


def test_hanging_runtime_is_stopped(monkeypatch, info):
    monkeypatch.setattr(supervision, "WORKER", ("-c", "import time; time.sleep(600)"))
    (first,) = run_checks(info, "simt", checks("hangs"), 1)
    assert first.fault == "gives no answer within 1 s"


@pytest.mark.parametrize(
    ("end", "fault"),
    [
        ("time.sleep(0.5); raise KeyError('rows')", "the process exits with code 1 (KeyError: 'rows')"),
        ("time.sleep(600)", "closes its output but does not exit"),
    ],
)
def test_worker_gets_time_to_exit(monkeypatch, info, end, fault):
    """Its output closes before the process ends."""
    monkeypatch.setattr(supervision, "EXIT_TIMEOUT_S", 5, raising=False)
    monkeypatch.setattr(supervision, "WORKER", ("-c", f"import os, time; os.close(1); {end}"))
    assert [run_check.fault for run_check in run_checks(info, "simt", checks("rows"))] == [fault]


def test_device_that_cannot_open_for_lack_of_memory_is_reported(monkeypatch, info):
    script = (
        "import sys; from clsplat.conformance import worker; from clsplat.core.errors import MemoryLimitError\n"
        "def refuse(*_): raise MemoryLimitError('opening the device: no memory')\n"
        "worker.Device = refuse; worker.main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:4], sys.argv[4:])"
    )
    monkeypatch.setattr(supervision, "WORKER", ("-c", script))
    results = list(run_checks(info, "simt", [BY_NAME["scans"], BY_NAME["rendering"]]))
    assert [(item.fault, item.out_of_memory) for item in results] == [("opening the device: no memory", True)] * 2


def test_fault_that_empty_caches_fix_is_a_damaged_cache(monkeypatch, info):
    worker(monkeypatch)
    results = list(run_checks(info, "simt", checks("first", "cached", "second", "cached", "leaves", "cached")))
    assert [item.passes for item in results] == [True, True, True, True, False, False], (
        "nobody tries again without success"
    )
    assert [item.damaged_cache for item in results] == [False, True, False, True, False, False]
    verdict = judge("simt", {"simt": results[:4]}, [])
    assert verdict.usable
    assert verdict.text == "use it; its cache of built kernels is damaged"
    assert re.search("remove .*pyopencl", verdict.advice)
    assert not judge("simt", {"simt": results}, []).usable


def test_process_of_a_check_ends_with_its_parent(info, tmp_path):
    """A killed parent cannot stop its child, which may hang in a check."""
    note = tmp_path / "process"
    hangs = (
        "import os, sys, time; from pathlib import Path; from clsplat.conformance import worker\n"
        f"worker._run = lambda *_: Path({str(note)!r}).write_text(str(os.getpid())) and time.sleep(600)\n"
        "worker.main(int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:4], sys.argv[4:])"
    )
    waits = (
        "from clsplat.conformance import supervision; from clsplat.conformance.checks import BY_NAME\n"
        "from clsplat.opencl.discovery import list_devices\n"
        f"info = next(one for one in list_devices() if one.index == {info.index})\n"
        f"supervision.WORKER = ('-c', {hangs!r}); list(supervision.run_checks(info, 'simt', [BY_NAME['scans']]))"
    )
    waiting = subprocess.Popen([sys.executable, "-c", waits])
    try:
        assert within(60, lambda: note.exists() and note.read_text())
    finally:
        waiting.kill()
        waiting.wait()
    process = int(note.read_text())
    assert within(20, lambda: not is_alive(process))


def within(seconds: float, condition) -> bool:
    """Return whether a condition becomes true within some seconds."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not condition():
        time.sleep(0.05)
    return bool(condition())


def test_file_of_the_working_folder_is_not_imported(monkeypatch, info, tmp_path, empty_cache):
    for name in ("json.py", "hashlib.py"):
        (tmp_path / name).write_text("raise RuntimeError('of the user')")
    monkeypatch.setattr(runtimes, "cache_folder", lambda: tmp_path)
    monkeypatch.chdir(tmp_path)
    (first,) = run_checks(info, resolve_schedule(info, "auto"), [BY_NAME["scans"]])
    assert first.passes, first.fault
    assert runtimes.probe_fault("key", *info.index) is None


@pytest.mark.parametrize(
    ("kind", "width", "value", "schedules"),
    [
        ("CPU", 16, "1e-6", ["simt", "simt16", "wide"]),
        ("CPU", 1, "1e-6", ["simt", "simt16"]),
        ("CPU", 1, "0.3", ["simt", "simt16", "wide"]),
        ("GPU", 1, "0.3", ["simt", "simt16"]),
    ],
)
def test_wide_schedule_is_tried_where_it_could_run(monkeypatch, info, empty_cache, kind, width, value, schedules):
    worker(monkeypatch, value)
    device = Device(info)
    device.info = replace(info, kind=kind, float_width=width)
    assert list(examine(device).schedules) == schedules


def report_of(info, **schedules: list[CheckResult]) -> DeviceReport:
    return DeviceReport(info, "wide", schedules, seconds=2.0)


def test_report_is_valid_json_for_any_value(info):
    report = report_of(info, wide=result(WRONG, Deviation("exp", "x", float("nan"), 1.0)))
    data = json.loads(json.dumps(report.data(), allow_nan=False))
    assert data["schema"] == 2
    assert data["verdict"]["usable"] is False
    actual = data["schedules"]["wide"][0]["deviations"]
    assert [item["value"] for item in actual] == [0.03, None]
    assert not any(item["passes"] for item in actual)
    assert data["device"]["name"] == info.name
    assert "blend_backward differs by 0.03" in report.text()


def test_page_shows_every_comparison_and_the_build_log(info):
    broken = CheckResult("projection", ("project_forward",), fault="project.cl does not build", log="error: <unknown>")
    page = report_page(report_of(info, wide=[*result(WRONG, RIGHT), broken], simt=result(RIGHT)))
    assert Page(page).text
    for text in (
        info.platform,
        "gradients of conics, 17 Gaussians",
        "gradients of colors",
        "error: &lt;unknown&gt;",
        "<i>worst</i> is the largest error",
    ):
        assert text in page


def memory_of(monkeypatch, largest: int, deviation: Deviation = RIGHT) -> tuple[list[str], DeviceReport]:
    """Return the failures of the memory check on a device with limited buffers, and its report."""

    def buffer(device, size):
        if -(-size // 64) * 64 > largest:
            raise MemoryLimitError("could not allocate (MEM_OBJECT_ALLOCATION_FAILURE)")
        yield deviation

    monkeypatch.setattr(whole, "_check_buffer", buffer)
    monkeypatch.setattr(whole, "available_memory", lambda: 2**34)
    info = SimpleNamespace(memory=2**33, allocation=2**30 + 4)
    actual = list(whole.memory(SimpleNamespace(info=info), None))
    deviations, notes = ([item for item in actual if isinstance(item, kind)] for kind in (Deviation, Note))
    once = [CheckResult("memory", ("fill_words",), 1.0, deviations, notes)]
    return once[0].failures, DeviceReport(info, "wide", {"wide": result(RIGHT)}, once)


@pytest.mark.parametrize(
    ("largest", "words"),
    [
        (2**30 + 4, "wrote and read 1.00 GiB of the 1.00 GiB that one buffer may have; the largest size works"),
        (2**28, "wrote and read 0.25 GiB of the 1.00 GiB that one buffer may have; a buffer of 512 MiB cannot be "
         "allocated: other programs may use the device's memory; close them and run `clsplat doctor` again"),
        (0, "wrote and read 0.00 GiB of the 1.00 GiB that one buffer may have; a buffer of 128 MiB cannot be"),
    ],
)  # fmt: skip
def test_memory_held_by_other_programs_is_no_device_fault(monkeypatch, largest, words):
    failures, report = memory_of(monkeypatch, largest)
    assert failures == []
    assert report.memory().startswith(words)
    assert report.verdict.text == "use it"


@pytest.mark.parametrize("largest", [2**30 + 4, 2**28])
def test_wrong_values_in_a_large_buffer_are_a_fault(monkeypatch, largest):
    failures, report = memory_of(monkeypatch, largest, Deviation("fill_words", "samples", 3, 0, counts=True))
    assert failures
    assert (
        report.verdict.text
        == "use it; this failure does not affect training: fill_words gives 3 wrong values in samples"
    )


@pytest.mark.parametrize(("value", "code"), [("1e-6", 0), ("0.3", 4)])
def test_faulty_device_exits_with_code_4(monkeypatch, capsys, info, empty_cache, value, code):
    worker(monkeypatch, value)
    monkeypatch.setattr(sys, "argv", ["clsplat", "doctor", "--json", "--device", f"{info.platform} {info.name}"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    out, err = capsys.readouterr()
    assert (ended.value.code or 0) == code
    data = json.loads(out)
    assert data["verdict"]["usable"] == (code == 0)
    assert len(data["schedules"]["simt"]) == len(KERNELS)
    assert len(data["once"]) == len(SPEED_CHECKS)
    if code:
        assert "do not use it: blend_backward differs by 0.3" in err


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("a folder.html", OutputError, "cannot be written"),
        ("a file/page.html", OutputError, "cannot be written"),
        ("pipeline.yaml", ConfigError, "ends in .html"),
        ("null", ConfigError, "ends in .html"),
    ],
)
def test_page_that_cannot_be_written_is_refused_first(monkeypatch, info, tmp_path, name, error, words):
    (tmp_path / "a folder.html").mkdir()
    (tmp_path / "a file").write_text("")
    monkeypatch.setattr(doctor, "run_checks", lambda *_: pytest.fail("the work began"))
    with pytest.raises(error, match=f"{name}: .*{words}"):
        clsplat.doctor(Device(info), tmp_path / name)


def test_verdict_is_printed_although_the_page_fails(monkeypatch, capsys, info, empty_cache, tmp_path):
    def full(*_):
        raise OutputError("page.html: cannot be written (No space left on device)")

    worker(monkeypatch)
    monkeypatch.setattr("clsplat.conformance.doctor.write_page", full)
    monkeypatch.setattr(sys, "argv", ["clsplat", "doctor", "--html", str(tmp_path / "page.html")])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 7
    assert "verdict   use it" in capsys.readouterr().out


@pytest.mark.slow
def test_correct_device_is_not_refused(info, empty_cache, monkeypatch):
    """Runs some checks in child processes; tests/conformance/test_checks_kernels.py runs all of them."""
    monkeypatch.setattr(doctor, "KERNELS", [BY_NAME["blur"], KERNELS[-1]])
    monkeypatch.setattr(doctor, "TILED", [KERNELS[-1]])
    monkeypatch.setattr(doctor, "SPEED_CHECKS", SPEED_CHECKS[:1])
    report = examine(Device(info))
    assert report.verdict.text == "use it", report.text()
    assert list(report.schedules) == ["simt", "simt16", *(["wide"] if report.default == "wide" else [])]
    assert report.note("training")["steps"] == 60


PHILOX = (  # of the paper's own test vectors: counter, key, words
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
)


@pytest.mark.parametrize(("counter", "key", "words"), PHILOX)
def test_random_numbers_of_the_reference_are_philox(counter, key, words):
    assert reference.philox(counter, key) == words
