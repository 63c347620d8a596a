"""The visual hull of silhouettes: known shapes, unseen regions, and photographs without transparency."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.scene import visual_hull
from clsplat.scene.camera import Camera
from clsplat.scene.view import View, load_rgba
from clsplat.scene.visual_hull import Silhouette, hull_points
from tests.support.silhouettes import RADIUS, SIZE, ball, ring


def test_ball_is_reconstructed_with_its_colors():
    points = hull_points(ring(), np.zeros(3), 1.0, ball, 4000, 0)
    assert len(points) == 4000
    radius = np.linalg.norm(points.positions, axis=1)
    assert np.abs(radius - RADIUS).max() < 0.05, "no point lies on the planes that few silhouettes leave"
    assert np.abs(radius.mean() - RADIUS) < 0.02
    expected = (points.positions / radius[:, None] + 1) / 2
    assert np.median(np.abs(points.colors - expected)) < 0.03


@pytest.mark.parametrize("count", [100, 1000, 20_000])
def test_cell_size_follows_the_number_of_points(count):
    points = hull_points(ring(), np.zeros(3), 1.0, ball, count, 0)
    assert len(points) == count
    error = np.abs(np.linalg.norm(points.positions, axis=1) - RADIUS)
    assert np.median(error) < 0.5 * np.sqrt(4 * np.pi * RADIUS**2 / count) + 0.5 * 4 / 150, "half a cell, half a pixel"


def test_points_depend_only_on_the_seed():
    first, second, other = (hull_points(ring(), np.zeros(3), 1.0, ball, 500, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.colors, second.colors)
    assert not np.array_equal(first.positions, other.positions)


def test_one_inconsistent_silhouette_empties_the_hull():
    """A cell that lies outside the silhouette of a single view is empty."""
    views = ring()
    points = hull_points(
        views,
        np.zeros(3),
        1.0,
        lambda v: ball(v, center=(0, 0, 0.9) if v is views[7] else (0, 0, 0), radius=0.3),
        500,
        0,
    )
    assert not len(points)


def narrow_views() -> list[View]:
    """Views that see half a unit to each side of the origin."""
    camera = Camera(SIZE, SIZE, 450, 450, SIZE / 2, SIZE / 2)
    return [View(view.name, camera, view.world_to_camera) for view in ring()]


def narrow_ball(view: View, center=(0.0, 0.0, 0.0), radius=0.3) -> np.ndarray:
    """The middle of a picture three times as large."""
    wide = ball(View(view.name, ring(1)[0].camera, view.world_to_camera), center, radius)
    large = cv2.resize(wide, None, fx=3, fy=3)
    middle = (len(large) - SIZE) // 2
    return large[middle : middle + SIZE, middle : middle + SIZE]


def test_views_that_miss_a_cell_do_not_carve_it():
    """Of a ball beside the axis, which a third of the views do not show."""
    points = hull_points(narrow_views(), np.zeros(3), 1.0, lambda view: narrow_ball(view, (0.3, 0, 0), 0.2), 500, 0)
    near = np.linalg.norm(points.positions - [0.3, 0, 0], axis=1)
    assert (np.abs(near - 0.2) < 0.06).mean() > 0.9


def test_cells_seen_by_few_views_are_dropped():
    """The corners of the box lie in the images of a few views, which see the ball before them or behind."""
    points = hull_points(narrow_views(), np.zeros(3), 1.3, narrow_ball, 2000, 0)
    assert len(points) > 1000
    assert np.abs(np.linalg.norm(points.positions, axis=1) - 0.3).max() < 0.05


def test_point_on_the_border_of_an_image_has_a_pixel_or_none(rng):
    """Single precision: a quotient may round up to the height of the image."""
    camera = Camera(400, 225, 555, 555, 200, 112.5)
    silhouette = Silhouette(View("a", camera, np.eye(3, 4)), np.zeros((225, 400, 4), np.uint8))
    depth = rng.uniform(1, 9, 200_000).astype(np.float32)
    edge = rng.choice([0, 225], len(depth))
    points = np.stack([np.zeros_like(depth), (edge - 112.5) / 555 * depth, depth], axis=1).astype(np.float32)
    place = silhouette.project(points)
    assert 0 < place.is_inside.sum() < len(points), "rounding goes both ways"
    assert place.row.min() >= 0
    assert place.row.max() < 225


def test_alpha_that_ends_below_255_is_opaque():
    def matte(view: View) -> np.ndarray:
        return np.minimum(ball(view), 254)

    assert len(hull_points(ring(), np.zeros(3), 1.0, matte, 500, 0)) == 500


def test_hull_reads_a_few_downscaled_images(monkeypatch):
    monkeypatch.setattr(visual_hull, "LONG_SIDE", 60)
    monkeypatch.setattr(visual_hull, "MAX_VIEWS", 20)
    sizes = []

    def load(view: View) -> np.ndarray:
        sizes.append((view.camera.width, view.camera.height))
        return cv2.resize(ball(view), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)

    points = hull_points(ring(), np.zeros(3), 1.0, load, 500, 0)
    assert sizes == [(60, 60)] * 20
    assert np.median(np.abs(np.linalg.norm(points.positions, axis=1) - RADIUS)) < 0.06


@pytest.mark.parametrize("alpha", [0, 255])
def test_fully_transparent_or_opaque_images_have_no_hull(alpha):
    image = np.full((SIZE, SIZE, 4), alpha, np.uint8)
    assert not len(hull_points(ring(), np.zeros(3), 0.3, lambda view: image, 500, 0))


def test_photographs_without_transparency_have_no_hull():
    assert not len(hull_points(ring(), np.zeros(3), 1.0, lambda view: None, 500, 0))


def test_cameras_inside_the_box_or_facing_away():
    views = ring()
    inside = View.looking_at([0.7, 0, 0], [0, 0, 0], [0, 0, 1], views[0].camera, name="inside")
    away = View.looking_at([4, 0, 0], [8, 0, 0], [0, 0, 1], views[0].camera, name="away")
    points = hull_points([*views, inside, away], np.zeros(3), 1.0, ball, 1000, 0)
    assert len(points) == 1000
    assert np.abs(np.linalg.norm(points.positions, axis=1) - RADIUS).max() < 0.06


def test_rgba_is_read_at_the_size_of_the_view(tmp_path: Path):
    """At half the size; not of one that has none, or whose alpha is a mask."""
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (8, 12, 4), np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), pixels[:, :, [2, 1, 0, 3]])
    cv2.imwrite(str(tmp_path / "b.png"), pixels[:, :, :3])
    camera = Camera(12, 8, 10, 10, 6, 4)
    view = View("a.png", camera, np.eye(3, 4), tmp_path / "a.png")
    np.testing.assert_array_equal(load_rgba(view), pixels)
    small = load_rgba(view.resized(2))
    np.testing.assert_allclose(small, pixels.reshape(4, 2, 6, 2, 4).mean(axis=(1, 3)), atol=0.51)
    assert load_rgba(View("b.png", camera, np.eye(3, 4), tmp_path / "b.png")) is None
    assert load_rgba(View("a.png", camera, np.eye(3, 4), tmp_path / "a.png", alpha="mask")) is None
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((8, 12), 255, np.uint8))
    masked = View("a.png", camera, np.eye(3, 4), tmp_path / "a.png", mask_path=tmp_path / "mask.png")
    assert load_rgba(masked) is None, "pixels that do not count show no silhouette"
    deep = (pixels.astype(np.uint16) * 257)[:, :, [2, 1, 0, 3]]
    cv2.imwrite(str(tmp_path / "c.png"), deep)
    shutil.copy(tmp_path / "c.png", tmp_path / "d.png")
    np.testing.assert_array_equal(load_rgba(View("d.png", camera, np.eye(3, 4), tmp_path / "d.png")), pixels)
