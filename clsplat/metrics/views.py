"""Measure a model on the views of a scene, and average the metrics."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, NumericError, pluralize, quote
from clsplat.formats.splats import inverse_opacities
from clsplat.gaussians.gaussians import Gaussians
from clsplat.losses.base import Comparison
from clsplat.losses.image import ssim_maps
from clsplat.metrics.images import Mask, psnr, ssim, to_8_bits
from clsplat.metrics.perceptual import Image, Perceptual
from clsplat.photos.photographs import Photograph, Photographs, unpack
from clsplat.render.camera import DeviceCamera
from clsplat.render.painter import Painter
from clsplat.render.workspace import Workspace
from clsplat.scene.times import camera_key, distinct_times, group_by_camera
from clsplat.scene.view import View, load_mask

# Static parts of a dynamic scene: PSNR of static pixels, and flicker.

MAX_NOISE = 3.0  # 8-bit levels; a larger standard deviation is motion, not camera noise
MAX_CAMERAS = 8  # cameras whose sums are in memory, with 48 bytes per pixel
MIN_TIMESTAMPS = 2
FLICKER, PHOTO_FLICKER, STATIC, STATIC_FRACTION = "flicker", "flicker_photographs", "psnr_static", "static_share"


@dataclass
class ImageSums:
    """Sums of images over the timestamps of one camera, as integers, so that the order of images does not matter."""

    count: int = 0
    total: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((), np.uint32))  # [H, W, 3]
    squares: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((), np.uint32))

    def add(self, image: Image) -> None:
        """Add an 8-bit image, [H, W, 3]."""
        values = image.astype(np.uint32)
        self.count += 1
        self.total, self.squares = self.total + values, self.squares + values * values

    def deviation(self) -> NDArray[np.float64]:
        """Return the standard deviation of each pixel over the timestamps, [H, W, 3], in 8-bit levels."""
        mean = self.total / self.count
        return np.asarray(np.sqrt(np.maximum(self.squares / self.count - mean * mean, 0)))


@dataclass
class CameraSums:
    """Sums over the renders and photographs of one camera, and the pixels that may be static."""

    views: list[str] = field(default_factory=list)
    renders: ImageSums = field(default_factory=ImageSums)
    photographs: ImageSums = field(default_factory=ImageSums)
    static_mask: Mask | None = None  # marked as static by the file, if any, and unmasked at all timestamps
    has_static_file: bool = False


class FlickerMeter:
    """Measures flicker from sums over the views of each camera; cameras that move or have one timestamp are ignored."""

    def __init__(self, views: Sequence[View]) -> None:
        """views: all views that will be added, in any order."""
        groups = [group for group in group_by_camera(views) if len(distinct_times(group)) >= MIN_TIMESTAMPS]
        self._cameras = {camera_key(group[0]): CameraSums() for group in groups[:MAX_CAMERAS]}

    @property
    def camera_count(self) -> int:
        """The number of cameras whose sums are in memory."""
        return len(self._cameras)

    def add(self, view: View, rendered: Image, photograph: Image, unmasked: Mask | None) -> dict[str, float]:
        """Add a view's 8-bit images, [H, W, 3]; return the PSNR of its static pixels if a file marks these."""
        static_mask = static_pixels(view)
        mask = static_mask if unmasked is None else unmasked if static_mask is None else static_mask & unmasked
        if view.time is not None:
            self._gather(view, rendered, photograph, mask, static_mask is not None)
        if static_mask is None or mask is None or not mask.any():
            return {}
        return {STATIC: psnr(rendered, photograph, mask)}

    def _gather(self, view: View, rendered: Image, photograph: Image, mask: Mask | None, has_file: bool) -> None:
        if (camera := self._cameras.get(camera_key(view))) is None:
            return
        camera.views.append(view.name)
        camera.renders.add(rendered)
        camera.photographs.add(photograph)
        camera.has_static_file |= has_file
        if mask is not None:
            camera.static_mask = mask if camera.static_mask is None else camera.static_mask & mask

    def flicker(self) -> dict[str, dict[str, float]]:
        """Return the flicker of each view's camera, by view name; cameras with one timestamp have none."""
        flicker = dict[str, dict[str, float]]()
        for camera in self._cameras.values():
            if camera.renders.count < MIN_TIMESTAMPS:
                continue
            render_std, photo_std = camera.renders.deviation(), camera.photographs.deviation()
            mask = np.ones(render_std.shape[:2], bool) if camera.static_mask is None else camera.static_mask
            if not camera.has_static_file:
                mask = mask & (photo_std.max(axis=2) <= MAX_NOISE)
            if mask.any():
                values = {FLICKER: float(render_std[mask].mean()), PHOTO_FLICKER: float(photo_std[mask].mean())}
                flicker |= {name: {**values, STATIC_FRACTION: float(mask.mean())} for name in camera.views}
        return flicker


def static_pixels(view: View) -> Mask | None:
    """Return the mask of a view's static pixels, [H, W], or None if no file marks them."""
    if view.static_path is None:
        return None
    return load_mask(replace(view, mask_path=view.static_path, alpha="transparency"))


def means(views: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each metric over the views that have it, in order of appearance."""
    names = list(dict.fromkeys(name for view in views for name in view))
    return {name: float(np.mean([view[name] for view in views if name in view])) for name in names}


# PSNR of a render after a color transform fitted to its photograph.

NOTABLE_GAIN = 1.0  # dB; if color fitting increases PSNR by more, the log says why
MIN_SLOPE = 1e-3  # smallest slope of a regression by which an image is divided
# Usable pixels per fitted parameter: p parameters fitted to n independent errors add p / n of their variance to the
# error elsewhere, here 1 / 64, which is 0.07 dB.
PIXELS_PER_PARAMETER = 64


class ColorFit(Protocol):
    """A color model that can be fitted to a photograph."""

    parameters_per_channel: ClassVar[int]  # number of parameters that `fit_matrix` fits

    def fit_matrix(self, image: NDArray[np.float64], photograph: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the matrix, [3, 4], that fits an image to a photograph.  image, photograph: pixels, [M, 3]."""


class Gains:
    """Gains of red, green, and blue."""

    parameters_per_channel: ClassVar[int] = 1

    def fit_matrix(self, image: NDArray[np.float64], photograph: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fit gains to an image and a photograph by least squares; return them as a matrix, [3, 4]."""
        squares, products = (image * image).sum(axis=0), (image * photograph).sum(axis=0)
        gains = np.where((squares > 0) & (products > 0), products / np.where(squares > 0, squares, 1), 1.0)
        return np.column_stack([np.diag(gains), np.zeros(3)])


def color_metrics(
    image: NDArray[np.float32], photograph: NDArray[np.uint8], mask: Mask | None, color_model: ColorFit
) -> dict[str, float]:
    """Return `psnr_color` and `psnr_affine`, in dB, of a render and a photograph, [height, width, 3].

    mask: [height, width], True for unmasked pixels.  `psnr_color` is missing if the left or the right half of the
    image has too few usable pixels; see `fit_colors`.  NaN in the render counts as black, infinity as white or black.
    """
    truth, pixels = photograph / 255.0, np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0)
    full_mask = np.ones(truth.shape[:2], bool) if mask is None else mask
    fitted_image = fit_colors(pixels, photograph, full_mask, color_model)
    corrected_image = correct_by_regression(pixels, truth, full_mask)
    color = {} if fitted_image is None else {"psnr_color": psnr(fitted_image, photograph, full_mask)}
    return {**color, "psnr_affine": psnr(corrected_image, photograph, full_mask)}


def mean_color_metrics(views: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Average the results of color_metrics over views, with the keys of metrics.json.

    If some views have no `psnr_color`, `psnr_color_views` counts the views that have it, and `psnr_color_reason` is the
    reason.  If no view has it, `psnr_color` is None.
    """
    averages, fit_count = means(views), sum("psnr_color" in view for view in views)
    if not averages or fit_count == len(views):
        return averages
    reason = f"{len(views) - fit_count} of {len(views)} views have a half with too few pixels to fit colors to"
    return {"psnr_color": None, **averages, "psnr_color_views": fit_count, "psnr_color_reason": reason}


def fit_colors(
    image: NDArray[np.float64], photograph: NDArray[np.uint8], mask: Mask, color_model: ColorFit
) -> NDArray[np.float64] | None:
    """Transform the left and right halves of an image by the color model fitted to the other half.

    The fit does not use pixels that are black or white in the photograph.  Returns None if either half has fewer than
    PIXELS_PER_PARAMETER usable pixels per parameter; this depends only on the photograph and the mask, so that models
    are compared on the same views.  The fit also excludes pixels that are brighter than white in the image, if enough
    others remain.
    """
    usable_mask = mask & ((photograph > 0) & (photograph < 255)).all(axis=2)
    half_width, truth, result = image.shape[1] // 2, photograph / 255.0, image.copy()
    left, right = np.s_[:, :half_width], np.s_[:, half_width:]
    min_pixels = PIXELS_PER_PARAMETER * color_model.parameters_per_channel
    if min(np.count_nonzero(usable_mask[half]) for half in (left, right)) < min_pixels:
        return None
    for half, fit_half in ((left, right), (right, left)):
        below_white = usable_mask[fit_half] & (image[fit_half] < 1).all(axis=2)
        fit_mask = below_white if np.count_nonzero(below_white) >= min_pixels else usable_mask[fit_half]
        matrix = color_model.fit_matrix(image[fit_half][fit_mask], truth[fit_half][fit_mask])
        result[half] = np.minimum(np.einsum("hwc,ac->hwa", image[half], matrix[:, :3]) + matrix[:, 3], 1)
    return result


def correct_by_regression(image: NDArray[np.float64], truth: NDArray[np.float64], mask: Mask) -> NDArray[np.float64]:
    """Return (image - b) / a for each channel, where a * truth + b is fitted to the image, as in gsplat.

    Noise makes the slope `a` too small, so this is not the least-squares correction of the image.
    """
    corrected_image = image.copy()
    for channel in range(3):
        x, y = truth[..., channel][mask], image[..., channel][mask]
        variance = float(np.mean((x - x.mean()) ** 2))
        slope = float(np.mean((x - x.mean()) * (y - y.mean()))) / variance if variance > 0 else 1.0
        if abs(slope) > MIN_SLOPE:
            corrected_image[..., channel] = (image[..., channel] - (y.mean() - slope * x.mean())) / slope
    return np.clip(corrected_image, 0, 1)


def log_color_metrics(averages: dict[str, Any]) -> None:
    """Log the metrics of a split after color fitting, if there are any."""
    if "psnr_color" not in averages:
        return
    psnr_color, reason = averages["psnr_color"], averages.get("psnr_color_reason")
    if psnr_color is None:
        LOG.warning("color-corrected PSNR cannot be measured: %s", reason)
    elif reason:
        LOG.warning(
            "color-corrected PSNR %.2f dB, the mean of %s: %s",
            *(psnr_color, pluralize(averages["psnr_color_views"], "view"), reason),
        )
    else:
        is_notable = psnr_color - averages["psnr"] > NOTABLE_GAIN
        note = "; the photos' exposures differ, which PSNR counts as errors" if is_notable else ""
        LOG.info("color-corrected PSNR %.2f dB%s", psnr_color, note)


# PSNR of a dynamic scene, separately for timestamps of training views and others.

HELD_OUT_PSNR, OTHER_PSNR = "psnr_held_out_moments", "psnr_other_moments"


def psnr_by_time(
    psnr: Mapping[str, float], views: Sequence[View], train_views: Sequence[View]
) -> dict[str, dict[str, float]]:
    """Return the PSNR of each view in dB, by view name and key.

    The key is OTHER_PSNR if a training view has the same timestamp, otherwise HELD_OUT_PSNR.  The result is empty if
    all views have the same key, as in static scenes.
    """
    training_times, times = set(distinct_times(train_views)), {view.name: view.time for view in views}
    known_times = {name: time for name, time in times.items() if time is not None}
    keys = {name: OTHER_PSNR if time in training_times else HELD_OUT_PSNR for name, time in known_times.items()}
    if not training_times or {keys.get(name) for name in psnr} != {HELD_OUT_PSNR, OTHER_PSNR}:
        return {}
    return {name: {keys[name]: value} for name, value in psnr.items()}


LOG = logging.getLogger("clsplat")
PSNR_AND_SSIM = Perceptual()


@dataclass(frozen=True)
class ViewMetrics:
    """The metrics of one view."""

    view: str
    psnr: float  # dB
    ssim: float
    perceptual: dict[str, float | None] = field(default_factory=dict)
    colors: dict[str, float] = field(default_factory=dict)  # dB, after color fitting
    static: dict[str, float] = field(default_factory=dict)  # of static pixels, in dynamic scenes
    by_time: dict[str, float] = field(default_factory=dict)  # PSNR, dB, by whether the timestamp is held out

    def line(self) -> dict[str, Any]:
        """Return the metrics as a line of metrics.jsonl."""
        return {
            "view": self.view,
            "psnr": self.psnr,
            "ssim": self.ssim,
            **self.colors,
            **self.by_time,
            **self.static,
            **self.perceptual,
        }


def render_view(painter: Painter, camera: DeviceCamera) -> Image:
    """Render to an 8-bit image, [height, width, 3], clamped and rounded to nearest."""
    return to_8_bits(render_floats(painter, camera))


def render_floats(painter: Painter, camera: DeviceCamera, response: Any = None) -> NDArray[np.float32]:
    """Render to floats, [height, width, 3], not clamped.  response: the camera response to apply."""
    image = painter.paint(camera)
    planes = (response(painter.workspace, camera, image) if response else image).get()
    return np.ascontiguousarray(planes[:, : camera.height, : camera.width].transpose(1, 2, 0))


def require_finite(image: NDArray[np.float32], view: View) -> None:
    """Raise NumericError if a render has values that are infinite or NaN."""
    if not np.isfinite(image).all():
        raise NumericError(
            f"view '{view.name}': the render is not finite, since values of the model are too large for float32; "
            "export the model again, or train it with lower learning rates"
        )


def device_ssim(workspace: Workspace, photograph: Photograph, image: Image) -> float:
    """Return the SSIM of an 8-bit image, [height, width, 3], and a photograph, computed on the device."""
    camera = photograph.camera
    pixels = workspace.device.upload(np.ascontiguousarray(image.transpose(2, 0, 1)))
    rendered = unpack(workspace, camera, pixels, 1 / 255, "rendered")
    planes = photograph.planes(workspace)
    _, sums = ssim_maps(Comparison(workspace, camera, rendered, planes.colors, gradient=rendered))
    return float(sums.get().sum(dtype=np.float64)) / (3 * camera.width * camera.height)


EMPTY_PSNR, EMPTY_ALPHA = 20.0, 0.01  # dB and mean alpha; below both, the render is almost empty but the photo is not


def measure(
    painter: Painter,
    views: Sequence[View],
    photographs: Photographs,
    perceptual: Perceptual = PSNR_AND_SSIM,
    check_finite: bool = False,
    colors: ColorFit | None = None,
    progress: Iterable[View] | None = None,
    train_views: Sequence[View] = (),
) -> list[ViewMetrics]:
    """Return the metrics of every view.

    Masked pixels are black in both images; PSNR and SSIM are computed over the other pixels.  check_finite: raise
    NumericError for a render that is not finite, instead of counting it as black.  colors: color model for
    `psnr_color`.  progress: the views, wrapped in a progress counter.  train_views: the training views, for metrics by
    timestamp.
    """
    results, flicker_meter, empty_names = list[ViewMetrics](), FlickerMeter(views), list[str]()
    for view in views if progress is None else progress:
        photograph = photographs.get(view)
        if photograph.is_empty:
            LOG.warning("%s: not evaluated, since its mask excludes every pixel; check the mask", view.name)
            continue
        floats = render_floats(painter, photograph.camera, view.response)
        if check_finite:
            require_finite(floats, view)
        render = to_8_bits(floats)
        image, mask = photograph.image(), photograph.unmasked_pixels()
        color = color_metrics(floats, image, mask, colors) if colors else {}
        static_psnr = flicker_meter.add(view, render, image, mask)
        if mask is None:
            similarity = device_ssim(painter.workspace, photograph, render)
        else:
            render, image = render * mask[..., None], image * mask[..., None]
            similarity = ssim(render, image, mask)
        scores = perceptual.measure(render, image)
        results.append(ViewMetrics(view.name, psnr(render, image, mask), similarity, scores, color, static_psnr))
        if results[-1].psnr < EMPTY_PSNR and painter.render_layers(photograph.camera).alpha.mean() < EMPTY_ALPHA:
            empty_names.append(view.name)
    if empty_names:
        LOG.warning(
            "almost nothing is rendered in %d of %s, such as %s; check model.near, and check that the model "
            "and the cameras match",
            *(len(empty_names), pluralize(len(views), "view"), quote(empty_names[0])),
        )
    flicker, psnrs = flicker_meter.flicker(), {result.view: result.psnr for result in results}
    by_time = psnr_by_time(psnrs, views, train_views)
    return [
        replace(result, static={**result.static, **flicker.get(result.view, {})}, by_time=by_time.get(result.view, {}))
        for result in results
    ]


def mean(results: Sequence[ViewMetrics], perceptual: Perceptual = PSNR_AND_SSIM) -> dict[str, Any]:
    """Average metrics over views, with the keys of metrics.json.  Raises DataError if there are no views."""
    if not results:
        raise DataError("no view can be evaluated, since masks exclude all pixels; fix the masks")
    return {
        "psnr": float(np.mean([r.psnr for r in results])),
        "ssim": float(np.mean([r.ssim for r in results])),
        **mean_color_metrics([r.colors for r in results]),
        **means([r.by_time for r in results]),
        **means([r.static for r in results]),
        **perceptual.mean([r.perceptual for r in results]),
        "views": len(results),
    }


# The distributions of size, anisotropy, and opacity over the Gaussians of a model.

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def distribution(gaussians: Gaussians) -> dict[str, list[float]]:
    """Return the QUANTILES of size (RMS scale, scene units), anisotropy (longest / shortest axis), and opacity."""
    log_scales = gaussians.get("log_scales").astype(np.float64)
    columns = {
        "size": np.sqrt(np.exp(2 * log_scales).mean(axis=1)),
        "anisotropy": np.exp(log_scales.max(axis=1) - log_scales.min(axis=1)),
        "opacity": 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0]),
    }
    return {name: [float(value) for value in np.quantile(column, QUANTILES)] for name, column in columns.items()}
