"""Depth maps of other programs: fitted to points, and refused or dropped if they do not fit."""

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.photos.depths import MAX_PIXELS, MIN_POINTS, DepthMaps, PointDepths, fit_scale_and_offset
from clsplat.pipeline.input_files import content_hashes
from clsplat.pipeline.loading import load
from clsplat.render.camera import upload_camera
from tests.support.outdoor_scene import HEIGHT, WIDTH, Yard
from tests.support.runs import TWO_DOZEN, digest, train


def write_map(file: Path, inverse: np.ndarray, bits: int = 16, factor: float = 0.4, offset: float = 0.1) -> None:
    """A map in which inverse depths have a factor and an offset of their own."""
    file.parent.mkdir(parents=True, exist_ok=True)
    kind = np.uint16 if bits == 16 else np.uint8
    cv2.imwrite(str(file), np.rint((factor * inverse + offset) * np.iinfo(kind).max).astype(kind))


def ground(yard: Yard, view) -> np.ndarray:
    """Inverse depths of the ground, [HEIGHT, WIDTH]; 0 above the horizon."""
    down = yard.rays(view)[..., 1]
    return np.where(down > 0, np.clip(down, 0, 1.5), 0)  # the camera is 1 above it: depth along its axis is 1 / down


@pytest.fixture
def yard(rng, tmp_path) -> Yard:
    """A scene, with a folder of maps beside it."""
    yard = Yard(rng)
    yard.write(tmp_path / "scene")
    for number, view in enumerate(yard.views):
        write_map((tmp_path / "maps" / view.name), ground(yard, view), factor=0.3 + 0.02 * number)
    return yard


@pytest.mark.parametrize(("bits", "scale"), [(16, 1), (8, 1), (16, 2)])
def test_map_has_the_inverse_depths_of_the_points_in_any_unit(tmp_path, rng, bits, scale):
    inverse = cv2.GaussianBlur(rng.uniform(0.1, 1.5, (30, 40)).astype(np.float32), (0, 0), 4)
    write_map(tmp_path / "deep" / "a.png", np.kron(inverse, np.ones((scale, scale))), bits)
    rows, columns = rng.integers(0, 30, 50), rng.integers(0, 40, 50)
    told = inverse[rows, columns].copy()
    told[:5] *= 1.5  # wrong points
    found = DepthMaps(tmp_path).sample("deep/a.jpg", (40, 30), rows, columns, told)
    assert found is not None
    assert len(found[2]) == 1200
    np.testing.assert_allclose(found[2], inverse[found[0], found[1]], atol=2e-4 if bits == 16 else 1e-2)


def test_inconsistent_depth_maps_are_dropped_and_named(tmp_path, rng, caplog):
    """Those where dark is near, plain ones, and those of photographs with few points."""
    inverse = rng.uniform(0.1, 1.5, (30, 40))
    rows, columns = rng.integers(0, 30, 50), rng.integers(0, 40, 50)
    write_map(tmp_path / "dark.png", 2 - inverse)
    write_map(tmp_path / "plain.png", np.ones((30, 40)))
    write_map(tmp_path / "good.png", inverse)
    with caplog.at_level(logging.WARNING):
        for name in ("dark.jpg", "plain.jpg"):
            assert DepthMaps(tmp_path).sample(name, (40, 30), rows, columns, inverse[rows, columns]) is None
            assert f"{name}: ignoring the depth map, which does not fit the points" in caplog.text
    few = slice(0, MIN_POINTS - 1)
    assert fit_scale_and_offset(inverse[rows, columns][few], inverse[rows, columns][few]) is None
    assert DepthMaps(tmp_path).sample("good.jpg", (40, 30), rows, columns, inverse[rows, columns]) is not None


def test_large_map_is_compared_on_an_even_grid(tmp_path):
    inverse = np.linspace(0.1, 1.5, 400 * 300).reshape(300, 400)
    write_map(tmp_path / "a.png", inverse)
    rows, columns = np.arange(300), np.arange(300)
    found = DepthMaps(tmp_path).sample("a.jpg", (400, 300), rows, columns, inverse[rows, columns])
    assert found is not None
    assert MAX_PIXELS / 2 < len(found[0]) <= MAX_PIXELS
    assert set(np.diff(np.unique(found[0]))) == set(np.diff(np.unique(found[1]))) == {2}


def test_missing_or_damaged_map_is_named(tmp_path):
    with pytest.raises(DataError, match=r"a\.png: the depth map of a\.jpg is missing"):
        DepthMaps(tmp_path).read("a.jpg", 4, 3)
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(DataError, match=r"a\.png: "):
        DepthMaps(tmp_path).read("a.jpg", 4, 3)


def test_depths_match_the_ground_truth(device, yard, tmp_path):
    tracks = type("T", (), {"positions": yard.points.positions, "seen": {}})
    tracks.rows = {view.name: np.arange(len(yard.points)) for view in yard.views}
    names = [view.name for view in yard.views]
    depths = PointDepths(device, tracks, names, 1.0, DepthMaps(tmp_path / "maps"))
    for number, view in enumerate(yard.views[:3]):
        camera = upload_camera(device, view)
        known = depths.at(type(camera)(**{**vars(camera), "view_index": number}))
        assert known is not None
        places, inverse = known.pixels.get(), known.inverse.get()
        rows, columns = places // camera.stride, places % camera.stride
        assert len(places) > 0.4 * WIDTH * HEIGHT
        truth = ground(yard, view)[rows, columns]
        np.testing.assert_allclose(inverse, truth, atol=0.06)


@pytest.mark.slow
def test_training_uses_depth_maps_and_detects_changes(yard, tmp_path):
    losses = "[{type: l1, weight: 0.8}, {type: inverse_depth, weight: 0.3%s}]"
    folder = f", folder: '{tmp_path / 'maps'}'"
    scene = tmp_path / "scene"
    runs = [
        train(scene, tmp_path / name, *TWO_DOZEN, f"optimize.losses={losses % key}")
        for name, key in (("a", folder), ("b", ""))
    ]
    assert digest(runs[0].out) != digest(runs[1].out)
    asked = load("smoke", [f"scene.path='{scene}'", f"optimize.losses={losses % folder}"])
    before = content_hashes(asked)
    assert list(before) == [str(tmp_path / "maps")]
    write_map(tmp_path / "maps" / yard.views[0].name, ground(yard, yard.views[0]), bits=8)
    assert content_hashes(asked) != before
    two = losses.replace("%s}]", f"{folder}}}, {{type: inverse_depth}}]")
    with pytest.raises(ConfigError, match="is listed with two folders; keep only one"):
        train(scene, tmp_path / "c", *TWO_DOZEN, f"optimize.losses={two}")
