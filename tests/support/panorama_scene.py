"""The still life in a painted room, photographed in all directions: as panoramas, and by pinhole cameras."""

import json
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from clsplat.data_tools.casting import World, camera_pose
from clsplat.data_tools.shapes import Array, Cuboid, normalize, rotate
from clsplat.data_tools.still_life import mix, noise
from clsplat.data_tools.synthetic import STILL_LIFE, surface_points
from clsplat.scene.camera import FACES, panorama_lens
from clsplat.scene.images import write_image
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud

HALF, HIGH = 2.2, 1.2  # of the room, scene units
FACE_ANGLE = np.pi / 2
TEST_ANGLE = 1.2
TO_OPENGL = np.diag([1.0, -1.0, -1.0])


def plaster(color: tuple[float, float, float], p: Array) -> Array:
    """Checks that fade into each other."""
    checks = (np.sin(p[0] * 5) * np.sin(p[1] * 5) * np.sin(p[2] * 5 + 1) > 0) * 0.35
    return mix(mix(color, (0.9, 0.9, 0.85), checks), (0.1, 0.1, 0.12), 0.5 * noise(2 * p, 2))


def wall(axis: int, side: int) -> Cuboid:
    center, half = [0.0, 0.0, 0.4], [HALF, HALF, HIGH]
    center[axis] += side * (half[axis] + 0.1)
    half[axis] = 0.1
    color = ((0.7, 0.2, 0.15), (0.15, 0.5, 0.2), (0.2, 0.3, 0.7), (0.7, 0.6, 0.1), (0.4, 0.3, 0.25), (0.6, 0.7, 0.75))
    return Cuboid(center=tuple(center), half=tuple(half), paint=partial(plaster, color[2 * axis + (side > 0)]))


@dataclass(frozen=True)
class Room(World):
    """The still life in a room, without shadows."""

    def shade(self, points: Array, index: "np.ndarray", sample: int) -> Array:
        return self.by_shape(type(self.shapes[0]).texture, index, points)


class Panoramas(Room):
    """The same, photographed as panoramas twice as wide as high."""

    def camera_rays(self, pose: Array, size: int, x: Array, y: Array) -> tuple[Array, Array]:
        lens = panorama_lens(size, size // 2).camera
        right, down = (x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy
        through = np.array([np.cos(down) * np.sin(right), -np.sin(down), -np.cos(down) * np.cos(right)])
        return pose[:3, 3:], normalize(rotate(pose[:3, :3], through))

    def photograph(self, pose: Array, size: int) -> "np.ndarray":
        return self.render_rows(pose, size, range(size // 2))


WALLS = tuple(wall(axis, side) for axis in range(3) for side in (-1, 1))
ROOM = Room(tuple(STILL_LIFE.shapes) + WALLS, FACE_ANGLE, grid=2)
PANORAMAS = Panoramas(ROOM.shapes, FACE_ANGLE, grid=2)


def poses(count: int, radius: float, phase: float = 0.0) -> list[Array]:
    """Camera-to-world matrices, OpenGL axes, on a ring around the still life, each facing another way."""
    made = []
    for i in range(count):
        turn = 2 * np.pi * i / count + phase
        position = np.array([radius * np.cos(turn), radius * np.sin(turn), 0.55 + 0.3 * np.sin(3 * turn)])
        ahead = np.array([np.cos(2.4 * turn + phase), np.sin(2.4 * turn + phase), 0.0])
        made.append(camera_pose(position, normalize(ahead)))
    return made


def write_panoramas(folder: Path, count: int, width: int) -> None:
    """Write panoramas of the room as a nerfstudio dataset, with points."""
    frames = [
        write_frame(folder, f"pano_{i:02}.png", PANORAMAS, pose, width) for i, pose in enumerate(poses(count, 1.45))
    ]
    _finish(folder, {"camera_model": "EQUIRECTANGULAR"}, frames, count)


def write_pinholes(folder: Path, count: int, side: int) -> None:
    """Write pinhole photographs of all directions from the same places, with the same points."""
    frames = []
    for i, pose in enumerate(poses(count, 1.45)):
        for face, rotation in FACES.items():
            turned = pose.copy()
            turned[:3, :3] = pose[:3, :3] @ TO_OPENGL @ rotation.T @ TO_OPENGL
            frames.append(write_frame(folder, f"{i:02}_{face}.png", ROOM, turned, side))
    _finish(folder, {"camera_angle_x": FACE_ANGLE}, frames, count)


def write_tests(folder: Path, count: int, side: int) -> None:
    """Write pinhole photographs from other places, toward the still life and the walls."""
    world = replace(ROOM, camera_angle_x=TEST_ANGLE)
    frames = [
        write_frame(folder, f"test_{i:02}.png", world, pose, side) for i, pose in enumerate(poses(count, 1.3, 0.2))
    ]
    _finish(folder, {"camera_angle_x": TEST_ANGLE}, frames, 1)


def write_frame(folder: Path, name: str, world: World, pose: Array, size: int) -> dict:
    write_image(folder / "images" / name, world.photograph(pose, size)[..., :3])
    return {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}


def _finish(folder: Path, camera: dict, frames: list[dict], count: int) -> None:
    rng, points = np.random.default_rng(0), []
    for pose in poses(count, 1.45):
        view = PANORAMAS.photograph(pose, 128)
        full = np.concatenate([view, np.zeros((64, 128, 4), np.uint8)])  # the rays of a square, of which half are hit
        points.append(surface_points(PANORAMAS, pose, full, -(-6000 // count), 0.004, rng))
    positions, colors = (np.concatenate(parts).astype(np.float32) for parts in zip(*points, strict=True))
    write_points_ply(folder / "points3d.ply", PointCloud(positions, colors))
    table = {**camera, "ply_file_path": "points3d.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(table))
