"""Pair a photograph with its camera, and read its pixels at the size of the camera."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any, Literal, cast

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.core.errors import DataError, PoseError, quote
from clsplat.formats.splats import EXPECTED_TIME, is_timestamp
from clsplat.scene.camera import FACES, MODELS, Camera, Lens, intern_lens
from clsplat.scene.images import CameraExposure, read_exif_exposure, read_exposures, read_image, read_stored_size

Floats = NDArray[np.floating]
ROTATION_TOLERANCE = 2e-3  # error of R Rᵀ: files are checked to 1e-3, and inverting adds to the error


def validate_pose(name: str, pose: ArrayLike) -> Floats:
    """Return the world-to-camera pose of the view `name`, [3, 4] float64.  Raises PoseError for an invalid pose."""
    matrix = np.asarray(pose, np.float64)
    if matrix.shape != (3, 4):
        raise PoseError(f"the pose of {quote(name)} has shape {matrix.shape}; expected (3, 4)")
    rotation = matrix[:, :3]
    if not np.isfinite(matrix).all():
        raise PoseError(f"the pose of {quote(name)} has values that are not finite; expected finite numbers")
    with np.errstate(all="ignore"):  # huge numbers overflow
        product = rotation @ rotation.T
    if not np.allclose(product, np.eye(3), atol=ROTATION_TOLERANCE) or np.linalg.det(rotation) < 0:
        raise PoseError(
            f"the pose of {quote(name)} has no rotation in its first three columns; "
            "expected an orthonormal matrix without reflection"
        )
    return matrix


def validate_time(name: str, time: float | None) -> float | None:
    """Return the time of the view `name`.  Raises PoseError unless it is None or a number in [0, 1]."""
    if time is None:
        return None
    if isinstance(time, bool) or not isinstance(time, int | float | np.floating | np.integer):
        raise PoseError(f"the time of {quote(name)} is {quote(time)}; expected a number from 0 to 1, or None")
    if not is_timestamp(time):
        raise PoseError(f"the time of {quote(name)} is {float(time):g}; {EXPECTED_TIME}")
    return float(time)


Size = tuple[int, int]  # width, height, px
Alpha = Literal["transparency", "mask"]  # the meaning of a photograph's fourth channel
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
NO_FILE = Path()  # path of a view without a photograph
MAX_ROUNDING = 1.5  # px; a reduced image has whole pixels
MIN_WHITE = 0.99  # fraction of the largest value: JPEG does not store white exactly


@dataclass(frozen=True, eq=False)
class View:
    """A camera and its photograph.  `name` is unique in the scene, usually the path below the image folder.

    Views compare by identity; compare names, downscales or poses instead.  A view that only renders a model needs no
    photograph.  Raises PoseError for a pose without a rotation, and for a time outside [0, 1].
    """

    name: str
    camera: Camera
    world_to_camera: Floats  # [3, 4] float64
    image_path: Path = NO_FILE
    mask_path: Path | None = None  # an image of the photograph's size, white in valid pixels
    alpha: Alpha = "transparency"
    lens: Lens | None = None  # lens of the photograph on disk, if it has distortion
    downscale: float = 1  # divisor of the original photograph's size
    time: float | None = None  # timestamp in [0, 1]; None: the scene is static
    static_path: Path | None = None  # an image of the photograph's size, white in pixels without motion
    camera_to_world: Floats | None = None  # [4, 4] float64, as in the file; None after make_scene
    response: Callable[..., Any] | None = None  # (workspace, camera, planes) -> planes after the camera response
    image: NDArray[Any] | None = None  # [height, width, 3 or 4], integers or in [0, 1]: a photograph in memory
    background: tuple[float, float, float] = BLACK  # color of the scene behind transparent pixels

    def __post_init__(self) -> None:
        if self.image is not None:
            object.__setattr__(self, "image", _validate_pixels(self.name, self.image))
        object.__setattr__(self, "world_to_camera", validate_pose(self.name, self.world_to_camera))
        object.__setattr__(self, "time", validate_time(self.name, self.time))

    @classmethod
    def looking_at(
        cls, position: ArrayLike, target: ArrayLike, up: ArrayLike, camera: Camera, name: str = "view"
    ) -> "View":
        """Return a view from `position` toward `target`, with `up` pointing up in the image; each [3], in scene units.

        Raises ValueError when the target equals the position, or when the viewing direction is parallel to `up`.
        """
        center, target_point, up_vector = (np.asarray(vector, np.float64) for vector in (position, target, up))
        if not center.shape == target_point.shape == up_vector.shape == (3,):
            raise ValueError(f"{quote(name)}: expected a position, a target and `up` of 3 numbers each")
        forward = target_point - center
        right = np.cross(forward, up_vector)
        axes = np.stack([right, np.cross(forward, right), forward])
        if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up_vector):
            raise ValueError(f"{quote(name)}: expected a target away from the position, not in the direction of `up`")
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return cls(name, camera, np.column_stack([axes, -axes @ center]))

    def shifted(self, origin: Floats) -> "View":
        """Return the view in coordinates relative to `origin`, [3] float64."""
        if not origin.any():
            return self
        if (matrix := self.camera_to_world) is not None:
            matrix = np.array(matrix, np.float64)
            matrix[:3, 3] -= origin
            return replace(self, world_to_camera=np.linalg.inv(matrix)[:3], camera_to_world=None)
        rotation, translation = self.world_to_camera[:, :3], self.world_to_camera[:, 3]
        return replace(self, world_to_camera=np.column_stack([rotation, translation + rotation @ origin]))

    def faces(self) -> list["View"]:
        """Return the views of the faces of a wide photograph; for other photographs, only this view.

        Faces that the mask hides are omitted.  Raises DataError when the mask excludes every pixel.
        """
        if self.lens is None or not self.lens.is_wide or self.lens.face:
            return [self]
        mask = None if self.mask_path is None else read_image(self.mask_path)
        path, views = PurePosixPath(self.name), list[View]()
        for lens in self.lens.faces if mask is None else [face for face in self.lens.faces if face.shows_white(mask)]:
            rotation, to_world = FACES[lens.face], self.camera_to_world
            if to_world is not None:
                to_world = np.column_stack([to_world[:, :3] @ rotation.T, to_world[:, 3]])
            name, pose = f"{path.with_suffix('')}/{CUBE}{lens.face}{path.suffix}", rotation @ self.world_to_camera
            view = replace(self, name=name, camera=lens.pinhole, world_to_camera=pose, lens=lens)
            views.append(replace(view, camera_to_world=to_world))
        if not views:
            raise DataError(
                f"{self.mask_path}: the mask excludes every pixel of {quote(self.name)}; "
                "fix the mask, or remove the photo from the dataset"
            )
        return views

    def full_photograph(self) -> "View":
        """Return the view of the entire photograph to which this face belongs; other views are returned unchanged."""
        if self.lens is None or not self.lens.face:
            return self
        lens, pose = intern_lens(replace(self.lens, face="", keep_border=False)), FACES[self.lens.face].T
        name = photograph_name(self.name)
        return replace(self, name=name, camera=lens.pinhole, world_to_camera=pose @ self.world_to_camera, lens=lens)

    @property
    def position(self) -> Floats:
        """The camera center in world coordinates, [3]."""
        rotation, translation = self.world_to_camera[:, :3], self.world_to_camera[:, 3]
        return -rotation.T @ translation

    def resized(self, downscale: float) -> "View":
        """Return the view at 1 / `downscale` of the original size of its photograph.

        Raises ValueError unless `downscale` is positive and finite.
        """
        if not 0 < downscale < math.inf:
            raise ValueError(
                f"the downscale of {quote(self.name)} is {downscale:g}; expected a divisor above 0, such as 2"
            )
        if downscale == self.downscale:
            return self
        return replace(self, camera=self.camera.downscaled(downscale / self.downscale), downscale=downscale)

    @property
    def has_photograph(self) -> bool:
        """Whether the view has a photograph, in memory or as a file (which may be missing)."""
        return self.image is not None or self.image_path != NO_FILE

    def photograph(self, background: ArrayLike | None = None) -> NDArray[np.float32]:
        """Return the photograph at the camera's size, [height, width, 3] in [0, 1].

        background: the color behind transparent pixels, one or three numbers in [0, 1]; default: that of the scene.
        For a comparison with a render, pass the `background` of the render.  Raises DataError when the file cannot be
        read or does not fit the camera, and ValueError for an invalid background.
        """
        red, green, blue = to_color(self.background if background is None else background).tolist()
        return np.asarray(load_image(self, (red, green, blue)) / np.float32(255), np.float32)


def _validate_pixels(name: str, image: ArrayLike) -> NDArray[Any]:
    """Return an image as uint8 or uint16, [height, width, 3 or 4].  Raises DataError for any other shape or range."""
    pixels = np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or not pixels.size:
        raise DataError(f"the image of {quote(name)} has shape {pixels.shape}; expected (height, width, 3 or 4)")
    if pixels.dtype in (np.uint8, np.uint16):
        return pixels
    if not np.issubdtype(pixels.dtype, np.floating) or not ((pixels >= 0) & (pixels <= 1)).all():
        raise DataError(
            f"the image of {quote(name)} has values of type {pixels.dtype}, or outside of [0, 1]; expected uint8, "
            "uint16, or floats from 0 to 1"
        )
    return np.asarray(np.rint(pixels.astype(np.float64) * 65535), np.uint16)  # exact for uint8 / 255


CUBE = "cube_"  # prefix of the name of a face


def photograph_name(name: str) -> str:
    """Return the name of the photograph that a view shows: `a/cube_front.png` is a face of `a.png`."""
    path = PurePosixPath(name)
    stem, dot, suffix = path.name.partition(".")
    is_face = stem.startswith(CUBE) and stem.removeprefix(CUBE) in FACES and path.parent.name
    return f"{path.parent}{dot}{suffix}" if is_face else name


def to_color(background: ArrayLike) -> Floats:
    """Return a background color as an array, [3].  Raises ValueError unless it is one number or three in [0, 1]."""
    try:
        color = np.asarray(background, np.float64)
    except (ValueError, TypeError):
        color = np.empty(0)
    if color.shape not in ((), (3,)) or not ((color >= 0) & (color <= 1)).all():
        raise ValueError(f"the background is {quote(background)}; expected one number or three in [0, 1]")
    return np.broadcast_to(color, (3,))


def load_image(view: View, background: tuple[float, float, float] | Floats = BLACK) -> NDArray[np.uint8]:
    """Return the photograph of `view` at the size of its camera, RGB, [H, W, 3], composited on `background`.

    `background` is a color in [0, 1], black by default.  Raises DataError when the file cannot be read as an 8- or
    16-bit image, or when its size does not fit the camera.
    """
    pixels = _read_original(view, view.image_path)
    width, height = view.camera.width, view.camera.height
    is_opaque, is_resized = pixels.shape[2] == 3, pixels.shape[:2] != (height, width)
    if is_opaque and not is_resized and pixels.dtype == np.uint8:
        return pixels
    # Double precision with alpha, to truncate as the reference does; single precision saves memory otherwise.
    values: NDArray[Any] = pixels.astype(np.float32 if is_opaque else np.float64)
    if is_resized:  # not premultiplied by alpha, as in the reference (multi-scale Blender)
        values = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
    limit = int(np.iinfo(pixels.dtype).max)
    if is_opaque:
        return np.asarray(np.rint(values * (255 / limit)), np.uint8)
    rgba = values / limit
    color, alpha = rgba[:, :, :3], rgba[:, :, 3:]
    composite = color * alpha + np.asarray(background) * (1 - alpha)
    slack = 1e-3 if is_resized else 0.0  # OpenCV's area weights are single precision: rounding must not lower a level
    return np.asarray(composite * 255 + slack, np.uint8)  # truncated, as in the reference (Kerbl et al. 2023)


def load_rgba(view: View) -> NDArray[np.uint8] | None:
    """Return the photograph of `view` at the size of its camera with straight alpha, [H, W, 4].

    Returns None if the photograph has no alpha, or if the view has a mask.  Raises DataError like load_image.
    """
    pixels = _read_original(view, view.image_path)
    if pixels.shape[2] == 3 or load_mask(view) is not None:
        return None
    size = view.camera.width, view.camera.height
    values = cv2.resize(pixels.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.rint(values * (255 / np.iinfo(pixels.dtype).max)), np.uint8)


def load_transparency(view: View) -> NDArray[np.uint8] | None:
    """Return the transparency of the photograph of `view`, [H, W], from 0 (opaque) to 255.

    Returns None if the photograph is opaque or has a mask.  Raises DataError like load_image.
    """
    rgba = load_rgba(view)
    return None if rgba is None or (rgba[:, :, 3] == 255).all() else np.asarray(255 - rgba[:, :, 3])


def load_mask(view: View) -> NDArray[np.bool_] | None:
    """Return a mask, [H, W], of the valid pixels of `load_image`, or None when all are valid.

    The entire area of a valid pixel is white in the mask file, opaque in the photograph (if alpha is a mask) and
    covered by the photograph (if the lens has `keep_border`).  Raises DataError like load_image.
    """
    layers = []
    if view.mask_path is not None:
        layers.append(_read_original(view, view.mask_path, slice(1)))
    if view.alpha == "mask":
        pixels = _read_original(view, view.image_path, slice(3, 4))
        layers += [pixels] if pixels.size else []
    if view.lens is not None and view.lens.keep_border:
        layers.append(np.where(view.lens.visible_pixels, 255, 0).astype(np.uint8)[:, :, None])
    size = view.camera.width, view.camera.height
    masks = [
        cv2.resize(layer.astype(np.float32), size, interpolation=cv2.INTER_AREA) > MIN_WHITE * np.iinfo(layer.dtype).max
        for layer in layers
    ]
    return np.logical_and.reduce(masks) if masks else None


def _read_original(view: View, path: Path, channels: slice = slice(None)) -> NDArray[Any]:
    """Return some channels of a photograph or mask, rotated to fit the camera and undistorted, but not downscaled.

    Raises DataError when the file cannot be read or does not fit the camera.
    """
    is_file = path != NO_FILE
    if not is_file and view.image is None:
        raise DataError(f"the view {quote(view.name)} has no photo; set its image or image_path")
    images: dict[bool, NDArray[Any]] = {}

    def read_size(upright: bool) -> Size:
        images[upright] = read_image(path, upright) if is_file else cast(NDArray[Any], view.image)
        height, width = images[upright].shape[:2]
        return width, height

    pixels = images[needs_rotation(view, path if is_file else Path(view.name), read_size)][:, :, channels]
    return view.lens.undistort_image(np.ascontiguousarray(pixels)) if view.lens and pixels.size else pixels


def needs_rotation(view: View, path: Path, read_size: Callable[[bool], Size]) -> bool:
    """Return whether a photograph or mask fits the camera of its view only after its EXIF rotation.

    COLMAP ignores that rotation.  read_size: returns (width, height) of the file, as stored for False and
    upright for True.  Raises DataError when neither size fits.
    """
    width, height = read_size(False)
    if fits_camera(view, (width, height)):
        return False
    if fits_camera(view, (height, width)):
        width, height = read_size(True)
        if fits_camera(view, (width, height)):
            return True
    camera = view.lens or view.camera
    raise DataError(
        f"{path}: the image is {width}x{height} pixels, its camera {camera.width}x{camera.height}; expected the "
        f"same size{'' if view.lens else ', or a larger one with the same aspect ratio'}: use the images that the "
        "cameras were calibrated on"
    )


def fit_to_photograph(view: View) -> View:
    """Return the view, with its camera scaled down if its photograph is smaller but has the same aspect ratio."""
    (width, height), camera = read_stored_size(view.image_path), view.lens or view.camera
    x_scale, y_scale = width / camera.width, height / camera.height
    if x_scale >= 1 or abs(height - x_scale * camera.height) > MAX_ROUNDING:
        return view
    if view.lens is None:
        return replace(view, camera=view.camera.resized(width, height))
    scales = (*(x_scale, y_scale)[: MODELS[view.lens.model][0]], x_scale, y_scale)
    params = *(a * b for a, b in zip(view.lens.params, scales, strict=False)), *view.lens.params[len(scales) :]
    lens = intern_lens(replace(view.lens, width=width, height=height, params=params))
    return replace(view, lens=lens, camera=lens.pinhole)


def sample_views(views: Sequence[View], max_count: int) -> Sequence[View]:
    """Return at most `max_count` evenly spaced views."""
    if len(views) <= max_count:
        return views
    return [views[(2 * i + 1) * len(views) // (2 * max_count)] for i in range(max_count)]


def fits_camera(view: View, size: Size) -> bool:
    """Return whether an image of `size` (width, height) fits the camera of a view."""
    if view.lens:
        return size == (view.lens.width, view.lens.height)
    sides = [*zip(size, (view.camera.width, view.camera.height), strict=True)]
    # a divisor >= 1 must reduce the file's size to the camera's, rounded as in Camera.downscaled
    min_divisor = max(1.0, *(side / (c + 0.5) for side, c in sides))
    return min_divisor <= min(side / (c - 0.5) if c > 1 else np.inf for side, c in sides)


# Change the focal length of lenses without changing the undistorted photograph.

ROUNDING = 1e-12
DEGREES: dict[str, tuple[int, ...]] = {  # power of the focal length in each distortion parameter, in COLMAP's order
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (2,),
    "RADIAL": (2, 4),
    "OPENCV": (2, 4, 1, 1),
    "FULL_OPENCV": (2, 4, 1, 1, 6, 2, 4, 6),
}


def can_zoom(lens: Lens) -> bool:
    """Return whether `zoom_lens` supports the model of a lens; fisheye lenses are not supported."""
    return lens.model in DEGREES


def zoom_lens(lens: Lens, factor: float) -> Lens:
    """Return a lens whose focal length is multiplied by a factor, with the same undistorted photograph.

    Raises DataError when the model of the lens does not support that.
    """
    if factor == 1:
        return lens
    if not can_zoom(lens):
        raise DataError(
            f"the focal length of the {lens.model} lens cannot be changed; expected one of {', '.join(DEGREES)}: "
            "run `clsplat data undistort` first"
        )
    powers = *[1] * MODELS[lens.model][0], 0, 0, *DEGREES[lens.model]  # for focal lengths, principal point, distortion
    params = tuple(value * factor**degree for value, degree in zip(lens.params, powers, strict=True))
    return replace(lens, params=params)


def photo_lens(view: View) -> Lens:
    """Return the lens of the photograph of a view as stored, or a pinhole lens if it has no distortion.

    For a face of a wide photograph, the result is the pinhole lens of the face.  Raises DataError when the focal length
    was optimized and `zoom_lens` does not support the model of the lens.
    """
    c, lens = view.camera, view.lens
    if lens is None or lens.is_wide:
        return Lens(c.width, c.height, "PINHOLE", (c.fx, c.fy, c.cx, c.cy))
    factor = c.fx / lens.pinhole.resized(c.width, c.height).fx  # 1, unless the focal length was learned
    return lens if math.isclose(factor, 1, rel_tol=ROUNDING) else zoom_lens(lens, factor)


def load_exposures(views: Sequence[View]) -> list[CameraExposure | None]:
    """Return the exposure of each view, from the exposures file of its folder or from EXIF; None if unknown.

    Raises DataError when a file cannot be read.
    """
    read_cached = cache(read_exposures)
    exposures: list[CameraExposure | None] = []
    for view in views:
        if view.image_path == NO_FILE:
            exposures.append(None)
            continue
        candidates = (read_cached(folder).get(name) for folder, name in _parent_folders(view))
        exposures.append(next(filter(None, candidates), None) or read_exif_exposure(view.image_path))
    return exposures


def _parent_folders(view: View) -> Iterator[tuple[Path, str]]:
    """Yield the folders above the image of a view up to the image folder, and the path of the image in each of them."""
    parts = PurePosixPath(view.name if view.lens is None else photograph_name(view.name)).parts
    for number, folder in enumerate(view.image_path.parents[: len(parts)], 1):
        if view.image_path.parts[-number:] == parts[-number:]:
            yield folder, "/".join(parts[-number:])
