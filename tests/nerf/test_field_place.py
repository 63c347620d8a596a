"""Whether the photographs show the cube of a field's grid."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.core.errors import ConfigError
from clsplat.nerf.shape import FieldShape, GridShape
from clsplat.nerf.training import require_visible_grid
from clsplat.scene.camera import Camera
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.view import View

CAMERA = Camera(30, 20, 25.0, 24.0, 13.0, 11.0)
NEAR, FAR = 1.0, 3.0


def scene_of(tmp_path, *views: View, points: PointCloud | None = None) -> Scene:
    return Scene(tmp_path, views, tuple(range(len(views))), (), points, 1.0)


def is_seen(scene: Scene, corner, side: float) -> bool:
    shape = FieldShape(unit=1.0, near=NEAR, far=FAR, grid=GridShape(corner=[float(v) for v in corner], side=side))
    try:
        require_visible_grid(shape, scene)
    except ConfigError:
        return False
    return True


def test_cube_is_seen_if_a_view_samples_it(tmp_path):
    """Beside samples of all pixels: what has some is seen, and what is seen has some, but for the narrowest touch."""
    rng, seen = np.random.default_rng(0), 0
    view = View.looking_at([2.0, -1.0, 0.5], [0.0, 0.2, 0.0], [0.0, 0.0, 1.0], CAMERA)
    across, down, depth = np.meshgrid(np.linspace(0, 30, 41), np.linspace(0, 20, 41), np.linspace(NEAR, FAR, 41))
    places = np.stack([(across - 13) / 25 * depth, (down - 11) / 24 * depth, depth], axis=-1).reshape(-1, 3)
    samples = (places - view.world_to_camera[:, 3]) @ view.world_to_camera[:, :3]
    for _ in range(150):
        corner, side = rng.uniform(-3, 2, 3), float(rng.uniform(0.2, 2))
        result = is_seen(scene_of(tmp_path, view), corner, side)
        inside, within = (
            bool(((samples > corner - slack) & (samples < corner + side + slack)).all(axis=1).any())
            for slack in (0, 0.1)
        )
        assert inside <= result <= within
        seen += result
    assert 15 < seen < 100


def test_cube_needs_one_view_and_a_point_if_there_are_any(tmp_path):
    ahead = View.looking_at([0.0, 0.0, -2.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], CAMERA, "ahead")
    away = View.looking_at([0.0, 0.0, -2.0], [0.0, 0.0, -9.0], [0.0, 1.0, 0.0], CAMERA, "away")
    assert is_seen(scene_of(tmp_path, away, ahead), [-0.5] * 3, 1.0)
    assert not is_seen(scene_of(tmp_path, away), [-0.5] * 3, 1.0)
    points = PointCloud(np.array([[0.4, 0.0, 0.0], [9.0, 9.0, 9.0]], np.float32), np.zeros((2, 3), np.float32))
    assert is_seen(scene_of(tmp_path, ahead, points=points), [-0.5] * 3, 1.0)
    assert not is_seen(scene_of(tmp_path, ahead, points=points), [-0.5] * 3, 0.8)


def test_message_reports_the_scene_position(tmp_path):
    views = [
        View.looking_at([x, y, -2.0], [1.0, 2.0, 3.0], [0.0, 1.0, 0.0], CAMERA, f"{x}") for x, y in ((0, 0), (3, 1))
    ]
    scene = scene_of(tmp_path, *views)
    shape = FieldShape(unit=1.0, near=NEAR, far=FAR, grid=GridShape(corner=[20.0, 0.0, 0.0], side=1.0))
    with pytest.raises(
        ConfigError, match=r"train_field\.field\.grid: .* at depths from 1 to 3; .* the cameras .* look at \(1, 2, 3\)"
    ):
        require_visible_grid(shape, scene)
    require_visible_grid(shape.model_copy(update={"grid": None}), scene)
    require_visible_grid(replace_grid(shape, corner=[-3.0, -3.0, -3.0], side=6.0), replace(scene, points=None))


def replace_grid(shape: FieldShape, **values) -> FieldShape:
    return shape.model_copy(update={"grid": GridShape(**values)})
