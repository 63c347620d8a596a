"""Checkpoint files: round trips, and detection of all damage."""

import os

import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.training import archive
from tests.support.runs import written

pytestmark = pytest.mark.slow


NOTES = {"format": 4, "step": 7, "text": "é"}
ARRAYS = {"gaussians/means": np.arange(6, dtype=np.float32).reshape(2, 3), "none": np.zeros((2, 0), np.float32)}


def test_archive_round_trips_and_numpy_reads_it(tmp_path):
    (tmp_path / "a.npz").write_bytes(written(NOTES, ARRAYS))
    notes, arrays = archive.read(tmp_path / "a.npz")
    assert notes == NOTES
    assert arrays.keys() == ARRAYS.keys()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(arrays[name], array)
            np.testing.assert_array_equal(file[name], array)


@pytest.mark.parametrize("mask", [0xFF, 0x01, 0x80])
def test_every_changed_byte_is_detected_or_harmless(mask, tmp_path):
    data, file = written(NOTES, ARRAYS), tmp_path / "a.npz"
    noticed = 0
    for place in range(len(data)):
        file.write_bytes(data[:place] + bytes([data[place] ^ mask]) + data[place + 1 :])
        try:
            notes, arrays = archive.read(file)
        except DataError:
            noticed += 1
            continue
        assert notes == NOTES, place
        assert arrays.keys() == ARRAYS.keys(), place
        for name, array in ARRAYS.items():
            assert arrays[name].dtype == np.float32
            np.testing.assert_array_equal(arrays[name], array, err_msg=str(place))
    assert noticed > 0.7 * len(data)


def test_every_truncation_and_size_change_is_detected(tmp_path):
    data, file = written(NOTES, ARRAYS), tmp_path / "a.npz"
    for size in range(len(data)):
        file.write_bytes(data[:size])
        with pytest.raises(DataError):
            archive.read(file)
    for fault in (b"", data[: len(data) // 2] * 2, os.urandom(4000)):
        file.write_bytes(fault)
        with pytest.raises(DataError):
            archive.read(file)


def test_sizes_are_compared_with_the_file_before_reading(tmp_path, monkeypatch):
    data, file = written(NOTES, ARRAYS), tmp_path / "a.npz"
    at = data.rindex(b"PK\x01\x02")  # in the list of contents: both sizes of the last member
    file.write_bytes(data[: at + 20] + b"\xf0\xff\xff\x7f" * 2 + data[at + 28 :])
    monkeypatch.setattr("zipfile.ZipFile.read", lambda *arguments: pytest.fail("was read"))
    with pytest.raises(DataError, match=r"declares more bytes than the file has \(\d+\)"):
        archive.read(file)
