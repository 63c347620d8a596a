"""A still life in which a ball flies, a book turns and a lamp pulses, seen by fixed cameras at the same moments.

Cameras and moments are exact.  Some cameras and some moments are held out: no training view has one of either.  Which
pixels of a test camera show nothing that moves is known too: there all its photographs are equal to the bit, shadows
included.  For that, what moves keeps the light of the lamp above off other things, but not the faint light of the sky.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.core.progress import counted
from clsplat.scene.images import write_image
from clsplat.scene.points import write_points_ply
from clsplat.scene.scene import PointCloud

from .casting import World, camera_pose
from .shapes import Array, Cuboid, Cylinder, Shape, Sphere, Vector
from .still_life import (
    SCENE_RADIUS,
    bound,
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
from .synthetic import CAMERA_DISTANCE, LOOK_AT, SyntheticOptions, photographs, surface_points, write_transforms

MOVING_VERSION = 1  # increase it when the images change
HELD_OUT, FIRST_HELD_OUT = 5, 2  # of the moments: every fifth, from the third on
ROUND = -150.0, -30.0  # degrees: where the cameras stand about the table
HEIGHTS = (20.0, 36.0, 52.0)  # degrees, of the training cameras in turn; the test cameras have the middle one
FLIGHT, FLIGHT_RADIUS, FLIGHT_TOP = (-160.0, -20.0), 0.85, 0.45  # of the ball: degrees, scene units, above its start
TURN = (15.0, 165.0)  # degrees, of the book
BALL, BOOK = 0.13, (0.16, 0.10, 0.20)  # radius and half sides
PULSES = 1.5  # of the lamp


def lamp(brightness: float, p: Array) -> Array:
    """Paper with ribs, as bright as the moment says."""
    paper = mix((0.95, 0.62, 0.20), (0.80, 0.42, 0.10), noise(np.array([9 * p[0], 9 * p[1], 60 * p[2]]), 2))
    return mix(paper, (0.20, 0.06, 0.02), np.abs(p[2] * 22 % 1 - 0.5) < 0.08) * brightness


def flight(time: float) -> Vector:
    """Where the ball is: on an arc about the table, in a leap."""
    angle = np.radians(FLIGHT[0] + (FLIGHT[1] - FLIGHT[0]) * time)
    height = BALL + FLIGHT_TOP * np.sin(np.pi * time)
    return float(FLIGHT_RADIUS * np.cos(angle)), float(FLIGHT_RADIUS * np.sin(angle)), float(height)


STANDING: tuple[Shape, ...] = (
    Cylinder(center=(0, 0, -0.05), radius=SCENE_RADIUS, half=0.05, paint=planks, yaw=25),
    Cuboid(center=(0.02, 0.0, 0.03), half=(0.52, 0.52, 0.03), paint=chessboard, yaw=-22),
    Sphere(center=(-0.12, 0.14, 0.39), radius=0.33, paint=globe, tilt=23, yaw=40),
    Cylinder(center=(0.40, 0.16, 0.28), radius=0.17, half=0.22, paint=tin, yaw=10),
    Cuboid(center=(0.20, -0.30, 0.145), half=(0.085, 0.085, 0.085), paint=die, yaw=33),
    Sphere(center=(-0.42, 0.85, 0.16), radius=0.16, paint=marble),
    Cylinder(center=(0.30, 0.86, 0.26), radius=0.075, half=0.26, paint=candy),
)


def shapes_at(time: float) -> tuple[Shape, ...]:
    """Return the scene at a moment in [0, 1]."""
    brightness = 0.55 + 0.45 * np.cos(2 * np.pi * PULSES * time)
    return (
        *STANDING,
        Sphere(center=flight(time), radius=BALL, paint=dotted, yaw=30, tilt=20),
        Cuboid(
            center=(0.80, 0.42, BOOK[2]),
            half=BOOK,
            yaw=TURN[0] + (TURN[1] - TURN[0]) * time,
            paint=partial(bound, (0.42, 0.03, 0.04), BOOK),
        ),
        Sphere(center=(-0.74, 0.42, 0.15), radius=0.15, paint=partial(lamp, brightness)),
    )


@dataclass(frozen=True)
class Moving(SyntheticOptions):
    """Options of the dynamic scene: image size in pixels, training and test cameras, moments, seed of the points."""

    size: int = 160
    train: int = 10
    test: int = 2
    times: int = 30

    version = MOVING_VERSION
    points = 12_000

    def moments(self, split: str) -> list[int]:
        """The numbers of the moments that a split has: all in the test, all but the held-out ones in the training."""
        return [i for i in range(self.times) if split == "test" or i % HELD_OUT != FIRST_HELD_OUT]

    def time(self, moment: int) -> float:
        """A moment in [0, 1]."""
        return moment / max(1, self.times - 1)

    def world_at(self, moment: int) -> World:
        """What is photographed at a moment."""
        return World(shapes_at(self.time(moment)), camera_angle_x=0.69, grid=3, canopy=STANDING)

    def poses(self) -> dict[str, list[Array]]:
        """Camera-to-world matrices of the cameras of each split."""
        seen = [(i + 0.5) / self.train for i in range(self.train)]
        held_out = [(i + 1.0) / (self.test + 1) for i in range(self.test)]
        apart = [place + 0.25 / self.train * bool(np.isclose(place, seen).any()) for place in held_out]
        return {
            "train": [self._pose(place, HEIGHTS[i % 3]) for i, place in enumerate(seen)],
            "test": [self._pose(place, HEIGHTS[1]) for place in apart],
        }

    @staticmethod
    def _pose(place: float, height: float) -> Array:
        angle, above = np.radians(ROUND[0] + (ROUND[1] - ROUND[0]) * place), np.radians(height)
        backward = np.array([np.cos(above) * np.cos(angle), np.cos(above) * np.sin(angle), np.sin(above)])
        return camera_pose(LOOK_AT + CAMERA_DISTANCE * backward, backward)

    def frames(self) -> list[tuple[str, int, int]]:
        """Split, number of the camera in it, and moment of every photograph, camera by camera."""
        splits = self.poses().items()
        return [(split, i, t) for split, poses in splits for i in range(len(poses)) for t in self.moments(split)]

    def images(self) -> list[str]:
        """The files of a finished data set besides its cameras, points and manifest."""
        return [f"{_name(*frame)}.png" for frame in self.frames()] + [_static(i) for i in range(self.test)]

    def fill(self, out: Path, workers: int) -> str:
        """Write images, static masks, cameras and points into `out`; return a line of text about them."""
        frames, poses = self.frames(), self.poses()
        rng, seen = np.random.default_rng(self.seed), list[tuple[Array, Array, Array]]()
        share = -(-self.points // sum(split == "train" for split, _, _ in frames))
        least: dict[int, NDArray[np.uint8]] = {}
        most: dict[int, NDArray[np.uint8]] = {}
        images = photographs(partial(_photograph, self), frames, workers)
        for (split, i, moment), image in zip(frames, counted(images, "images rendered", len(frames)), strict=True):
            write_image(out / f"{_name(split, i, moment)}.png", image)
            if split == "train":
                world, pose = self.world_at(moment), poses[split][i]
                found = surface_points(world, pose, image, share, self.noise, rng)
                seen.append((*found, np.full(len(found[0]), self.time(moment))))
            else:
                least[i] = np.minimum(least.get(i, image), image)
                most[i] = np.maximum(most.get(i, image), image)
        for i in least:
            still = (least[i] == most[i]).all(axis=2) & (least[i][..., 3] == 255)
            write_image(out / _static(i), np.repeat(np.where(still, 255, 0).astype(np.uint8)[..., None], 3, axis=2))
        for split in poses:
            write_transforms(out / f"transforms_{split}.json", self.world_at(0), self._transforms(split))
        positions, colors, times = (np.concatenate(parts).astype(np.float32) for parts in zip(*seen, strict=True))
        write_points_ply(out / "points3d.ply", PointCloud(positions, colors, times))
        count = sum(split == "train" for split, _, _ in frames)
        return (
            f"{count} training views of {self.train} cameras and {len(frames) - count} test views of {self.test}, "
            f"{self.times} moments, {self.size} px, {len(positions):,} points"
        )

    def _transforms(self, split: str) -> list[dict[str, object]]:
        """Cameras and moments of a split, in the layout of D-NeRF, with the static masks of the test views."""
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
    split, i, moment = frame
    return options.world_at(moment).photograph(options.poses()[split][i], options.size)


def _name(split: str, camera: int, moment: int) -> str:
    return f"{split}/camera_{camera:02}/{moment:04}"


def _static(camera: int) -> str:
    return f"static/camera_{camera:02}.png"
