"""Left-out photographs are matched with more photographs if not all pairs were matched."""

import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

from clsplat.core.errors import DataError
from clsplat.prepare import mapping
from clsplat.prepare.features import FeatureOptions, find_features
from clsplat.prepare.mapping import map_cameras
from clsplat.prepare.matching import expand_pairs, match_features, match_pairs
from clsplat.scene.detect import read_scene
from tests.support.data_sets import data_set
from tests.support.pictures import blocks

ROOT = Path(__file__).parents[2]
LAST = "9.jpg"  # far in the row of names from those beside which it was taken
MODEL = ("cameras.bin", "images.bin", "points3D.bin")


@pytest.fixture(scope="module")
def matches(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven photographs of a walk, two of other places, and one of the walk, each matched with the next two."""
    pytest.importorskip("pycolmap")
    folder = tmp_path_factory.mktemp("row")
    walk = [view.image_path for view in sorted(read_scene(data_set("fox_opencv")).views, key=lambda view: view.name)]
    for name in ("photographs", "features", "matches"):
        (folder / name).mkdir()
    for number, path in enumerate([*walk[:3], *walk[4:8]]):
        shutil.copy(path, folder / "photographs" / f"{number}.jpg")
    height, width = cv2.imread(str(walk[0])).shape[:2]
    for number in (7, 8):
        cv2.imwrite(str(folder / "photographs" / f"{number}.jpg"), blocks(number, width, height))
    shutil.copy(walk[3], folder / "photographs" / LAST)
    find_features(folder / "photographs", folder / "features", FeatureOptions(480, 1200))
    match_features(folder / "features", folder / "matches", "sequential", 2)
    return folder / "matches"


def test_unmatched_pairs_are_proposed(matches):
    every = [(f"{number}.jpg", LAST) for number in range(7)]
    assert expand_pairs(matches / "database.db", {LAST}) == every, "no more than the 17 that were looked at"
    strangers = expand_pairs(matches / "database.db", {"7.jpg", "8.jpg", LAST})
    assert {"2.jpg", "3.jpg"} <= {a for a, b in strangers if b == LAST}, "18 would be more: the most similar ones"
    assert len(strangers) <= 17
    assert all(sum(name in pair for pair in strangers) <= 17 // 3 for name in ("7.jpg", "8.jpg", LAST))
    assert expand_pairs(matches / "database.db", set()) == []


def test_exhaustive_matching_leaves_no_pairs(matches, tmp_path):
    shutil.copy(matches / "database.db", tmp_path)
    names = [f"{number}.jpg" for number in range(10)]
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    match_pairs(tmp_path / "database.db", pairs, 1)
    assert expand_pairs(tmp_path / "database.db", set(names)) == []


def test_names_with_spaces_get_no_pairs(matches, tmp_path, caplog):
    pycolmap = pytest.importorskip("pycolmap")
    shutil.copy(matches / "database.db", tmp_path)
    rows = pycolmap.Database.open(str(tmp_path / "database.db"))
    image = rows.read_image_with_name("3.jpg")
    image.name = "3 .5.jpg"
    rows.update_image(image)
    rows.close()
    assert [a for a, _ in expand_pairs(tmp_path / "database.db", {LAST})] == [
        f"{number}.jpg" for number in range(7) if number != 3
    ]
    assert "'3 .5.jpg': COLMAP's pair lists do not allow spaces" in caplog.text


@pytest.mark.parametrize(
    ("step", "error"),
    [("expand_pairs", cv2.error("K > 0")), ("match_pairs", DataError("cannot match"))],
    ids=["looking for pairs", "matching them"],
)
def test_failing_expansion_loses_neither_model_nor_features(matches, tmp_path, monkeypatch, caplog, step, error):
    def fail(_: Path, pairs: list[tuple[str, str]] | set[str], *threads: int) -> None:
        if pairs:
            raise error

    caplog.set_level("INFO")
    monkeypatch.setattr(mapping, step, fail)
    monkeypatch.setattr(mapping, "DENSER", FeatureOptions(480, 1400))
    figures = map_cameras(matches, tmp_path, attempts=3 if step == "expand_pairs" else 4)
    assert figures["registered"] >= 7
    assert f"skipping a failed attempt: {error}" in caplog.text
    assert [text for text in caplog.messages if text.endswith("retrying with denser features")]


def test_expansion_registers_a_photograph_after_a_kill(matches, tmp_path, caplog):
    for name in ("whole", "half"):
        (tmp_path / name).mkdir()
    figures = map_cameras(matches, tmp_path / "whole", attempts=3)
    assert figures["attempt"] == "more pairs"
    assert figures["not_registered"] == ["7.jpg", "8.jpg"]
    killed = f"""
import os, signal, threading, time
from pathlib import Path
from clsplat.prepare import mapping
from clsplat.prepare import matching
out = Path({str(tmp_path / "half")!r})
def kill():
    while not (out / mapping.WIDER).exists() or matching.count_matched_pairs(out / mapping.WIDER) < 20:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGKILL)
threading.Thread(target=kill, daemon=True).start()
mapping.map_cameras(Path({str(matches)!r}), out, attempts=3)
"""
    assert subprocess.run([sys.executable, "-c", killed], cwd=ROOT).returncode == -signal.SIGKILL
    caplog.set_level("INFO")
    caplog.clear()
    map_cameras(matches, tmp_path / "half", attempts=3)
    more = len(expand_pairs(matches / "database.db", {"7.jpg", "8.jpg", LAST}))
    (message,) = [text for text in caplog.messages if "that include unregistered photos" in text]
    assert int(message.split()[1]) < more, "what was matched before the kill is kept"
    for name in MODEL:
        whole, half = ((tmp_path / folder / "sparse" / "0" / name).read_bytes() for folder in ("whole", "half"))
        assert whole == half, name
