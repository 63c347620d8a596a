"""A photograph with its camera: reading its pixels at the size of the camera."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.core.errors import DataError, PoseError, quote
from clsplat.formats.splats import EXPECTED_TIME, is_timestamp
from clsplat.scene.camera import MODELS, Camera, Lens
from clsplat.scene.images import CameraExposure, read_exif_exposure, read_exposures, read_image

# What a view says of its place: a pose with a rotation, and the moment of a scene that moves.

Floats = NDArray[np.floating]
ROTATION_TOLERANCE = 2e-3  # of R Rᵀ: files are read to 1e-3, and an inverse has a little more


def validate_pose(name: str, pose: ArrayLike) -> Floats:
    """Return a world-to-camera pose, [3, 4] float64, of the view `name`.  Raises PoseError without a rotation."""
    found = np.asarray(pose, np.float64)
    if found.shape != (3, 4):
        raise PoseError(f"the pose of {quote(name)} has shape {found.shape}; expected (3, 4)")
    rotation = found[:, :3]
    if not np.isfinite(found).all():
        raise PoseError(f"the pose of {quote(name)} has values that are not finite; expected finite numbers")
    with np.errstate(all="ignore"):  # numbers near the end of the range
        turned = rotation @ rotation.T
    if not np.allclose(turned, np.eye(3), atol=ROTATION_TOLERANCE) or np.linalg.det(rotation) < 0:
        raise PoseError(
            f"the pose of {quote(name)} has no rotation in its first three columns; "
            "expected axes of length 1 at right angles, not mirrored"
        )
    return found


def validate_time(name: str, time: float | None) -> float | None:
    """Return the time of the view `name`, in [0, 1], or None.  Raises PoseError for anything else."""
    if time is None:
        return None
    if isinstance(time, bool) or not isinstance(time, int | float | np.floating | np.integer):
        raise PoseError(f"the time of {quote(name)} is {quote(time)}; expected a number from 0 to 1, or None")
    if not is_timestamp(time):
        raise PoseError(f"the time of {quote(name)} is {float(time):g}; {EXPECTED_TIME}")
    return float(time)


Size = tuple[int, int]  # width, height, px
Alpha = Literal["transparency", "mask"]  # the meaning of a photograph's fourth channel
BLACK = (0.0, 0.0, 0.0)
NO_FILE = Path()  # of a view that is made by hand
MIN_WHITE = 0.99  # share of the largest value: JPEG does not store white exactly


@dataclass(frozen=True, eq=False)
class View:
    """A camera with its photograph.  `name` is unique in its scene: the path below the image folder.

    Two views are equal only when they are one object; compare names, downscales or poses.

    A view that only serves to render a model needs no photograph.  Raises PoseError without a rotation, and for a time
    outside [0, 1].
    """

    name: str
    camera: Camera
    world_to_camera: Floats  # [3, 4] float64
    image_path: Path = NO_FILE
    mask_path: Path | None = None  # an image of the photograph's size, white in pixels that count
    alpha: Alpha = "transparency"
    lens: Lens | None = None  # of the photograph on disk, where it has distortion
    downscale: float = 1  # divisor of the original photograph's size
    time: float | None = None  # in [0, 1], of the scene's first to last moment; None: the scene does not move
    static_path: Path | None = None  # an image of the photograph's size, white in pixels that show nothing that moves
    camera_to_world: Floats | None = None  # [4, 4] float64, as a file has it, until make_scene
    response: Callable[..., Any] | None = None  # workspace, camera, planes -> those as the camera takes them; measured

    def __post_init__(self) -> None:
        object.__setattr__(self, "world_to_camera", validate_pose(self.name, self.world_to_camera))
        object.__setattr__(self, "time", validate_time(self.name, self.time))

    @classmethod
    def looking_at(
        cls, position: ArrayLike, target: ArrayLike, up: ArrayLike, camera: Camera, name: str = "view"
    ) -> "View":
        """Return a view from a position to a target, with `up` upwards in the image; each [3], in scene units.

        Raises ValueError where there is no such view: the target is the position, or lies along `up`.
        """
        center, point, above = (np.asarray(vector, np.float64) for vector in (position, target, up))
        if not center.shape == point.shape == above.shape == (3,):
            raise ValueError(f"{quote(name)}: expected a position, a target and `up` of 3 numbers each")
        forward = point - center
        right = np.cross(forward, above)
        axes = np.stack([right, np.cross(forward, right), forward])
        if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(above):
            raise ValueError(f"{quote(name)}: expected a target away from the position, and not along `up`")
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return cls(name, camera, np.column_stack([axes, -axes @ center]))

    def shifted(self, origin: Floats) -> "View":
        """Return the view in coordinates whose zero is at `origin`, [3] float64 in the present coordinates."""
        if (matrix := self.camera_to_world) is not None:
            matrix = np.array(matrix, np.float64)
            matrix[:3, 3] -= origin
            return replace(self, world_to_camera=np.linalg.inv(matrix)[:3], camera_to_world=None)
        rotation, translation = self.world_to_camera[:, :3], self.world_to_camera[:, 3]
        return replace(self, world_to_camera=np.column_stack([rotation, translation + rotation @ origin]))

    @property
    def position(self) -> Floats:
        """Camera center in world coordinates, [3]."""
        rotation, translation = self.world_to_camera[:, :3], self.world_to_camera[:, 3]
        return -rotation.T @ translation

    def resized(self, downscale: float) -> "View":
        """Return the same photograph with 1 / `downscale` of its original size.

        Raises ValueError unless `downscale` is positive and finite.
        """
        if not 0 < downscale < math.inf:
            raise ValueError(
                f"the downscale of {quote(self.name)} is {downscale:g}; expected a divisor above 0, such as 2"
            )
        if downscale == self.downscale:
            return self
        return replace(self, camera=self.camera.downscaled(downscale / self.downscale), downscale=downscale)

    def photograph(self, background: ArrayLike = 0.0) -> NDArray[np.float32]:
        """Return the photograph at the camera's size, [height, width, 3] in [0, 1].

        background: behind what is transparent, one number or three in [0, 1]; that of a picture is
        `picture.background`.  Raises DataError when the file cannot be read or is not the camera's image, ValueError
        for another background.
        """
        red, green, blue = color_of(background).tolist()
        return np.asarray(load_image(self, (red, green, blue)) / np.float32(255), np.float32)


def color_of(background: ArrayLike) -> Floats:
    """Return a background as three numbers.  Raises ValueError unless it is one number or three in [0, 1]."""
    try:
        color = np.asarray(background, np.float64)
    except (ValueError, TypeError):
        raise ValueError(f"the background is {quote(background)}; expected one number or three in [0, 1]") from None
    if color.shape not in ((), (3,)):
        raise ValueError(f"the background has shape {color.shape}; expected one number or three")
    if not ((color >= 0) & (color <= 1)).all():
        raise ValueError(f"the background is {quote(background)}; expected one number or three in [0, 1]")
    return np.broadcast_to(color, (3,))


def load_image(view: View, background: tuple[float, float, float] | Floats = BLACK) -> NDArray[np.uint8]:
    """Return the photograph of `view` at its camera's size, RGB, [H, W, 3]; alpha is composited on `background`.

    `background` is a color in [0, 1], black by default.  Raises DataError when the file cannot be read as an 8- or
    16-bit image, or when it is not the camera's image before downscaling.
    """
    pixels = _as_taken(view, view.image_path)
    width, height = view.camera.width, view.camera.height
    opaque, resized = pixels.shape[2] == 3, pixels.shape[:2] != (height, width)
    if opaque and not resized and pixels.dtype == np.uint8:
        return pixels
    # Double precision where the reference has it, to truncate alike; single saves memory on large photographs.
    values: NDArray[Any] = pixels.astype(np.float32 if opaque else np.float64)
    if resized:  # not premultiplied by alpha, as in the reference (multi-scale Blender)
        values = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
    limit = int(np.iinfo(pixels.dtype).max)
    if opaque:
        return np.asarray(np.rint(values * (255 / limit)), np.uint8)
    unit = values / limit
    color, alpha = unit[:, :, :3], unit[:, :, 3:]
    composite = color * alpha + np.asarray(background) * (1 - alpha)
    slack = 1e-3 if resized else 0.0  # OpenCV's area weights are single precision: rounding must not lower a level
    return np.asarray(composite * 255 + slack, np.uint8)  # truncated, as in the reference (Kerbl et al. 2023)


def load_rgba(view: View) -> NDArray[np.uint8] | None:
    """Return the photograph of `view` at its camera's size with its alpha, [H, W, 4], not premultiplied; None where it
    has no transparency, or pixels that do not count.

    Raises DataError as load_image does.
    """
    pixels = _as_taken(view, view.image_path)
    if pixels.shape[2] == 3 or load_mask(view) is not None:
        return None
    size = view.camera.width, view.camera.height
    values = cv2.resize(pixels.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.rint(values * (255 / np.iinfo(pixels.dtype).max)), np.uint8)


def load_transparency(view: View) -> NDArray[np.uint8] | None:
    """Return how much of a background shows through the photograph of `view`, [H, W] up to 255; None where none does.

    Raises DataError as load_image does.
    """
    rgba = load_rgba(view)
    return None if rgba is None or (rgba[:, :, 3] == 255).all() else np.asarray(255 - rgba[:, :, 3])


def load_mask(view: View) -> NDArray[np.bool_] | None:
    """Return which pixels of `load_image` count, [H, W], or None when all do.

    A pixel counts when its whole area is white in the mask file, opaque in the photograph (with alpha as mask) and not
    blank (with a `whole` lens).
    Raises DataError as load_image does.
    """
    layers = []
    if view.mask_path is not None:
        layers.append(_as_taken(view, view.mask_path)[:, :, :1])
    if view.alpha == "mask":
        pixels = _as_taken(view, view.image_path)
        layers += [pixels[:, :, 3:]] if pixels.shape[2] == 4 else []
    if view.lens is not None and view.lens.whole:
        layers.append(np.where(view.lens.shown, 255, 0).astype(np.uint8)[:, :, None])
    size = view.camera.width, view.camera.height
    masks = [
        cv2.resize(layer.astype(np.float32), size, interpolation=cv2.INTER_AREA) > MIN_WHITE * np.iinfo(layer.dtype).max
        for layer in layers
    ]
    return np.logical_and.reduce(masks) if masks else None


def _as_taken(view: View, path: Path) -> NDArray[Any]:
    """The pixels of a file at the size of its camera before downscaling: upright and undistorted.

    Raises DataError as is_turned does.
    """
    if path == NO_FILE:
        raise DataError(f"the view {quote(view.name)} has no photograph; expected one with an image_path")
    decoded: dict[bool, NDArray[Any]] = {}

    def size(upright: bool) -> Size:
        decoded[upright] = read_image(path, upright)
        height, width = decoded[upright].shape[:2]
        return width, height

    pixels = decoded[needs_rotation(view, path, size)]
    return view.lens.undistort_image(pixels) if view.lens else pixels


def needs_rotation(view: View, path: Path, size: Callable[[bool], Size]) -> bool:
    """Return whether a view's photograph or mask has its camera's size only when the EXIF rotation is applied.

    COLMAP ignores that tag.  `size` returns (width, height) of the file as stored, or with True upright.
    Raises DataError when neither is the camera's.
    """
    found = size(False)
    if fits_camera(view, found):
        return False
    if fits_camera(view, found[::-1]):
        found = size(True)
        if fits_camera(view, found):
            return True
    camera = view.lens or view.camera
    raise DataError(
        f"{path}: the image is {found[0]}x{found[1]} pixels, its camera {camera.width}x{camera.height}; expected the "
        f"same size{'' if view.lens else ', or a larger image of the same shape'}: use the images the cameras were "
        "made from"
    )


def sample_views(views: Sequence[View], most: int) -> Sequence[View]:
    """Return at most so many views, from the middles of as many equal parts."""
    if len(views) <= most:
        return views
    return [views[(2 * i + 1) * len(views) // (2 * most)] for i in range(most)]


def fits_camera(view: View, size: Size) -> bool:
    """Return whether an image of `size` (width, height) fits the camera of a view."""
    if view.lens:
        return size == (view.lens.width, view.lens.height)
    return _scales_to(size, (view.camera.width, view.camera.height))


def _scales_to(file: Size, camera: Size) -> bool:
    """Return whether one divisor >= 1 takes the file's size to the camera's, rounded as in Camera.downscaled."""
    smallest = max(1.0, *(f / (c + 0.5) for f, c in zip(file, camera, strict=True)))
    largest = min(f / (c - 0.5) if c > 1 else np.inf for f, c in zip(file, camera, strict=True))
    return smallest <= largest


# Lenses whose focal length is another one than was calibrated: the photograph that they undistort stays the same.

ROUNDING = 1e-12

DEGREES: dict[str, tuple[int, ...]] = {  # n of each coefficient after the middle, in COLMAP's order
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (2,),
    "RADIAL": (2, 4),
    "OPENCV": (2, 4, 1, 1),
    "FULL_OPENCV": (2, 4, 1, 1, 6, 2, 4, 6),
}


def can_zoom(lens: Lens) -> bool:
    """Return whether there is such a lens for any factor: a fisheye has none of its model."""
    return lens.model in DEGREES


def zoom_lens(lens: Lens, factor: float) -> Lens:
    """Return a lens with the focal length times a factor, whose undistorted photograph is the same.

    Raises DataError where its model has none.
    """
    if factor == 1:
        return lens
    if not can_zoom(lens):
        raise DataError(
            f"the lens {lens.model} has no form with another focal length; expected one of {', '.join(DEGREES)}: "
            "`clsplat data undistort` first"
        )
    focals = MODELS[lens.model][0]
    lengths, middle, rest = lens.params[:focals], lens.params[focals : focals + 2], lens.params[focals + 2 :]
    scaled = [value * factor**degree for value, degree in zip(rest, DEGREES[lens.model], strict=True)]
    return replace(lens, params=(*(factor * length for length in lengths), *middle, *scaled))


def photo_lens(view: View) -> Lens:
    """Return the lens of a view's photograph as it is on disk: a pinhole where it has no distortion.

    Raises DataError where its focal length was learned and its model has none with another.
    """
    c, lens = view.camera, view.lens
    if lens is None:
        return Lens(c.width, c.height, "PINHOLE", (c.fx, c.fy, c.cx, c.cy))
    factor = c.fx / lens.pinhole.resized(c.width, c.height).fx  # 1, unless the focal length was learned
    return lens if math.isclose(factor, 1, rel_tol=ROUNDING) else zoom_lens(lens, factor)


# What cameras noted of the exposures of views.


def load_exposures(views: Sequence[View]) -> list[CameraExposure | None]:
    """Return the exposure of each view: what lies beside its image, or else what its image tells; None: nothing.

    Raises DataError where a file cannot be read.
    """
    beside = cache(read_exposures)
    found: list[CameraExposure | None] = []
    for view in views:
        if view.image_path == NO_FILE:
            found.append(None)
            continue
        told = (beside(folder).get(name) for folder, name in _below(view))
        found.append(next(filter(None, told), None) or read_exif_exposure(view.image_path))
    return found


def _below(view: View) -> Iterator[tuple[Path, str]]:
    """The folders of its image, up to that below which the name of the view is a path, and its path below each."""
    parts = PurePosixPath(view.name).parts
    for number, folder in enumerate(view.image_path.parents[: len(parts)], 1):
        if view.image_path.parts[-number:] == parts[-number:]:
            yield folder, "/".join(parts[-number:])


@dataclass(frozen=True)
class PosedView:
    """A view with the name of its image below the folder of all images, and its lens with distortion."""

    name: str
    view: View
    test: bool

    @property
    def lens(self) -> Lens:
        """The lens of the photograph as it is on disk: that of the view, or its pinhole camera."""
        return photo_lens(self.view)
