"""The check before a device renders or trains: it runs once, and a faulty device is refused everywhere."""

import io
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pyopencl as cl
import pytest

import clsplat
from clsplat.conformance import checks, host, quick, supervision
from clsplat.conformance import worker as worker_process
from clsplat.conformance.check import Check
from clsplat.conformance.checks import ESSENTIAL_CHECKS
from clsplat.conformance.doctor import examine
from clsplat.conformance.scenes import random_case
from clsplat.core.errors import DeviceError, MemoryLimitError
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import tuning_macros
from clsplat.render.tiles import resolve_sort
from tests.support.doctor_worker import worker
from tests.support.models import model_of

OTHER_BUILDS = {
    "__version__": "0.0",
    "_hash_checks": lambda: "other checks",
    "_hash_kernels": lambda: "other sources",
    "BUILD_OPTIONS": ("-cl-std=CL1.2", "-cl-mad-enable"),
    "tuning_macros": lambda info, schedule: {**tuning_macros(info, schedule), "DIGIT_BITS": 6},
}


def like(device, **changes):
    return SimpleNamespace(
        **{"info": device.info, "schedule": device.schedule, "tuning": device.tuning, "label": "x", **changes}
    )


@pytest.mark.parametrize(
    ("team", "sort", "bitonic"),
    [(1, "auto", False), (1, "radix", False), (1, "bitonic", True), (64, "auto", True), (64, "radix", False)],
)
def test_bitonic_is_checked_if_the_run_can_choose_it(monkeypatch, info, empty_cache, team, sort, bitonic):
    results = []
    monkeypatch.setattr(quick, "run_checks", lambda info, schedule, checks, seconds: results.extend(checks) or [])
    device = like(Device(info), tuning={"TEAM": team})
    quick.ensure_correct(device, sort)
    assert any("sort_tiles" in check.kernels for check in results) == bitonic
    results.clear()
    quick.ensure_correct(device, sort)
    assert not results
    quick.ensure_correct(device, "bitonic")
    assert bool(results) != bitonic


def test_checks_of_every_run_need_no_bitonic():
    kernels = {name for check in ESSENTIAL_CHECKS for name in check.kernels}
    assert not {"fill_tiles", "sort_tiles", "merge_runs"} & kernels


def test_doctor_deletes_the_record_of_a_faulty_device(monkeypatch, info, empty_cache):
    worker(monkeypatch)
    device = Device(info)
    quick.ensure_correct(device)
    worker(monkeypatch, "0.3")
    examine(device)
    with pytest.raises(DeviceError, match="computes wrong results"):
        quick.ensure_correct(device)


def test_lack_of_memory_is_no_device_fault(monkeypatch, info, empty_cache):
    def check(device, rng):
        raise MemoryLimitError("no buffer")
        yield

    out = io.StringIO()
    worker_process._run(out, Check("rendering", (), check), lambda: None)
    worker_process._print(out, end="rendering", seconds=0.1)
    monkeypatch.setattr(supervision, "WORKER", ("-c", f"print({out.getvalue()!r}, end='')"))
    with pytest.raises(MemoryLimitError, match=r"no buffer.*other programs"):
        quick.ensure_correct(Device(info))


def test_damaged_kernel_cache_is_no_device_fault(monkeypatch, info, empty_cache):
    worker(monkeypatch)
    monkeypatch.setattr(checks, "ESSENTIAL_CHECKS", [Check("cached", ("blend_backward",), None)])
    with pytest.raises(DeviceError, match=r"cache of built kernels is damaged: remove .*pyopencl"):
        quick.ensure_correct(Device(info))
    assert not list(empty_cache.iterdir())


def test_runtime_exception_is_one_sentence():
    def check(device, rng):
        raise cl.LogicError("clCreateKernel failed: INVALID_KERNEL_NAME")
        yield

    out = io.StringIO()
    worker_process._run(out, Check("rendering", (), check), lambda: None)
    assert "the OpenCL runtime rejects a call: clCreateKernel failed: INVALID_KERNEL_NAME" in out.getvalue()


def test_start_of_a_check_is_logged(monkeypatch, info, empty_cache, caplog):
    worker(monkeypatch)
    with caplog.at_level("INFO", "clsplat"):
        quick.ensure_correct(Device(info))
    assert f"checking {info.name}; this takes a few seconds" in caplog.text


def test_faulty_device_is_refused(monkeypatch, info, empty_cache):
    worker(monkeypatch, "0.3")
    device = Device(info)
    for _ in range(2):  # it is not remembered
        with pytest.raises(
            DeviceError, match=r"computes wrong results: blend_backward differs by 0.3 .*clsplat doctor"
        ):
            quick.ensure_correct(device)


def test_correct_device_is_checked_once(monkeypatch, info, empty_cache):
    worker(monkeypatch)
    device = Device(info)
    before = device.allocated, device.peak, dict(device.tuning)
    quick.ensure_correct(device)
    monkeypatch.setattr(supervision, "WORKER", ("-c", "raise SystemExit(1)"))
    quick.ensure_correct(device)
    assert (device.allocated, device.peak, device.tuning) == before
    for change in ({"driver": "another"}, {"platform": "another"}, {"name": "another"}):
        with pytest.raises(DeviceError, match="cannot be trusted"):
            quick.ensure_correct(like(device, info=replace(info, **change)))
    other = Device(info, "simt" if device.schedule == "wide" else "wide")
    with pytest.raises(DeviceError, match="cannot be trusted"):
        quick.ensure_correct(other)
    for name, changed in OTHER_BUILDS.items():
        with monkeypatch.context() as patched:
            patched.setattr(quick, name, changed, raising=False)
            with pytest.raises(DeviceError, match="cannot be trusted"):
                quick.ensure_correct(device)


@pytest.mark.parametrize("variable", ["PYOPENCL_BUILD_OPTIONS", "POCL_VECTORIZER_PREFER_VECTOR_WIDTH", "CL_CONFIG_X"])
def test_variable_that_changes_code_changes_the_record(monkeypatch, info, variable):
    before = quick._record_file(info, "wide", "radix")
    monkeypatch.setenv(variable, "-DTILE=8")
    assert quick._record_file(info, "wide", "radix") != before
    assert host.describe_host()["environment"][variable] == "-DTILE=8"


def test_cache_path_does_not_change_the_record(monkeypatch, info, tmp_path):
    before = quick._record_file(info, "wide", "radix")
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    assert quick._record_file(info, "wide", "radix") == before


def test_device_is_checked_again_with_other_build_options(monkeypatch, info, empty_cache):
    device = Device(info)
    quick.remember(info, device.schedule)
    quick.ensure_correct(device)
    monkeypatch.setenv("PYOPENCL_BUILD_OPTIONS", "-DTILE=8")
    with pytest.raises(DeviceError, match="clsplat doctor"):
        quick.ensure_correct(device)


def test_device_is_checked_each_time_without_a_writable_cache(monkeypatch, info, tmp_path):
    blocked = tmp_path / "a file"
    blocked.write_text("")
    monkeypatch.setattr(quick, "cache_folder", lambda: blocked)
    started = []
    monkeypatch.setattr(quick, "run_checks", lambda *arguments: started.append(arguments) or [])
    for _ in range(2):
        quick.ensure_correct(Device(info))
    assert len(started) == 2


def test_quick_check_passes_and_is_recorded(info, empty_cache):
    opened = Device(info)
    quick.ensure_correct(opened)
    records = list((empty_cache / "conformance").iterdir())
    assert len(records) == (1 if resolve_sort(opened, "auto") == "radix" else 2)  # either sort may be chosen


# ---- wherever a device works


@pytest.fixture
def model(rng, tmp_path) -> Path:
    """A small model file."""
    model_of(random_case(rng, 3)).save(tmp_path / "model.ply")
    return tmp_path / "model.ply"


WORK: dict[str, Callable[[Path, Path, Path, object], object]] = {
    "run": lambda scene, model, out, device: clsplat.run("smoke", scene, out / "run", device=device),
    "describe_run": lambda scene, model, out, device: clsplat.describe_run("smoke", scene, out / "run", device=device),
    "Trainer": lambda scene, model, out, device: clsplat.Trainer(scene, "smoke", out=out / "run", device=device),
    "Renderer": lambda scene, model, out, device: clsplat.Renderer(clsplat.load(model), device),
    "render_views": lambda scene, model, out, device: clsplat.render_views(model, scene, out / "views", device=device),
    "evaluate": lambda scene, model, out, device: clsplat.evaluate(model, scene, device=device),
}


@pytest.mark.parametrize(("work", "given"), list(zip(WORK, 2 * ["default", "name", "open"], strict=True)))
def test_faulty_device_writes_no_render_and_no_model(
    work, given, monkeypatch, info, empty_cache, tiny_scene, model, tmp_path
):
    worker(monkeypatch, "0.3")
    device = {"default": None, "name": info.name, "open": Device(info)}[given]
    with pytest.raises(DeviceError, match=r"computes wrong results: blend_backward differs by 0.3 .*clsplat doctor"):
        WORK[work](tiny_scene, model, tmp_path / "out", device)
    assert not list((tmp_path / "out").rglob("*"))


def test_device_is_checked_once_for_all_work(monkeypatch, info, empty_cache, tiny_scene, model, tmp_path):
    started = []
    run_checks = quick.run_checks
    monkeypatch.setattr(quick, "run_checks", lambda *arguments: started.append(1) or run_checks(*arguments))
    worker(monkeypatch)
    for work in ("Renderer", "render_views", "evaluate", "Trainer"):
        WORK[work](tiny_scene, model, tmp_path, Device(info))
        assert len(started) == 1
