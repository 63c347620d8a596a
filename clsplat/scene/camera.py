"""Pinhole cameras for rendering, and lenses with distortion for photographs."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property, lru_cache
from numbers import Integral
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote

MAX_SIDE = 4096 * 8  # px: tiles that cl_kernels/tiles.h can number, times the smallest tile size of a device
MAX_SOURCE = 32764  # px: a larger photograph cannot be cut by OpenCV
MIN_FOCAL = 1e-3  # px, in a dataset: a shorter one would cover half of all directions


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: image size, focal lengths and principal point, in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def check(self) -> "Camera":
        """Return the camera.

        Raises ValueError unless sizes are positive integers up to MAX_SIDE, focal lengths are positive, and all numbers
        are finite.
        """
        if not (isinstance(self.width, Integral) and isinstance(self.height, Integral)):
            raise ValueError(f"the camera is {self.width}x{self.height}; expected integers")
        if max(self.width, self.height) > MAX_SIDE:
            raise ValueError(f"the camera is {self.width}x{self.height} pixels; expected at most {MAX_SIDE} to a side")
        if min(self.width, self.height, self.fx, self.fy) <= 0 or not all(map(math.isfinite, astuple(self))):
            raise ValueError(
                f"the camera is {self.width}x{self.height} with focal lengths {self.fx}, {self.fy} and principal point "
                f"{self.cx}, {self.cy}; expected a positive size, positive focal lengths and finite numbers"
            )
        return self

    def zoomed(self, factor: float) -> "Camera":
        """Return the camera with both focal lengths multiplied by a factor."""
        return self if factor == 1 else replace(self, fx=factor * self.fx, fy=factor * self.fy)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the photograph resampled to another size."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    def downscaled(self, factor: float) -> "Camera":
        """Return the camera after dividing the image size by `factor`, rounded to whole pixels."""
        if factor == 1:
            return self
        return self.resized(max(1, round(self.width / factor)), max(1, round(self.height / factor)))


# Lenses with distortion: COLMAP's camera models, and undistortion of photographs.

Floats = NDArray[np.float64]
Distortion = Callable[..., tuple[Floats, Floats]]  # (u, v, k), or (x, y, k, z) of a direction for models of WIDE
BORDER_POINTS = 200  # per edge of a photograph
MAX_ROUNDS = 50  # iterations of Newton's method
MAX_ERROR = 1.0e-6  # of its result, normalized units
MAX_DIFFERENCE = 1.0e-3  # of a ray after distortion and undistortion, normalized units
MAX_TANGENT = 3**0.5  # tan of 60 degrees: beyond it, a pinhole image is mostly stretched edges
MAX_GROWTH = 2.0  # size of an undistorted photograph, relative to the original


def _radial(u: Floats, v: Floats, k: Sequence[float]) -> tuple[Floats, Floats]:
    r2 = u * u + v * v
    factor = 1 + sum(c * r2 ** (i + 1) for i, c in enumerate(k))
    return u * factor, v * factor


def _tangential(u: Floats, v: Floats, p1: float, p2: float) -> tuple[Floats, Floats]:
    r2 = u * u + v * v
    return 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def _opencv(u: Floats, v: Floats, k: Sequence[float]) -> tuple[Floats, Floats]:
    (x, y), (dx, dy) = _radial(u, v, k[:2]), _tangential(u, v, k[2], k[3])
    return x + dx, y + dy


def _full_opencv(u: Floats, v: Floats, k: Sequence[float]) -> tuple[Floats, Floats]:
    r2 = u * u + v * v
    factor = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
    dx, dy = _tangential(u, v, k[2], k[3])
    return u * factor + dx, v * factor + dy


def _fisheye(u: Floats, v: Floats, k: Sequence[float], z: Floats | None = None) -> tuple[Floats, Floats]:
    r = np.hypot(u, v)
    theta = np.arctan(r) if z is None else np.arctan2(r, z)
    angle = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k)))
    factor = np.where(r > 1e-12, angle / np.maximum(r, 1e-12), 1.0)
    return u * factor, v * factor


def _thin_prism(u: Floats, v: Floats, k: Sequence[float], z: Floats | None = None) -> tuple[Floats, Floats]:
    u, v = _fisheye(u, v, (), z)
    r2 = u * u + v * v
    (x, y), (dx, dy) = _radial(u, v, (k[0], k[1], k[4], k[5])), _tangential(u, v, k[2], k[3])
    return x + dx + k[6] * r2, y + dy + k[7] * r2


def _rad_tan_thin_prism(u: Floats, v: Floats, k: Sequence[float], z: Floats | None = None) -> tuple[Floats, Floats]:
    x, y = _radial(*_fisheye(u, v, (), z), k[:6])
    r2, (dx, dy) = x * x + y * y, _tangential(x, y, k[7], k[6])
    return x + dx + k[8] * r2 + k[9] * r2**2, y + dy + k[10] * r2 + k[11] * r2**2


def _fov(u: Floats, v: Floats, k: Sequence[float], z: Floats | None = None) -> tuple[Floats, Floats]:
    r, omega = np.hypot(u, v), k[0]
    if abs(omega) < 1e-9:
        return (u, v) if z is None else (u / z, v / z)
    slope = 2 * r * np.tan(omega / 2)
    radius = (np.arctan(slope) if z is None else np.arctan2(slope, z)) / omega
    factor = np.where(r > 1e-12, radius / np.maximum(r, 1e-12), 2 * np.tan(omega / 2) / omega)
    return u * factor, v * factor


def _division(u: Floats, v: Floats, k: Sequence[float], z: Floats | float = 1.0) -> tuple[Floats, Floats]:
    factor = 2 / (z + np.sqrt(z * z - 4 * k[0] * (u * u + v * v)))
    return u * factor, v * factor


def _eucm(u: Floats, v: Floats, k: Sequence[float], z: Floats | float = 1.0) -> tuple[Floats, Floats]:
    depth = k[0] * np.sqrt(k[1] * (u * u + v * v) + z * z) + (1 - k[0]) * z
    return u / depth, v / depth


def _equirectangular(u: Floats, v: Floats, k: Sequence[float], z: Floats | float = 1.0) -> tuple[Floats, Floats]:
    return np.arctan2(u, z), np.arctan2(v, np.hypot(u, z))


MODELS: dict[str, tuple[int, Distortion]] = {  # number of focal lengths, and the distortion function
    "SIMPLE_PINHOLE": (1, lambda u, v, k: (u, v)),
    "PINHOLE": (2, lambda u, v, k: (u, v)),
    "SIMPLE_RADIAL": (1, _radial),
    "RADIAL": (1, _radial),
    "OPENCV": (2, _opencv),
    "FULL_OPENCV": (2, _full_opencv),
    "FOV": (2, _fov),
    "OPENCV_FISHEYE": (2, _fisheye),
    "SIMPLE_RADIAL_FISHEYE": (1, _fisheye),
    "RADIAL_FISHEYE": (1, _fisheye),
    "THIN_PRISM_FISHEYE": (2, _thin_prism),
    "RAD_TAN_THIN_PRISM_FISHEYE": (2, _rad_tan_thin_prism),
    "SIMPLE_DIVISION": (1, _division),
    "DIVISION": (2, _division),
    "SIMPLE_FISHEYE": (1, _fisheye),
    "FISHEYE": (2, _fisheye),
    "EUCM": (2, _eucm),
    "EQUIRECTANGULAR": (2, _equirectangular),  # focal lengths in px per radian, instead of COLMAP's image size
}
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
WIDE = frozenset(MODELS) - frozenset(PERSPECTIVE)  # models that also cover directions behind the camera

# Wide photographs: panoramas and fisheyes of about 180 degrees or more are cut into the faces of a cube.

MIN_WIDE = math.radians(80)  # to one side of the image: a pinhole image would be 3.6 times as wide
MIN_CIRCLE = math.radians(100)  # a fisheye shows nothing beyond this angle and the nearest edge
RIM = 1.5  # px: samples at the edge of a fisheye's circle would mix with the dark pixels around it
FACE_TANGENT = 1.1  # tan of half the field of view of a face, 95 degrees: faces overlap
FACE_GRID = 128  # directions along a side at which the visible part of a face is measured
MIN_SHOWN = 0.02  # visible fraction of a face; faces with less are left out
ANGLES = 1801  # from 0 to 180 degrees
BLOCK = 1 << 20  # samples at a time
# rotations from the camera of the photograph to that of the face: its right, down, forward
FACES: dict[str, Floats] = {
    "front": np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]),
    "right": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "back": np.array([[-1.0, 0, 0], [0, 1, 0], [0, 0, -1]]),
    "left": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "up": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


@dataclass(frozen=True)
class Lens:
    """The camera of a distorted photograph: its size in pixels, and a model of MODELS with COLMAP's parameters."""

    width: int
    height: int
    model: str
    params: tuple[float, ...]
    whole: bool = False  # keep the whole photograph, with undefined pixels, instead of cropping them away
    face: str = field(default="", repr=False)  # a face of a wide photograph, from FACES; "": the photograph

    @property
    def _split(self) -> tuple[float, float, float, float, tuple[float, ...]]:
        focals = MODELS[self.model][0]
        cx, cy = self.params[focals : focals + 2]
        return self.params[0], self.params[focals - 1], cx, cy, self.params[focals + 2 :]

    @property
    def has_distortion(self) -> bool:
        """Whether the lens has distortion; a fisheye lens always has."""
        return "FISHEYE" in self.model or self.model == "EQUIRECTANGULAR" or any(self._split[4])

    @cached_property
    def _angles(self) -> tuple[Floats, float]:
        """The angles (rad) of view to the left, right, top and bottom, [4], and the angle where the lens folds back."""
        fx, fy, cx, cy, rest = self._split
        angle, sides, folds = np.linspace(0, np.pi, ANGLES), [], []
        sizes = cx / fx, (self.width - cx) / fx, cy / fy, (self.height - cy) / fy
        for (x, y), size in zip(((-1, 0), (1, 0), (0, -1), (0, 1)), sizes, strict=True):
            with np.errstate(all="ignore"):
                u, v = MODELS[self.model][1](x * np.sin(angle), y * np.sin(angle), rest, np.cos(angle))
                radius = x * u + y * v
                rises = np.diff(radius) > 0
            folds.append(angle[np.argmin(rises)] if not rises.all() else np.pi)
            is_outside = radius > size
            sides.append(min(folds[-1], angle[np.argmax(is_outside)] if is_outside.any() else np.pi))
        return np.array(sides), min(folds)

    @cached_property
    def is_wide(self) -> bool:
        """Whether the field of view is too wide for one pinhole image, so that the photograph is cut into faces."""
        is_panorama = self.model == "EQUIRECTANGULAR"
        return is_panorama or (self.model in WIDE and bool(self._angles[0].max() > MIN_WIDE))

    @cached_property
    def faces(self) -> tuple["Lens", ...]:
        """The front of a wide photograph, and the other faces that show MIN_SHOWN or more.  Raises DataError."""
        lenses = [intern_lens(replace(self, face=face, whole=self.model != "EQUIRECTANGULAR")) for face in FACES]
        return tuple(lens for lens in lenses if lens.face == "front" or lens._visible_grid.mean() >= MIN_SHOWN)

    @cached_property
    def _visible_grid(self) -> NDArray[np.bool_]:
        """Which points of `_face_grid` the photograph shows, [FACE_GRID, FACE_GRID]."""
        return self._sees(*_face_grid())

    def _directions(self, u: Floats, v: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the directions x, y, z in the camera of the photograph, from normalized coordinates of the face."""
        x, y, z = np.moveaxis(np.stack([u, v, np.ones_like(u)], axis=-1) @ FACES[self.face or "front"], -1, 0)
        return x, y, z

    def _sees(self, u: Floats, v: Floats) -> NDArray[np.bool_]:
        """Return which rays, in normalized coordinates of the face, the wide photograph shows."""
        if self.model == "EQUIRECTANGULAR":
            return np.ones(u.shape, bool)
        (sides, fold), (x, y, z) = self._angles, self._directions(u, v)
        angle = np.arctan2(np.hypot(x, y), z)
        with np.errstate(all="ignore"):
            x, y = self.distort(x, y, z)
            inside = (x >= 0) & (y >= 0) & (x <= self.width) & (y <= self.height)
        circle = max(sides.min(), MIN_CIRCLE) - RIM / self._split[0]
        return np.asarray(inside & (angle < min(fold, circle)))

    def shows_white(self, mask: NDArray[Any]) -> bool:
        """Return whether a face shows a white pixel of a mask, [H, W, C], of the photograph."""
        u, v = np.stack(_face_grid())[:, self._visible_grid]
        x, y = self.distort(*self._directions(u, v))
        height, width = mask.shape[:2]
        rows, columns = (y * height / self.height).astype(int), (x * width / self.width).astype(int)
        return bool((mask[np.minimum(rows, height - 1), np.minimum(columns, width - 1), 0] > 0).any())

    def _face_camera(self) -> Camera:
        """Return the camera of the smallest part of a face that contains everything visible in the photograph.

        In the center, its pixels are as large as those of the photograph.  Raises DataError for an implausible camera.
        """
        focal = max(self._split[:2])
        side = 2 * math.ceil(FACE_TANGENT * focal)
        longest = max(self.width, self.height)
        if side > MAX_GROWTH * longest or longest > MAX_SOURCE:
            raise DataError(
                f"the {self.model} camera is {self.width}x{self.height} with focal lengths {self._split[:2]}; expected "
                f"at most {MAX_SOURCE} px to a side and focal lengths that fit: calibrate the camera again"
            )
        if not self._visible_grid.any():
            raise self._error("shows nothing")
        spans = [np.flatnonzero(self._visible_grid.any(axis=axis)) for axis in (0, 1)]  # columns, rows
        (x0, x1), (y0, y1) = (
            (max(0, int((i[0] - 1) / FACE_GRID * side)), min(side, int((i[-1] + 2) / FACE_GRID * side))) for i in spans
        )
        return Camera(x1 - x0, y1 - y0, focal, focal, side / 2 - x0, side / 2 - y0)

    def _blocks(self, samples: int) -> Iterator[tuple[slice, Floats, Floats]]:
        """Yield a block of rows of the face, and the normalized coordinates of its rays as `_rays` does."""
        step = max(1, BLOCK // (self.pinhole.width * samples**2))
        for row in range(0, self.pinhole.height, step):
            rows = slice(row, row + step)
            yield rows, *_rays(self.pinhole, rows, samples)

    def _extract_face(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the face of a wide photograph, [H, W, C]; each pixel is the mean of 2 x 2 rays."""
        camera, border = self.pinhole, int(self.model == "EQUIRECTANGULAR")
        if border:  # add a column from the opposite side, which a panorama continues on
            pixels = np.concatenate([pixels[:, -1:], pixels, pixels[:, :1]], axis=1)
        face = np.empty((camera.height, camera.width, pixels.shape[2]), pixels.dtype)
        for rows, u, v in self._blocks(2):
            with np.errstate(all="ignore"):
                x, y = (np.nan_to_num(p - 0.5).astype(np.float32) for p in self.distort(*self._directions(u, v)))
            rays = cv2.remap(pixels, x + np.float32(border), y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            shape = face[rows].shape
            face[rows] = cv2.resize(rays, shape[1::-1], interpolation=cv2.INTER_AREA).reshape(shape)
        return face

    def distort(self, u: Floats, v: Floats, *z: Floats) -> tuple[Floats, Floats]:
        """Return the pixel coordinates of normalized coordinates, or of directions (u, v, z) for models of WIDE."""
        fx, fy, cx, cy, rest = self._split
        x, y = MODELS[self.model][1](u, v, rest, *z)
        return fx * x + cx, fy * y + cy

    def project(self, points: Floats) -> Floats:
        """Return the pixel coordinates, [M, 2], of points in camera space, [M, 3]; for a wide lens, also behind it."""
        x, y, z = points.T
        return np.stack(self.distort(x, y, z) if self.is_wide else self.distort(x / z, y / z), axis=1)

    def undistort(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the normalized coordinates of pixels by Newton's method; NaN where it does not converge."""
        fx, fy, cx, cy, rest = self._split
        distortion = MODELS[self.model][1]
        goal = np.stack([(x.ravel() - cx) / fx, (y.ravel() - cy) / fy])
        point, active = goal.copy(), np.arange(x.size)
        with np.errstate(all="ignore"):
            for _ in range(MAX_ROUNDS):
                previous = point[:, active]
                point[:, active] = current = _newton_step(distortion, rest, previous, goal[:, active])
                # a point whose bits did not change will never change
                active = active[(previous.view(np.int64) != current.view(np.int64)).any(axis=0)]
                if not active.size:
                    break
            error = np.abs(np.stack(distortion(point[0], point[1], rest)) - goal)
            u, v = np.where((error < MAX_ERROR).all(axis=0), point, np.nan)
        return u.reshape(x.shape), v.reshape(x.shape)

    @property
    def camera(self) -> Camera:
        """The camera without distortion, at the size of the photograph."""
        return Camera(self.width, self.height, *self._split[:4])

    @cached_property
    def pinhole(self) -> Camera:
        """The camera of the undistorted photograph, with the same focal lengths.

        It shows the largest rectangle in which all pixels are defined.  With `whole`, it shows the smallest
        rectangle that contains the photograph, up to 60 degrees to each side and twice the size.  Raises DataError when
        there is no such rectangle.  For a wide photograph, it is the camera of the face.
        """
        if self.is_wide:
            return self._face_camera()
        fx, fy, _, _, _ = self._split
        x, y = np.linspace(0, self.width, BORDER_POINTS), np.linspace(0, self.height, BORDER_POINTS)
        left = self.undistort(np.zeros(BORDER_POINTS), y)[0]
        right = self.undistort(np.full(BORDER_POINTS, float(self.width)), y)[0]
        top = self.undistort(x, np.zeros(BORDER_POINTS))[1]
        bottom = self.undistort(x, np.full(BORDER_POINTS, float(self.height)))[1]
        if not all(np.isfinite(side).any() for side in (left, right, top, bottom)):
            raise self._error("cannot be inverted")
        u0, u1, v0, v1 = np.nanmax(left), np.nanmin(right), np.nanmax(top), np.nanmin(bottom)
        if self.whole:
            border_u, border_v = np.concatenate([left, right]), np.concatenate([top, bottom])
            max_u, max_v = self.width * (MAX_GROWTH / 2) / fx, self.height * (MAX_GROWTH / 2) / fy
            u0, u1 = max(np.nanmin(border_u), -MAX_TANGENT, -max_u), min(np.nanmax(border_u), MAX_TANGENT, max_u)
            v0, v1 = max(np.nanmin(border_v), -MAX_TANGENT, -max_v), min(np.nanmax(border_v), MAX_TANGENT, max_v)
        width, height = int((u1 - u0) * fx), int((v1 - v0) * fy)
        if min(width, height) < 1:
            raise self._error("leaves no pixel undistorted")
        return Camera(width, height, fx, fy, float(-u0 * fx), float(-v0 * fy))

    def _error(self, fault: str) -> DataError:
        return DataError(f"the lens {self.model} {quote(self.params)} {fault}; calibrate the camera again")

    def undistort_image(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the photograph undistorted to the camera `pinhole`, [H, W, C] of the same type."""
        if self.is_wide:
            return self._extract_face(pixels)
        undistorted = cv2.remap(pixels, *_maps(self), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return undistorted.reshape(self.pinhole.height, self.pinhole.width, -1)

    @cached_property
    def shown(self) -> NDArray[np.bool_]:
        """Which pixels of `pinhole`, [H, W], the photograph covers: their rays distort into it and back."""
        if self.is_wide:
            return np.concatenate([self._sees(u, v) for _, u, v in self._blocks(1)])
        u, v = _rays(self.pinhole)
        x, y = self.distort(u, v)
        back_u, back_v = self.undistort(x, y)
        inside = (x >= 0) & (y >= 0) & (x <= self.width) & (y <= self.height)
        return inside & (np.abs(back_u - u) < MAX_DIFFERENCE) & (np.abs(back_v - v) < MAX_DIFFERENCE)


def _rays(camera: Camera, rows: slice = slice(0, MAX_SIDE), samples: int = 1) -> tuple[Floats, Floats]:
    """Return the normalized coordinates of samples x samples rays in each pixel of some rows, [H, W] each."""
    x, y = ((np.arange(size * samples) + 0.5) / samples for size in (camera.width, camera.height))
    y = y[rows.start * samples : rows.stop * samples]
    u, v = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    return u, v


def _face_grid() -> tuple[Floats, Floats]:
    """Return the normalized coordinates of FACE_GRID x FACE_GRID points of a face."""
    positions = FACE_TANGENT * (2 * (np.arange(FACE_GRID) + 0.5) / FACE_GRID - 1)
    u, v = np.meshgrid(positions, positions)
    return u, v


def panorama_lens(width: int, height: int) -> Lens:
    """Return the lens of a panorama that covers the sphere; the middle of the image is forward, its top is up."""
    return Lens(width, height, "EQUIRECTANGULAR", (width / math.tau, height / math.pi, width / 2, height / 2))


def _newton_step(distortion: Distortion, k: Sequence[float], point: Floats, goal: Floats) -> Floats:
    """Return the points, [2, M], after one step of Newton's method toward those that distort to `goal`."""
    step, (u, v) = 1e-7, point
    a, b = distortion(u, v, k)
    au, bu = distortion(u + step, v, k)
    av, bv = distortion(u, v + step, k)
    j00, j10, j01, j11 = (au - a) / step, (bu - b) / step, (av - a) / step, (bv - b) / step
    det = j00 * j11 - j01 * j10
    da, db = goal[0] - a, goal[1] - b
    return np.stack([u + (j11 * da - j01 * db) / det, v + (j00 * db - j10 * da) / det])


@lru_cache(maxsize=2)  # for portrait and landscape photographs of a phone; 8 bytes per pixel each
def _maps(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the position in the photograph of each pixel of `pinhole`, [H, W] each, for OpenCV's integer centers."""
    x, y = lens.distort(*_rays(lens.pinhole))
    return (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32)


@lru_cache(maxsize=64)
def intern_lens(lens: Lens) -> Lens:
    """Return the first lens that equals this one, so that views share its slow properties `pinhole` and `shown`."""
    return lens
