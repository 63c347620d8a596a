"""Only regular files are read: pipes, devices, sockets and folders are refused at once, in one sentence."""

import os
import socket
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path

import pytest

from clsplat.conformance.bench.measurement import read_measurement
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.reading import read_file, read_json
from clsplat.formats.table import detect
from clsplat.formats.table import read as read_ply
from clsplat.metrics.perceptual import Lpips
from clsplat.pipeline.loading import load
from clsplat.scene.colmap import read_cameras_binary, read_cameras_text
from clsplat.scene.images import read_header, read_image
from clsplat.scene.points import read_points_ply
from clsplat.scene.transforms_json import Transforms
from clsplat.training.records import Records
from tests.support.timeouts import failing


@pytest.fixture(autouse=True)
def bounded() -> Iterator[None]:
    """Fail a test whose reader blocks for some seconds."""
    with failing("the reader waits", seconds=20):
        yield


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


NOT_FILES: dict[str, Callable[[Path], object]] = {
    "a pipe": lambda path: os.mkfifo(path),  # which not every system has
    "a folder": Path.mkdir,
    "a socket": make_socket,
    "a device": lambda path: path.symlink_to("/dev/zero"),
}
READERS: dict[str, Callable[[Path], object]] = {
    "model": read_ply,
    "kind of model": detect,
    "points": read_points_ply,
    "image": read_image,
    "image header": read_header,
    "transforms": Transforms,
    "COLMAP binary": lambda path: list(read_cameras_binary(path)),
    "COLMAP text": lambda path: list(read_cameras_text(path)),
    "LPIPS": lambda path: Lpips(path, "0..1"),
    "file": read_file,
    "JSON": read_json,
}


@pytest.mark.parametrize(("reader", "what"), list(zip(READERS, cycle(NOT_FILES), strict=False)))
def test_reading_a_non_regular_file_is_a_data_error(reader, what, tmp_path):
    path = tmp_path / "x"
    NOT_FILES[what](path)
    with pytest.raises(DataError, match=rf"/x: cannot be read \(it is {what}\); expected "):
        READERS[reader](path)


@pytest.mark.parametrize(("name", "what"), [("x.yaml", "a pipe"), ("x", "a socket"), ("x.yaml", "a device")])
def test_pipeline_that_is_not_a_regular_file_is_a_config_error(name, what, tmp_path):
    NOT_FILES[what](tmp_path / name)
    with pytest.raises(ConfigError, match=rf"cannot be read \(it is {what}\); expected a pipeline file"):
        load(str(tmp_path / name))


def test_benchmark_that_is_not_a_regular_file_is_a_config_error(tmp_path):
    NOT_FILES["a pipe"](tmp_path / "x")
    with pytest.raises(ConfigError, match=r"cannot be read \(it is a pipe\); expected the JSON"):
        read_measurement(tmp_path / "x", "splat")


def test_records_that_are_a_pipe_are_refused(tmp_path):
    os.mkfifo(tmp_path / "metrics.jsonl")
    with pytest.raises(DataError, match="it is a pipe"):
        Records(tmp_path).read()


@pytest.mark.parametrize("name", ["\0", "\ud800", "n" * 5000])
def test_impossible_file_name_is_refused(name):
    with pytest.raises(DataError, match="cannot be read"):
        read_file(Path(name))


def test_file_larger_than_expected_is_not_read(tmp_path):
    with (tmp_path / "x").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(DataError, match="it has 1099511627776 bytes, more than the limit of 1000"):
        read_file(tmp_path / "x", limit=1000)
    with pytest.raises(DataError, match="bytes, more than the limit of 2147483647"):
        read_image(tmp_path / "x")
    with pytest.raises(DataError, match="bytes, more than the limit of 134217728"):
        Transforms(tmp_path / "x")
    with pytest.raises(ConfigError, match="bytes, more than the limit of 1048576"):
        load(str(tmp_path / "x"))


def test_only_the_vertices_of_a_model_are_read(tmp_path):
    """The data after them may be long."""
    path = tmp_path / "x.ply"
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    with path.open("r+b") as file:
        file.truncate(1 << 40)
    with pytest.raises(DataError, match="not a splat file"):
        read_ply(path)


@pytest.mark.parametrize("text", ["{", "[" * 100_000, "\xff", "9" * 5000])
def test_invalid_json_is_refused_in_one_line(text, tmp_path):
    (tmp_path / "x").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=r"^.*/x: not a JSON file \(.*\); expected a JSON file: create it again$"):
        read_json(tmp_path / "x")
