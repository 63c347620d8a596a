"""Devices and random numbers for tests.

Kernel tests are the modules `test_*_kernels.py`; `-m kernels` selects them. They run on every device named in
CLSPLAT_TEST_DEVICES (parts of names, separated by `;`; default: the device that clsplat would choose), with the wide
schedule at 16 and 8 lanes and with the simt schedule: a test without parameters with each of the three settings, the
cases of a test with parameters with one each, in turn (`on_devices`). Their launches are recorded for the test that
every kernel has a test.
"""

import copy
import functools
import os
import signal
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest

from clsplat.conformance import quick
from clsplat.core.settings import Settings, rebuild_models
from clsplat.data_tools.synthetic import SyntheticOptions, write_dataset
from clsplat.opencl import device as opencl_device
from clsplat.opencl import device as program
from clsplat.opencl.device import Array, Device, Kernel, Program
from clsplat.opencl.discovery import DeviceInfo, choose_device
from clsplat.pipeline import loading, plugins, yaml_file
from clsplat.scene.reader import Reader
from clsplat.sweeps.store import Store
from clsplat.sweeps.task import CellOptions
from tests.support.devices import NAMES, TUNINGS
from tests.support.runs import FEW, killed, train

# A busy machine is no fault, and a change is judged by the same examples each time; `--hypothesis-profile search` tries
# other ones.
hypothesis.settings.register_profile("search", deadline=None)
hypothesis.settings.register_profile("suite", deadline=None, derandomize=True)
hypothesis.settings.load_profile("suite")
KERNEL_TESTS = "test_*_kernels.py"
LAST = "test_every_kernel_was_launched"
LAUNCHED = pytest.StashKey[set[tuple[str, str]]]()
IS_WHOLE = pytest.StashKey[bool]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--one-each", action="store_true", help="of a test's parameters take those in the middle alone")


def pytest_configure(config: pytest.Config) -> None:
    Program.options += ("-Werror",)
    config.stash[LAUNCHED] = set()
    config.stash[IS_WHOLE] = True


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give processes that share the tests whole modules, and one of them all of the kernels, in the order of
    collection: xdist would sort modules by their number of tests, and a few expensive tests would be the last."""
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):  # type: ignore[misc]
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            self.config.option.loadscopereorder = False

        def _split_scope(self, nodeid: str) -> str:
            return "kernels" if "_kernels.py::" in nodeid else str(super()._split_scope(nodeid))

    return Scheduling(config, log)


def is_kernel_path(path: Path) -> bool:
    return path.match(KERNEL_TESTS)


def is_kernel_test(item: pytest.Item) -> bool:
    return is_kernel_path(item.path)


def pytest_itemcollected(item: pytest.Item) -> None:
    if is_kernel_test(item):
        item.add_marker("kernels")


def pytest_deselected(items: list[pytest.Item]) -> None:
    if any(map(is_kernel_test, items)):
        items[0].config.stash[IS_WHOLE] = False


@pytest.hookimpl(trylast=True)  # after -m and -k
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with kernel tests and slow modules, so that processes end together; put the test that looks back behind
    all others; note whether all kernel tests are there."""
    collected = {item.path for item in items}
    first = {item.path for item in items if item.get_closest_marker("slow")} | set(filter(is_kernel_path, collected))
    items.sort(key=lambda item: (item.name == LAST, item.path not in first, not is_kernel_test(item)))
    parts = any("::" in argument for argument in config.args)
    if parts or config.getoption("--one-each") or not collected >= set(Path(__file__).parent.rglob(KERNEL_TESTS)):
        config.stash[IS_WHOLE] = False
    if config.getoption("--one-each"):
        cases: dict[tuple[str, object], list[pytest.Item]] = {}
        for item in items:
            parameters = item.callspec.params if hasattr(item, "callspec") else {}
            cases.setdefault((item.nodeid.partition("[")[0], parameters.get("device")), []).append(item)
        items[:] = [same[len(same) // 2] for same in cases.values()]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Record (schedule, file:kernel) of every launch of a kernel test."""
    if not is_kernel_test(item):
        return (yield)
    call, recorded = Kernel.__call__, item.config.stash[LAUNCHED]

    def record(kernel: Kernel, **values: Any) -> None:
        call(kernel, **values)
        amount = values.get("items") or values.get("groups") or 0
        if 0 not in (amount if isinstance(amount, tuple) else (amount,)):
            recorded.add((kernel._device.schedule, kernel.label))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Kernel, "__call__", record)
        return (yield)


@pytest.fixture
def launched(request: pytest.FixtureRequest) -> set[tuple[str, str]]:
    """(schedule, file:kernel) of what was launched; skips where only a part of the tests is run."""
    if not request.config.stash[IS_WHOLE]:
        pytest.skip("only a part of the kernel tests is run")
    return request.config.stash[LAUNCHED]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Make what a test has printed UTF-8: processes that share the tests send it to each other."""
    report = yield
    report.sections = [(name, text.encode("utf-8", "replace").decode()) for name, text in report.sections]
    return report


@pytest.fixture(
    scope="session", params=[(name, tuning) for name in NAMES for tuning in TUNINGS], ids=lambda p: "-".join(p)
)
def device(request: pytest.FixtureRequest) -> Device:
    """An open device; its kernels are built once for the whole session."""
    return opened(*request.param)


@functools.cache
def opened(name: str, tuning: str) -> Device:
    """A device with one of the settings; cases of a test take them in turn."""
    schedule, lanes = TUNINGS[tuning]
    result = Device(choose_device(name or None), schedule)
    result.tuning["LANES"] = lanes
    return result


@pytest.fixture(scope="session")
def info() -> DeviceInfo:
    """The first device that is tested."""
    return choose_device(NAMES[0] or None)


@pytest.fixture
def empty_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An empty cache of device checks."""
    monkeypatch.setattr(quick, "cache_folder", lambda: tmp_path)
    return tmp_path


@pytest.fixture
def smooth(device: Device) -> Device:
    """The device without thresholds in blending, where derivatives have no jumps."""
    opened = Device(device.info, device.schedule)
    opened.tuning.update(device.tuning, ALPHA_MIN="1e-30f", TRANSMITTANCE_MIN="1e-30f")
    return opened


def forgets_released_buffers(info: DeviceInfo) -> bool:
    """Oclgrind 21.10 takes a buffer at the address of a released one for that one, with its size and uninitialized
    values: its check does not see releases.
    https://github.com/jrprice/Oclgrind/blob/v21.10/src/plugins/Uninitialized.h
    """
    return info.platform.startswith("Oclgrind")


@pytest.fixture(scope="session", autouse=True)
def keep_buffers() -> Iterator[None]:
    """Keep every buffer to the end where addresses must not be used twice."""
    allocate, held = Device.empty, []

    def empty(device: Device, *shape_and_type: Any) -> Array:
        array = allocate(device, *shape_and_type)
        if forgets_released_buffers(device.info):
            held.append(array.buffer)
        return array

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Device, "empty", empty)
        yield


@pytest.fixture(scope="session", autouse=True)
def share_contexts() -> Iterator[None]:
    """Every device of a session has one context, with programs that are built once: opening one more costs little."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(opencl_device, "create_context", functools.cache(opencl_device.create_context))
        patch.setattr(program, "build", functools.cache(program.build))
        yield


@pytest.fixture(scope="session", autouse=True)
def cache_parsed_yaml() -> Iterator[None]:
    """Texts of YAML are parsed, and plain data become text, once: tests read the shipped pipelines again and again."""
    parse, texts, write = functools.lru_cache(512)(yaml_file._parse), dict[str, str](), yaml_file.yaml_text

    def text_of(data: Any) -> str:
        key = repr(data)
        if key not in texts:
            if len(texts) == 512:
                texts.clear()
            texts[key] = write(data)
        return texts[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(yaml_file, "_parse", lambda *words: copy.deepcopy(parse(*words)))
        patch.setattr(loading, "yaml_text", text_of)
        yield


@pytest.fixture(scope="session", autouse=True)
def skip_fsync() -> Iterator[None]:
    """Tests need not sync files to disk. Child processes still do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", os.fstat)
        yield


@pytest.fixture
def without_plugins() -> Iterator[None]:
    """Forget the plug-ins that a test has loaded."""
    defined, readers = list(Settings.subclasses), list(Reader.subclasses)
    yield
    is_clean = not plugins._loaded and (Settings.subclasses, Reader.subclasses) == (defined, readers)
    Settings.subclasses[:], Reader.subclasses[:] = defined, readers
    plugins._loaded.clear()
    for name in [name for name in sys.modules if name.startswith("clsplat_plugin_")]:
        del sys.modules[name]
    if not is_clean:
        rebuild_models()


@pytest.fixture(scope="session", autouse=True)
def python_interrupts() -> None:
    """Enable interrupts, which background jobs of a shell ignore."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    """Random numbers that depend only on the test's name: a renamed test gets other data."""
    return np.random.default_rng(list(request.node.name.encode()))


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten views of the synthetic still life, 40 x 40 px, two of them held out."""
    folder = tmp_path_factory.mktemp("scene") / "tiny"
    write_dataset(folder, SyntheticOptions(size=40, train=8, test=2, seed=0), workers=1)
    return folder


@pytest.fixture(scope="session")
def few_steps(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of twelve steps; tests do not modify it."""

    out = tmp_path_factory.mktemp("runs") / "few"
    train(tiny_scene, out, *FEW)
    return out


@pytest.fixture
def killed_run(few_steps: Path, tmp_path: Path) -> Path:
    """The same run, killed after step 8."""
    return killed(few_steps, tmp_path / "run")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """An empty store of cells."""
    return Store(tmp_path / "store")


@pytest.fixture
def options(store: Store) -> CellOptions:
    """Options for running a cell."""
    return CellOptions(store.now())
