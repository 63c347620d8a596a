"""Define pinhole cameras for rendering, and lenses with distortion for photographs."""

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

MAX_SIDE = 4096 * 8  # px: tiles per side that cl_kernels/tiles.h can index, times the smallest tile size
MAX_PHOTO_SIDE = 32764  # px: OpenCV cannot remap larger photographs
MIN_FOCAL = 1e-3  # px, in a dataset: a shorter focal length means a field of view of almost 180 degrees


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with image size, focal lengths and principal point, all in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def check(self) -> "Camera":
        """Validate the camera and return it.

        Raises ValueError unless the size is two positive integers up to MAX_SIDE, the focal lengths are positive, and
        all values are finite.
        """
        if not (isinstance(self.width, Integral) and isinstance(self.height, Integral)):
            raise ValueError(f"the camera is {self.width}x{self.height}; expected an integer width and height")
        if max(self.width, self.height) > MAX_SIDE:
            raise ValueError(f"the camera is {self.width}x{self.height} pixels; expected at most {MAX_SIDE} per side")
        if min(self.width, self.height, self.fx, self.fy) <= 0 or not all(map(math.isfinite, astuple(self))):
            raise ValueError(
                f"the camera is {self.width}x{self.height} with focal lengths {self.fx}, {self.fy} and principal point "
                f"{self.cx}, {self.cy}; expected a positive size, positive focal lengths and finite numbers"
            )
        return self

    def zoomed(self, factor: float) -> "Camera":
        """Return the camera with both focal lengths multiplied by `factor`."""
        return self if factor == 1 else replace(self, fx=factor * self.fx, fy=factor * self.fy)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the image resampled to `width` x `height` pixels."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    def downscaled(self, factor: float) -> "Camera":
        """Return the camera with its image size divided by `factor` and rounded to whole pixels."""
        if factor == 1:
            return self
        return self.resized(max(1, round(self.width / factor)), max(1, round(self.height / factor)))


# Lenses with distortion: COLMAP's camera models, and undistortion of photographs.

Floats = NDArray[np.float64]
Distortion = Callable[..., tuple[Floats, Floats]]  # f(u, v, k), or f(x, y, k, z) for directions in WIDE models
BORDER_POINTS = 200  # points per edge of a photograph
MAX_ITERATIONS = 50  # iterations of Newton's method
MAX_ERROR = 1.0e-6  # largest error of the result of Newton's method, normalized units
MAX_DIFFERENCE = 1.0e-3  # largest error of a ray after distortion and undistortion, normalized units
MAX_TANGENT = 3**0.5  # tan of 60 degrees: beyond it, a pinhole image is mostly stretched edges
MAX_GROWTH = 2.0  # largest side of an undistorted photograph, relative to the original


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

# beyond MIN_WIDE, a pinhole image would be several times as wide as the photograph
MIN_WIDE = math.radians(80)  # smallest angle from the optical axis to a side of a wide photograph
MIN_CIRCLE = math.radians(100)  # a fisheye shows nothing beyond this angle or the angle of its nearest edge
RIM = 1.5  # px: samples at the edge of a fisheye's circle would mix with the dark pixels around it
FACE_TANGENT = 1.1  # tan of half the field of view of a face, 95 degrees: faces overlap
FACE_GRID = 128  # grid points per side at which the visible part of a face is measured
MIN_VISIBLE = 0.02  # visible fraction of a face below which the face is left out
ANGLE_COUNT = 1801  # number of samples from 0 to 180 degrees
BLOCK = 1 << 20  # rays processed at a time
# rotations from the photograph's camera to the face's camera; the rows are the face's right, down, and forward axes
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
    """The camera of a distorted photograph: its size in pixels, and a model from MODELS with COLMAP's parameters."""

    width: int
    height: int
    model: str
    params: tuple[float, ...]
    keep_border: bool = False  # keep the entire photograph, surrounded by undefined pixels, instead of cropping it
    face: str = field(default="", repr=False)  # a face of a wide photograph, from FACES; "": the photograph itself

    @property
    def _intrinsics(self) -> tuple[float, float, float, float, tuple[float, ...]]:
        focal_count = MODELS[self.model][0]
        cx, cy = self.params[focal_count : focal_count + 2]
        return self.params[0], self.params[focal_count - 1], cx, cy, self.params[focal_count + 2 :]

    @property
    def has_distortion(self) -> bool:
        """Whether the lens has distortion; always true for fisheye lenses and panoramas."""
        return "FISHEYE" in self.model or self.model == "EQUIRECTANGULAR" or any(self._intrinsics[4])

    @cached_property
    def _angles(self) -> tuple[Floats, float]:
        """The angles of view to the left, right, top and bottom, [4] rad, and the fold angle, rad.

        Beyond the fold angle, the distorted radius no longer increases with the angle from the optical axis.
        """
        fx, fy, cx, cy, coefficients = self._intrinsics
        angle, side_angles, fold_angles = np.linspace(0, np.pi, ANGLE_COUNT), [], []
        sizes = cx / fx, (self.width - cx) / fx, cy / fy, (self.height - cy) / fy
        for (x, y), size in zip(((-1, 0), (1, 0), (0, -1), (0, 1)), sizes, strict=True):
            with np.errstate(all="ignore"):
                u, v = MODELS[self.model][1](x * np.sin(angle), y * np.sin(angle), coefficients, np.cos(angle))
                radius = x * u + y * v
                is_rising = np.diff(radius) > 0
            fold_angles.append(angle[np.argmin(is_rising)] if not is_rising.all() else np.pi)
            is_outside = radius > size
            side_angles.append(min(fold_angles[-1], angle[np.argmax(is_outside)] if is_outside.any() else np.pi))
        return np.array(side_angles), min(fold_angles)

    @cached_property
    def is_wide(self) -> bool:
        """Whether the field of view is too wide for one pinhole image, so that the photograph is split into faces."""
        is_panorama = self.model == "EQUIRECTANGULAR"
        return is_panorama or (self.model in WIDE and bool(self._angles[0].max() > MIN_WIDE))

    @cached_property
    def faces(self) -> tuple["Lens", ...]:
        """The lenses of the faces of a wide photograph.

        These are the front face, and every other face whose visible fraction is at least MIN_VISIBLE.
        """
        lenses = [intern_lens(replace(self, face=face, keep_border=self.model != "EQUIRECTANGULAR")) for face in FACES]
        return tuple(lens for lens in lenses if lens.face == "front" or lens._visible_grid.mean() >= MIN_VISIBLE)

    @cached_property
    def _visible_grid(self) -> NDArray[np.bool_]:
        """A mask, [FACE_GRID, FACE_GRID], of the points of `_face_grid` that are visible in the photograph."""
        return self._is_visible(*_face_grid())

    def _directions(self, u: Floats, v: Floats) -> tuple[Floats, Floats, Floats]:
        """Convert normalized coordinates of the face to directions x, y, z in the photograph's camera space."""
        x, y, z = np.moveaxis(np.stack([u, v, np.ones_like(u)], axis=-1) @ FACES[self.face or "front"], -1, 0)
        return x, y, z

    def _is_visible(self, u: Floats, v: Floats) -> NDArray[np.bool_]:
        """Return a mask of the rays, in normalized coordinates of the face, that are visible in the wide photograph."""
        if self.model == "EQUIRECTANGULAR":
            return np.ones(u.shape, bool)
        (side_angles, fold_angle), (x, y, z) = self._angles, self._directions(u, v)
        angle = np.arctan2(np.hypot(x, y), z)
        with np.errstate(all="ignore"):
            x, y = self.distort(x, y, z)
            is_inside = (x >= 0) & (y >= 0) & (x <= self.width) & (y <= self.height)
        circle_angle = max(side_angles.min(), MIN_CIRCLE) - RIM / self._intrinsics[0]
        return np.asarray(is_inside & (angle < min(fold_angle, circle_angle)))

    def shows_white(self, mask: NDArray[Any]) -> bool:
        """Return whether any white pixel of the photograph's mask, [H, W, C], is visible in this face."""
        u, v = np.stack(_face_grid())[:, self._visible_grid]
        x, y = self.distort(*self._directions(u, v))
        height, width = mask.shape[:2]
        rows, columns = (y * height / self.height).astype(int), (x * width / self.width).astype(int)
        return bool((mask[np.minimum(rows, height - 1), np.minimum(columns, width - 1), 0] > 0).any())

    def _face_camera(self) -> Camera:
        """Return the camera of a face, cropped to the bounding box of the pixels that are visible in the photograph.

        At the center, the pixels of the face are as large as those of the photograph.  Raises DataError for an
        implausible camera.
        """
        focal = max(self._intrinsics[:2])
        side = 2 * math.ceil(FACE_TANGENT * focal)
        long_side = max(self.width, self.height)
        if side > MAX_GROWTH * long_side or long_side > MAX_PHOTO_SIDE:
            raise DataError(
                f"the {self.model} camera is {self.width}x{self.height} with focal lengths {self._intrinsics[:2]}; "
                f"expected at most {MAX_PHOTO_SIDE} px per side and focal lengths up to "
                f"{MAX_GROWTH / 2 / FACE_TANGENT:.2g} times the long side: calibrate the camera again"
            )
        if not self._visible_grid.any():
            raise self._error("has no visible pixels")
        spans = [np.flatnonzero(self._visible_grid.any(axis=axis)) for axis in (0, 1)]  # columns, rows
        (x0, x1), (y0, y1) = (
            (max(0, int((i[0] - 1) / FACE_GRID * side)), min(side, int((i[-1] + 2) / FACE_GRID * side))) for i in spans
        )
        return Camera(x1 - x0, y1 - y0, focal, focal, side / 2 - x0, side / 2 - y0)

    def _blocks(self, samples: int) -> Iterator[tuple[slice, Floats, Floats]]:
        """Yield slices of rows of the face, each with the normalized coordinates of its rays (see `_rays`)."""
        block_height = max(1, BLOCK // (self.pinhole.width * samples**2))
        for row in range(0, self.pinhole.height, block_height):
            rows = slice(row, row + block_height)
            yield rows, *_rays(self.pinhole, rows, samples)

    def _extract_face(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Resample a wide photograph to the face, [H, W, C]; each pixel is the mean of 2 x 2 rays."""
        camera, border = self.pinhole, int(self.model == "EQUIRECTANGULAR")
        if border:  # a panorama continues at the opposite side
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
        """Convert normalized coordinates, or directions (u, v, z) for models in WIDE, to pixel coordinates."""
        fx, fy, cx, cy, coefficients = self._intrinsics
        x, y = MODELS[self.model][1](u, v, coefficients, *z)
        return fx * x + cx, fy * y + cy

    def project(self, points: Floats) -> Floats:
        """Project points in camera space, [M, 3], to pixels, [M, 2].  Only wide lenses see points behind the camera."""
        x, y, z = points.T
        return np.stack(self.distort(x, y, z) if self.is_wide else self.distort(x / z, y / z), axis=1)

    def undistort(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Convert pixel coordinates to normalized coordinates by Newton's method; NaN where it does not converge."""
        fx, fy, cx, cy, coefficients = self._intrinsics
        distortion = MODELS[self.model][1]
        target = np.stack([(x.ravel() - cx) / fx, (y.ravel() - cy) / fy])
        points, active = target.copy(), np.arange(x.size)
        with np.errstate(all="ignore"):
            for _ in range(MAX_ITERATIONS):
                previous = points[:, active]
                points[:, active] = current = _newton_step(distortion, coefficients, previous, target[:, active])
                # a point whose bits did not change has converged
                active = active[(previous.view(np.int64) != current.view(np.int64)).any(axis=0)]
                if not active.size:
                    break
            error = np.abs(np.stack(distortion(points[0], points[1], coefficients)) - target)
            u, v = np.where((error < MAX_ERROR).all(axis=0), points, np.nan)
        return u.reshape(x.shape), v.reshape(x.shape)

    @property
    def camera(self) -> Camera:
        """The camera without distortion, at the size of the photograph."""
        return Camera(self.width, self.height, *self._intrinsics[:4])

    @cached_property
    def pinhole(self) -> Camera:
        """The camera of the undistorted photograph, with the same focal lengths.

        Its image is the largest rectangle in which all pixels are defined.  With `keep_border`, its image is the
        smallest rectangle that contains the photograph, limited to 60 degrees on each side and to twice the
        photograph's size.
        For a wide photograph, the result is the camera of the face.  Raises DataError if no pixels are left.
        """
        if self.is_wide:
            return self._face_camera()
        fx, fy, _, _, _ = self._intrinsics
        x, y = np.linspace(0, self.width, BORDER_POINTS), np.linspace(0, self.height, BORDER_POINTS)
        left = self.undistort(np.zeros(BORDER_POINTS), y)[0]
        right = self.undistort(np.full(BORDER_POINTS, float(self.width)), y)[0]
        top = self.undistort(x, np.zeros(BORDER_POINTS))[1]
        bottom = self.undistort(x, np.full(BORDER_POINTS, float(self.height)))[1]
        if not all(np.isfinite(side).any() for side in (left, right, top, bottom)):
            raise self._error("cannot be inverted")
        u0, u1, v0, v1 = np.nanmax(left), np.nanmin(right), np.nanmax(top), np.nanmin(bottom)
        if self.keep_border:
            border_u, border_v = np.concatenate([left, right]), np.concatenate([top, bottom])
            max_u, max_v = self.width * (MAX_GROWTH / 2) / fx, self.height * (MAX_GROWTH / 2) / fy
            u0, u1 = max(np.nanmin(border_u), -MAX_TANGENT, -max_u), min(np.nanmax(border_u), MAX_TANGENT, max_u)
            v0, v1 = max(np.nanmin(border_v), -MAX_TANGENT, -max_v), min(np.nanmax(border_v), MAX_TANGENT, max_v)
        width, height = int((u1 - u0) * fx), int((v1 - v0) * fy)
        if min(width, height) < 1:
            raise self._error("leaves no pixels after undistortion")
        return Camera(width, height, fx, fy, float(-u0 * fx), float(-v0 * fy))

    def _error(self, fault: str) -> DataError:
        return DataError(f"the lens {self.model} {quote(self.params)} {fault}; calibrate the camera again")

    def undistort_image(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Undistort a photograph, [H, W, C], to the camera `pinhole`; the data type does not change."""
        if self.is_wide:
            return self._extract_face(pixels)
        result = cv2.remap(pixels, *_maps(self), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return result.reshape(self.pinhole.height, self.pinhole.width, -1)

    @cached_property
    def visible_pixels(self) -> NDArray[np.bool_]:
        """A mask, [H, W], of the pixels of `pinhole` that the photograph covers.

        A pixel is covered if `distort` maps it into the photograph and `undistort` maps the result back to the pixel.
        """
        if self.is_wide:
            return np.concatenate([self._is_visible(u, v) for _, u, v in self._blocks(1)])
        u, v = _rays(self.pinhole)
        x, y = self.distort(u, v)
        back_u, back_v = self.undistort(x, y)
        is_inside = (x >= 0) & (y >= 0) & (x <= self.width) & (y <= self.height)
        return is_inside & (np.abs(back_u - u) < MAX_DIFFERENCE) & (np.abs(back_v - v) < MAX_DIFFERENCE)


def _rays(camera: Camera, rows: slice = slice(0, MAX_SIDE), samples: int = 1) -> tuple[Floats, Floats]:
    """Return the normalized coordinates u and v of `samples` x `samples` rays per pixel of the given rows.

    Each is an array, [H * samples, W * samples].
    """
    x, y = ((np.arange(size * samples) + 0.5) / samples for size in (camera.width, camera.height))
    y = y[rows.start * samples : rows.stop * samples]
    u, v = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    return u, v


def _face_grid() -> tuple[Floats, Floats]:
    """Return the normalized coordinates of a uniform grid of points on a face, [FACE_GRID, FACE_GRID] each."""
    positions = FACE_TANGENT * (2 * (np.arange(FACE_GRID) + 0.5) / FACE_GRID - 1)
    u, v = np.meshgrid(positions, positions)
    return u, v


def panorama_lens(width: int, height: int) -> Lens:
    """Return the lens of a panorama of the full sphere.  The image center is forward, and the image top is up."""
    return Lens(width, height, "EQUIRECTANGULAR", (width / math.tau, height / math.pi, width / 2, height / 2))


def _newton_step(distortion: Distortion, k: Sequence[float], points: Floats, target: Floats) -> Floats:
    """Return points, [2, M], after one step of Newton's method toward the points that the lens maps to `target`."""
    h, (u, v) = 1e-7, points
    x, y = distortion(u, v, k)
    xu, yu = distortion(u + h, v, k)
    xv, yv = distortion(u, v + h, k)
    j00, j10, j01, j11 = (xu - x) / h, (yu - y) / h, (xv - x) / h, (yv - y) / h
    det = j00 * j11 - j01 * j10
    dx, dy = target[0] - x, target[1] - y
    return np.stack([u + (j11 * dx - j01 * dy) / det, v + (j00 * dy - j10 * dx) / det])


@lru_cache(maxsize=2)  # one for portrait and one for landscape photographs; 8 bytes per pixel each
def _maps(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the x and y maps of cv2.remap, [H, W] each: the position of each pixel of `pinhole` in the photograph."""
    x, y = lens.distort(*_rays(lens.pinhole))
    return (x - 0.5).astype(np.float32), (y - 0.5).astype(np.float32)  # OpenCV has pixel centers at integers


@lru_cache(maxsize=64)
def intern_lens(lens: Lens) -> Lens:
    """Return the first lens that equals `lens`, so that views share its expensive cached properties."""
    return lens
