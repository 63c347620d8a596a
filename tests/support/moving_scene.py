"""A dynamic still life: a ball flies, a book turns and a lamp pulses, seen by fixed, synchronized cameras.

Cameras and timestamps are exact.  Some cameras and some timestamps are held out: no training view uses them.  Static
masks of the test cameras mark the pixels that are bit-identical at all timestamps, shadows included.  To keep many
pixels static, moving shapes cast shadows of the key light, but do not block the faint skylight.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.core.progress import counted
from clsplat.data_tools.casting import World, camera_pose
from clsplat.data_tools.shapes import Array, Cuboid, Cylinder, Shape, Sphere, Vector
from clsplat.data_tools.still_life import (
    SCENE_RADIUS,
    book_cover,
    candy,
    chessboard,
    die,
    dotted,
    globe,
    marble,
    mix,
    noise,
    planks,
    tin,
)
from clsplat.data_tools.synthetic import (
    CAMERA_DISTANCE,
    LOOK_AT,
    SyntheticOptions,
    photographs,
    surface_points,
    write_transforms,
)
from clsplat.scene.images import write_image
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud

MOVING_VERSION = 1  # increase it when the images change
HELD_OUT, FIRST_HELD_OUT = 5, 2  # every fifth timestamp, from the third on
AZIMUTHS = -150.0, -30.0  # degrees: the arc of the cameras around the table
HEIGHTS = (20.0, 36.0, 52.0)  # degrees, of the training cameras in turn; test cameras use the middle one
FLIGHT, FLIGHT_RADIUS, FLIGHT_TOP = (-160.0, -20.0), 0.85, 0.45  # of the ball: degrees, then scene units
BOOK_YAW = (15.0, 165.0)  # degrees, first and last
BALL, BOOK = 0.13, (0.16, 0.10, 0.20)  # radius and half sides
LAMP_PULSES = 1.5


def lamp(brightness: float, p: Array) -> Array:
    """Ribbed paper, scaled by the brightness of the lamp."""
    paper = mix((0.95, 0.62, 0.20), (0.80, 0.42, 0.10), noise(np.array([9 * p[0], 9 * p[1], 60 * p[2]]), 2))
    return mix(paper, (0.20, 0.06, 0.02), np.abs(p[2] * 22 % 1 - 0.5) < 0.08) * brightness


def ball_center(time: float) -> Vector:
    """Return the center of the ball at a time in [0, 1]: it leaps along an arc around the table."""
    angle = np.radians(FLIGHT[0] + (FLIGHT[1] - FLIGHT[0]) * time)
    height = BALL + FLIGHT_TOP * np.sin(np.pi * time)
    return float(FLIGHT_RADIUS * np.cos(angle)), float(FLIGHT_RADIUS * np.sin(angle)), float(height)


STATIC_SHAPES: tuple[Shape, ...] = (
    Cylinder(center=(0, 0, -0.05), radius=SCENE_RADIUS, half=0.05, paint=planks, yaw=25),
    Cuboid(center=(0.02, 0.0, 0.03), half=(0.52, 0.52, 0.03), paint=chessboard, yaw=-22),
    Sphere(center=(-0.12, 0.14, 0.39), radius=0.33, paint=globe, tilt=23, yaw=40),
    Cylinder(center=(0.40, 0.16, 0.28), radius=0.17, half=0.22, paint=tin, yaw=10),
    Cuboid(center=(0.20, -0.30, 0.145), half=(0.085, 0.085, 0.085), paint=die, yaw=33),
    Sphere(center=(-0.42, 0.85, 0.16), radius=0.16, paint=marble),
    Cylinder(center=(0.30, 0.86, 0.26), radius=0.075, half=0.26, paint=candy),
)


def shapes_at(time: float) -> tuple[Shape, ...]:
    """Return the shapes at a time in [0, 1]."""
    brightness = 0.55 + 0.45 * np.cos(2 * np.pi * LAMP_PULSES * time)
    return (
        *STATIC_SHAPES,
        Sphere(center=ball_center(time), radius=BALL, paint=dotted, yaw=30, tilt=20),
        Cuboid(
            center=(0.80, 0.42, BOOK[2]),
            half=BOOK,
            yaw=BOOK_YAW[0] + (BOOK_YAW[1] - BOOK_YAW[0]) * time,
            paint=partial(book_cover, (0.42, 0.03, 0.04), BOOK),
        ),
        Sphere(center=(-0.74, 0.42, 0.15), radius=0.15, paint=partial(lamp, brightness)),
    )


@dataclass(frozen=True)
class Moving(SyntheticOptions):
    """Options of the dynamic scene: image size in pixels, training and test cameras, timestamps, seed of the points."""

    size: int = 160
    train: int = 10
    test: int = 2
    times: int = 30

    version = MOVING_VERSION
    points = 12_000

    def time_indices(self, split: str) -> list[int]:
        """Return the indices of the timestamps of a split: all for test, all but the held-out ones for training."""
        return [i for i in range(self.times) if split == "test" or i % HELD_OUT != FIRST_HELD_OUT]

    def time(self, time_index: int) -> float:
        """Return the time in [0, 1] of a timestamp."""
        return time_index / max(1, self.times - 1)

    def world_at(self, time_index: int) -> World:
        """Return the scene at a timestamp."""
        return World(shapes_at(self.time(time_index)), camera_angle_x=0.69, grid=3, occluders=STATIC_SHAPES)

    def poses(self) -> dict[str, list[Array]]:
        """Return the camera-to-world matrices of each split; test cameras are between training cameras."""
        train = [(i + 0.5) / self.train for i in range(self.train)]
        test = [(i + 1.0) / (self.test + 1) for i in range(self.test)]
        test = [fraction + 0.25 / self.train * bool(np.isclose(fraction, train).any()) for fraction in test]
        return {
            "train": [self._pose(fraction, HEIGHTS[i % 3]) for i, fraction in enumerate(train)],
            "test": [self._pose(fraction, HEIGHTS[1]) for fraction in test],
        }

    @staticmethod
    def _pose(fraction: float, elevation: float) -> Array:
        """Return the pose at a fraction of the arc and an elevation in degrees."""
        azimuth, elevation = np.radians(AZIMUTHS[0] + (AZIMUTHS[1] - AZIMUTHS[0]) * fraction), np.radians(elevation)
        ring = np.cos(elevation)
        backward = np.array([ring * np.cos(azimuth), ring * np.sin(azimuth), np.sin(elevation)])
        return camera_pose(LOOK_AT + CAMERA_DISTANCE * backward, backward)

    def frames(self) -> list[tuple[str, int, int]]:
        """Return split, camera index and time index of every photograph, camera by camera."""
        splits = self.poses().items()
        return [(split, i, t) for split, poses in splits for i in range(len(poses)) for t in self.time_indices(split)]

    def images(self) -> list[str]:
        """Return the image files of a finished dataset, including static masks."""
        return [f"{_name(*frame)}.png" for frame in self.frames()] + [_static(i) for i in range(self.test)]

    def write_files(self, out: Path, workers: int) -> str:
        """Write images, static masks, cameras and points into `out`; return a summary."""
        frames, poses = self.frames(), self.poses()
        rng, points = np.random.default_rng(self.seed), list[tuple[Array, Array, Array]]()
        points_per_view = -(-self.points // sum(split == "train" for split, _, _ in frames))
        minimum: dict[int, NDArray[np.uint8]] = {}
        maximum: dict[int, NDArray[np.uint8]] = {}
        images = photographs(partial(_photograph, self), frames, workers)
        for (split, i, time_index), image in zip(frames, counted(images, "images rendered", len(frames)), strict=True):
            write_image(out / f"{_name(split, i, time_index)}.png", image)
            if split == "train":
                world, pose = self.world_at(time_index), poses[split][i]
                surface = surface_points(world, pose, image, points_per_view, self.noise, rng)
                points.append((*surface, np.full(len(surface[0]), self.time(time_index))))
            else:
                minimum[i] = np.minimum(minimum.get(i, image), image)
                maximum[i] = np.maximum(maximum.get(i, image), image)
        for i in minimum:
            static = (minimum[i] == maximum[i]).all(axis=2) & (minimum[i][..., 3] == 255)
            write_image(out / _static(i), np.repeat(np.where(static, 255, 0).astype(np.uint8)[..., None], 3, axis=2))
        for split in poses:
            write_transforms(out / f"transforms_{split}.json", self.world_at(0), self._transforms(split))
        positions, colors, times = (np.concatenate(parts).astype(np.float32) for parts in zip(*points, strict=True))
        write_points_ply(out / "points3d.ply", PointCloud(positions, colors, times))
        count = sum(split == "train" for split, _, _ in frames)
        return (
            f"{count} training views of {self.train} cameras and {len(frames) - count} test views of {self.test}, "
            f"{self.times} timestamps, {self.size} px, {len(positions):,} points"
        )

    def _transforms(self, split: str) -> list[dict[str, object]]:
        """Return the frames of a split in the layout of D-NeRF, with the static masks of the test views."""
        poses = self.poses()[split]
        return [
            {
                "file_path": f"./{_name(split, i, t)}",
                "time": self.time(t),
                **({"static_path": f"./{_static(i)}"} if split == "test" else {}),
                "transform_matrix": poses[i].tolist(),
            }
            for _, i, t in (frame for frame in self.frames() if frame[0] == split)
        ]


def _photograph(options: Moving, frame: tuple[str, int, int]) -> NDArray[np.uint8]:
    split, i, time_index = frame
    return options.world_at(time_index).photograph(options.poses()[split][i], options.size)


def _name(split: str, camera: int, time_index: int) -> str:
    return f"{split}/camera_{camera:02}/{time_index:04}"


def _static(camera: int) -> str:
    return f"static/camera_{camera:02}.png"
