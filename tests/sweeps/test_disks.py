"""A store's disk is full, truncates a file, or has two mount points: every cell is published once with its bits.

They take a minute, and run where those of kills do; a full disk and two mount points need the right to mount.
"""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.support.cells import KILLS
from tests.support.sweeps import Sweep, hashes_without_store, until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not KILLS, reason="CLSPLAT_KILLS=20 runs it: a minute")]
CELLS = 2


@pytest.fixture(scope="module")
def expected(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("expected")
    return hashes_without_store(Sweep(folder, tiny_scene, CELLS, "inline"), folder / "out")


@contextmanager
def mounted(place: Path, *words: str) -> Iterator[None]:
    """Mount something at a place for the block; the test is skipped where that is not allowed."""
    place.mkdir()
    if subprocess.run(["mount", *words, str(place)], capture_output=True).returncode:
        pytest.skip("needs the right to mount")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def stopped_by(sweep: Sweep, number: signal.Signals) -> None:
    """Run a sweep until it has saved, and end it."""
    process = sweep.start()
    until(lambda: len(sweep.saved()) > 1)
    process.send_signal(number)
    process.communicate()


def finish(sweep: Sweep, expected: dict[str, str]) -> None:
    process = sweep.start()
    errors = process.communicate()[1]
    assert process.returncode == 0, errors
    assert sweep.models() == expected
    assert sweep.events("publish") == CELLS


def test_sweep_resumes_after_a_full_disk(tiny_scene, tmp_path, expected):
    sweep = Sweep(tmp_path, tiny_scene, CELLS, "inline")
    with mounted(sweep.store.root, "-t", "tmpfs", "-o", "size=1m", "tmpfs"):
        process = sweep.start()
        errors = process.communicate()[1]
        assert process.returncode != 0
        assert "No space left on device" in errors
        assert "Traceback" not in errors
        assert not sweep.events("publish")
        subprocess.run(["mount", "-o", "remount,size=500m", str(sweep.store.root)], check=True)
        finish(sweep, expected)


def test_truncated_newest_checkpoint_is_skipped(tiny_scene, tmp_path, expected):
    sweep = Sweep(tmp_path, tiny_scene, CELLS, "inline")
    stopped_by(sweep, signal.SIGKILL)
    newest = Path(max(sweep.saved()))
    newest.write_bytes(newest.read_bytes()[: newest.stat().st_size // 2])
    finish(sweep, expected)
    assert any(event.get("from") for event in sweep.store.events()), "it went on from the one before"


def test_store_resumes_under_another_mount_point(tiny_scene, tmp_path, expected):
    sweep = Sweep(tmp_path, tiny_scene, CELLS, "inline")
    sweep.store.root.mkdir()
    elsewhere = tmp_path / "elsewhere"
    with mounted(elsewhere, "--bind", str(sweep.store.root)):
        stopped_by(sweep, signal.SIGTERM)
        sweep.on.write_text(sweep.on.read_text().replace(str(sweep.store.root), str(elsewhere)))
        finish(sweep, expected)
        assert any(event.get("from") for event in sweep.store.events()), "it went on from a checkpoint"


def test_cancelled_sweep_resumes(tiny_scene, tmp_path, expected):
    sweep = Sweep(tmp_path, tiny_scene, CELLS, "inline")
    process = sweep.start()
    until(lambda: bool(sweep.saved()))
    subprocess.run([sys.executable, "-m", "clsplat", "cancel", str(sweep.store.root)], check=True, capture_output=True)
    errors = process.communicate()[1]
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    finish(sweep, expected)
