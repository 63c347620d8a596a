"""Which kernels the tests of this folder launch, for the test that every kernel has one."""

from pathlib import Path
from typing import Any

import pytest

from clsplat.opencl.program import Kernel

FOLDER = Path(__file__).parent
LAST = "test_every_kernel_was_launched"
LAUNCHED = pytest.StashKey[set[tuple[str, str]]]()
WHOLE = pytest.StashKey[bool]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[LAUNCHED] = set()
    config.stash[WHOLE] = True


def pytest_deselected(items: list[pytest.Item]) -> None:
    if items:
        items[0].config.stash[WHOLE] = False


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put the test that looks back behind all others; note whether the whole folder is there."""
    items.sort(key=lambda item: item.name == LAST)
    collected = {item.path for item in items}
    parts = any("::" in argument for argument in config.args)
    if parts or config.getoption("--one-each") or not collected >= set(FOLDER.glob("test_*.py")):
        config.stash[WHOLE] = False


@pytest.fixture(autouse=True)
def recorded(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Note (schedule, file:kernel) of every launch."""
    call, launched = Kernel.__call__, request.config.stash[LAUNCHED]

    def noted(kernel: Kernel, **values: Any) -> None:
        call(kernel, **values)
        amount = values.get("items") or values.get("groups") or 0
        if 0 not in (amount if isinstance(amount, tuple) else (amount,)):
            launched.add((kernel._device.schedule, kernel.label))

    monkeypatch.setattr(Kernel, "__call__", noted)


@pytest.fixture
def launched(request: pytest.FixtureRequest) -> set[tuple[str, str]]:
    """(schedule, file:kernel) of what was launched; skips where only a part of the tests is run."""
    if not request.config.stash[WHOLE]:
        pytest.skip("only a part of the kernel tests is run")
    return request.config.stash[LAUNCHED]
