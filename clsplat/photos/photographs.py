"""Cache photographs on the device, with 8 bits per channel, and convert them to float planes for losses."""

from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.opencl.device import Array, Device
from clsplat.photos.transforms import PhotographTransform, Planes
from clsplat.render.camera import DeviceCamera, update_camera, upload_camera
from clsplat.render.workspace import Workspace
from clsplat.scene.photographs import load_photograph
from clsplat.scene.scene import Background
from clsplat.scene.view import BLACK, WHITE, View, load_transparency

Mask = NDArray[np.bool_]
BACKGROUNDS: dict[Background, tuple[float, float, float]] = {"black": BLACK, "white": WHITE}
BUDGET_FRACTION = 0.25  # of the device's memory, when no budget is given


@dataclass(frozen=True)
class Photograph:
    """A photograph and its camera on the device."""

    camera: DeviceCamera
    colors: Array  # [3, height, width] uint8
    mask: Array | None = None  # [1, height, width] uint8, 1 in pixels that count; None if all pixels count
    is_empty: bool = False  # whether the mask excludes every pixel
    transparency: Array | None = None  # [1, height, width] uint8, 255 for only background; None if opaque or not loaded

    @property
    def nbytes(self) -> int:
        return sum(array.nbytes for array in (self.colors, self.mask, self.transparency) if array)

    def image(self) -> NDArray[np.uint8]:
        """Return the colors on the host, [height, width, 3]."""
        return np.asarray(self.colors.get().transpose(1, 2, 0))

    def unmasked_pixels(self) -> Mask | None:
        """Return an array, [height, width], that is true in unmasked pixels; None if there is no mask."""
        return np.asarray(self.mask.get()[0] > 0) if self.mask else None

    def planes(
        self,
        workspace: Workspace,
        transforms: Sequence[PhotographTransform] = (),
        step: int = 0,
        backgrounds: tuple[Array, Array] | None = None,
    ) -> Planes:
        """Return the photograph as float planes, padded to full tiles, with the transforms of a global step applied.

        backgrounds: the background color of the photographs, and the color that replaces it, each [3] in [0, 1].
        """
        colors = unpack(workspace, self.camera, self.colors, 1 / 255, "photograph")
        if backgrounds and self.transparency:
            change_background(workspace, self.camera, colors, self.transparency, *backgrounds)
        mask = unpack(workspace, self.camera, self.mask, 1.0, "mask") if self.mask else None
        planes = Planes(workspace, self.camera, colors, mask)
        for transform in transforms:
            planes = transform.apply(planes, step)
        return planes


class Pixels(NamedTuple):
    """A photograph on the host, as uint8 planes."""

    colors: NDArray[np.uint8]  # [3, height, width]
    mask: NDArray[np.uint8]  # [0 or 1, height, width]
    transparency: NDArray[np.uint8] | None


Key = tuple[str, int, int]  # name, width and height of a view


def _key(view: View) -> Key:
    return view.name, view.camera.width, view.camera.height


class Photographs:
    """A cache of the photographs of a scene, which uses at most `budget` bytes on the device.

    Photographs that do not fit are read again when they are used.  A thread prefetches photographs, which does not
    change results.
    """

    def __init__(
        self, device: Device, background: Background, budget: int | None = None, undistorted: Path | None = None
    ) -> None:
        self.device = device
        self.undistorted = undistorted  # folder in which undistorted photographs are cached
        self.background_name = background
        self.background = device.upload(np.array(BACKGROUNDS[background], np.float32))  # [3]
        self.budget = int(device.info.memory * BUDGET_FRACTION) if budget is None else budget
        self._cache: dict[Key, Photograph] = {}  # least recently used first
        self._futures: dict[Key, Future[Pixels]] = {}
        self._executor: ThreadPoolExecutor | None = None
        self._transparency = False

    def enable_transparency(self) -> None:
        """Also load the transparency of photographs, which random backgrounds need."""
        if not self._transparency:
            self._transparency = True
            self._cache.clear()
            self._futures.clear()

    def empty_copy(self) -> "Photographs":
        """Return an empty cache with the same background, for views that are used only once."""
        return Photographs(self.device, self.background_name, undistorted=self.undistorted)

    def camera(self, view: View) -> DeviceCamera:
        """Return the camera of a view."""
        photograph = self._cache.get(_key(view))
        return update_camera(photograph.camera, view) if photograph else upload_camera(self.device, view)

    def get(self, view: View) -> Photograph:
        """Return the photograph of a view, with the view's current camera.

        Raises DataError if its file cannot be read.
        """
        key = _key(view)
        photograph = self._cache.pop(key, None)
        if photograph is None:
            future = self._futures.pop(key, None)
            colors, mask, alpha = future.result() if future else self._read(view)
            self._make_room(colors.nbytes + mask.nbytes + (0 if alpha is None else alpha.nbytes))
            device_mask, is_empty = (self.device.upload(mask), not mask.any()) if len(mask) else (None, False)
            transparency = None if alpha is None else self.device.upload(alpha)
            photograph = Photograph(self.camera(view), self.device.upload(colors), device_mask, is_empty, transparency)
        elif (camera := update_camera(photograph.camera, view)) is not photograph.camera:
            photograph = replace(photograph, camera=camera)
        self._cache[key] = photograph
        return photograph

    def get_nonempty(self, view: View, original: View, index: int | None = None) -> Photograph:
        """Return the photograph of a view, or of the larger view `original` if the mask excludes all pixels of `view`.

        index: the index of the view, see DeviceCamera.  Raises DataError if the mask excludes all of `original` too.
        """
        photograph = self.get(view)
        if photograph.is_empty and view is not original:
            photograph = self.get(original)
        if photograph.is_empty:
            raise DataError(
                f"{original.mask_path or original.image_path}: the mask excludes every pixel of '{original.name}'; "
                "fix the mask, or remove the photo from the dataset"
            )
        return replace(photograph, camera=replace(photograph.camera, view_index=index))

    def prefetch(self, views: Iterable[View]) -> None:
        """Start to read the photographs of views that will be used next."""
        for view in views:
            key = _key(view)
            if key not in self._cache and key not in self._futures:
                self._executor = self._executor or ThreadPoolExecutor(1, "photographs")
                self._futures[key] = self._executor.submit(self._read, view)

    def _read(self, view: View) -> Pixels:
        image = load_photograph(view, BACKGROUNDS[self.background_name], self.undistorted)
        pixels = np.ascontiguousarray(image.transpose(2, 0, 1))
        transparency = load_transparency(view) if self._transparency else None
        return Pixels(pixels[:3], pixels[3:], None if transparency is None else transparency[None])

    def _make_room(self, size: int) -> None:
        total = sum(photograph.nbytes for photograph in self._cache.values())
        while self._cache and total + size > self.budget:
            total -= self._cache.pop(next(iter(self._cache))).nbytes


def unpack(workspace: Workspace, camera: DeviceCamera, pixels: Array, factor: float, name: str) -> Array:
    """Return 8-bit pixels, [C, height, width], times `factor` as float planes, [C, rows, stride].

    The planes are zero outside the image.
    """
    key = "unpack", name, factor, pixels.shape, camera.size
    return workspace.plans.run(key, {"pixels": pixels}, _unpack, workspace, camera, pixels, factor, name)


def _unpack(workspace: Workspace, camera: DeviceCamera, pixels: Array, factor: float, name: str) -> Array:
    channels = pixels.shape[0]
    planes = workspace.array(name, (channels, camera.rows, camera.stride))
    lanes = int(workspace.device.tuning["LANES"])
    workspace.device.program("loss.cl").unpack_pixels(
        items=(-(-camera.stride // lanes), camera.rows, channels),
        pixels=pixels,
        planes=planes,
        factor=factor,
        width=camera.width,
        height=camera.height,
        stride=camera.stride,
    )
    return planes


def change_background(
    workspace: Workspace,
    camera: DeviceCamera,
    colors: Array,
    transparency: Array,
    background: Array,
    new_background: Array,
) -> None:
    """Replace the color `background` with `new_background`, both [3], in the planes `colors`, [3, rows, stride].

    transparency: [1, height, width] uint8, 255 where only the background is visible.
    """
    planes = unpack(workspace, camera, transparency, 1 / 255, "transparency")
    pixels = camera.rows * camera.stride
    workspace.device.program("loss.cl").change_background(
        items=(pixels, 3),
        colors=colors,
        transparency=planes,
        background=background,
        behind=new_background,
        pixels=pixels,
    )


def apply_mask(workspace: Workspace, camera: DeviceCamera, planes: Array, mask: Array) -> None:
    """Set planes, [channels, rows, stride], to zero where the mask, [1, rows, stride], is zero."""
    assert planes.shape[1:] == mask.shape[1:] == (camera.rows, camera.stride)
    pixels = camera.rows * camera.stride
    workspace.device.program("loss.cl").apply_mask(
        items=(pixels, planes.shape[0]), planes=planes, mask=mask, pixels=pixels
    )


# The texture of images: their gradient magnitude, |Sobel| / 8 of the luminance, per px.

MAX_MAGNITUDE = 0.75  # per px; larger than any possible magnitude
BINS = 3000


def image_gradient(workspace: Workspace, camera: DeviceCamera, image: Array, name: str = "texture") -> Array:
    """Compute the gradient magnitudes, [rows, stride] in 1/px, of an image, [3, rows, stride] in [0, 1]."""
    magnitude = workspace.array(name, (camera.rows, camera.stride))
    device = workspace.device
    device.program("texture.cl").image_gradient(
        items=(-(-camera.stride // int(device.tuning["LANES"])), camera.rows),
        image=image,
        magnitude=magnitude,
        **camera.plane_arguments(),
    )
    return magnitude


def unmasked_gradient(workspace: Workspace, camera: DeviceCamera, image: Array, mask: Array | None) -> Array:
    """Compute gradient magnitudes, which are -1 at masked pixels and their neighbors.  mask: [1, rows, stride]."""
    magnitude = image_gradient(workspace, camera, image)
    if mask is not None:
        workspace.device.program("texture.cl").hide_masked(
            items=(camera.width, camera.height),
            mask=mask,
            magnitude=magnitude,
            width=camera.width,
            height=camera.height,
            stride=camera.stride,
        )
    return magnitude


def compute_texture_quantile(workspace: Workspace, photographs: Iterable[Photograph], quantile: float) -> float:
    """Compute a quantile of the gradient magnitude over all unmasked pixels, in 1/px, rounded up to 1 / 4000."""
    counts = np.zeros(BINS, np.int64)
    for photograph in photographs:
        camera, planes = photograph.camera, photograph.planes(workspace)
        values = unmasked_gradient(workspace, camera, planes.colors, planes.mask).get()[: camera.height, : camera.width]
        counts += np.histogram(values, BINS, (0, MAX_MAGNITUDE))[0]  # excludes the -1 of masked pixels
    index = np.searchsorted(np.cumsum(counts), quantile * counts.sum())
    return float(index + 1) * MAX_MAGNITUDE / BINS
