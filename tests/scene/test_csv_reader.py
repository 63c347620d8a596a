"""A plug-in reader: examples/csv_reader.py."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.prepare.inspect.findings import Inspection
from clsplat.scene import Reader
from clsplat.scene.detect import is_scene, read_scene
from tests.support.orbit_scene import finding_text, orbit, write
from tests.support.refusals import refusal

EXAMPLE = Path(__file__).parents[2] / "examples" / "csv_reader.py"
HEADER = "name,qw,qx,qy,qz,tx,ty,tz,fx,fy,cx,cy,width,height"


@pytest.fixture
def _plugin() -> Iterator[None]:
    defined = list(Reader.subclasses)
    spec = importlib.util.spec_from_file_location("csv_reader", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield
    Reader.subclasses[:] = defined  # other tests expect shipped readers only


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A COLMAP scene whose folder of images has a cameras.csv too."""
    path = write(tmp_path / "scene", orbit())
    lines = [HEADER]
    for view in read_scene(path).views:
        x, y, z, w = Rotation.from_matrix(view.world_to_camera[:, :3]).as_quat().tolist()
        c, translation = view.camera, view.world_to_camera[:, 3].tolist()
        numbers = (w, x, y, z, *translation, c.fx, c.fy, c.cx, c.cy, c.width, c.height)
        lines.append(",".join([view.name, *map(repr, numbers)]))
    (path / "images" / "cameras.csv").write_text("\n".join(lines) + "\n")
    return path


def test_example_is_short():
    assert len(EXAMPLE.read_text().splitlines()) <= 35


@pytest.mark.usefixtures("_plugin")
def test_scene_equals_its_colmap_version(scene):
    original, read = read_scene(scene), read_scene(scene / "images")
    assert is_scene(scene / "images")
    assert (read.train, read.test, read.points) == (original.train, original.test, None)
    assert read.extent == pytest.approx(original.extent)
    for one, other in zip(read.views, original.views, strict=True):
        assert (one.name, one.camera, one.image_path) == (other.name, other.camera, other.image_path)
        np.testing.assert_allclose(one.world_to_camera, other.world_to_camera, atol=1e-12)


@pytest.mark.usefixtures("_plugin")
def test_inspection_matches_that_of_colmap(scene):
    expected, inspection = Inspection.from_folder(scene), Inspection.from_folder(scene / "images")
    assert (inspection.facts.kind, inspection.verdict) == ("CSV", "ready to train")
    for name in ("registered", "train", "test", "on_disk", "missing", "unregistered", "cameras", "photos"):
        assert getattr(inspection.facts, name) == getattr(expected.facts, name), name
    assert inspection.facts.extent == pytest.approx(expected.facts.extent)
    assert finding_text(inspection, "note").startswith("there are no points")


@pytest.mark.usefixtures("_plugin")
def test_missing_photograph_is_named(scene):
    (scene / "images" / "03.png").unlink()
    assert "03.png" in refusal(read_scene, scene / "images")
    assert "03.png" in finding_text(Inspection.from_folder(scene / "images"), "error")


@pytest.mark.usefixtures("_plugin")
@pytest.mark.parametrize(
    ("line", "old", "new"),
    [
        (1, "qw", "w"),
        (3, "64,48", "64"),
        (3, "64,48", "64,48,1"),
        (3, "64,48", "64,forty"),
        (3, "64,48", "0,48"),
        (3, "60.0,60.0", "nan,60.0"),
        (3, "60.0,60.0", "60.0,-1"),
        (3, "4.0,60.0", "inf,60.0"),
        (3, "01.png", "../01.png"),
        (3, "01.png,", "01.png,0,0,0,0,0,0,0,60,60,32,24,64,48\n"),
    ],
)
def test_damage_is_reported_with_file_and_line(scene, line, old, new):
    file = scene / "images" / "cameras.csv"
    lines = file.read_text().splitlines()
    assert old in lines[line - 1]
    lines[line - 1] = lines[line - 1].replace(old, new)
    file.write_text("\n".join(lines) + "\n")
    message = refusal(read_scene, scene / "images")
    assert f"{file}: line {line}: " in message
    assert not Inspection.from_folder(scene / "images").is_trainable


@pytest.mark.usefixtures("_plugin")
@pytest.mark.parametrize("content", [b"", b"\xff\xfe\0", HEADER.encode()])
def test_file_without_photographs_is_refused(scene, content):
    (scene / "images" / "cameras.csv").write_bytes(content)
    refusal(read_scene, scene / "images")
