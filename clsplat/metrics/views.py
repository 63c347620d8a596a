"""The metrics of a model at the views of a scene, and their means."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, NumericError, pluralize
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

# What should not move, measured: PSNR of the static pixels of a scene that moves, and how much its pictures flicker.

STILL = 3.0  # levels of standard deviation: the noise of a camera; what moves through a pixel gives more
MOST_CAMERAS = 8  # whose sums are held, 48 bytes a pixel each
LEAST_MOMENTS = 2
FLICKER, OF_PHOTOGRAPHS, STATIC, SHARE = "flicker", "flicker_photographs", "psnr_static", "static_share"


@dataclass
class Spread:
    """Sums over the moments of one camera, exact in whole numbers, in whatever order they come."""

    count: int = 0
    total: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((), np.uint32))  # [H, W, 3]
    squares: NDArray[np.uint32] = field(default_factory=lambda: np.zeros((), np.uint32))

    def add(self, image: Image) -> None:
        """Add an 8-bit image, [H, W, 3]."""
        values = image.astype(np.uint32)
        self.count += 1
        self.total, self.squares = self.total + values, self.squares + values * values

    def deviation(self) -> NDArray[np.float64]:
        """Return the standard deviation over the moments, [H, W, 3], levels."""
        mean = self.total / self.count
        return np.asarray(np.sqrt(np.maximum(self.squares / self.count - mean * mean, 0)))


@dataclass
class Station:
    """One camera: its renders, its photographs, and the pixels that may be static."""

    views: list[str] = field(default_factory=list)
    renders: Spread = field(default_factory=Spread)
    photographs: Spread = field(default_factory=Spread)
    counted: Mask | None = None  # static by the file, and counted by the masks of all moments
    told: bool = False  # whether a file says what is static


class Stillness:
    """Gathers the views of a measurement, camera by camera.

    Of a camera that shows one moment, as of one that moves, nothing is held.
    """

    def __init__(self, views: Sequence[View]) -> None:
        """views: all that are to be added, in any order."""
        cameras = [group for group in group_by_camera(views) if len(distinct_times(group)) >= LEAST_MOMENTS]
        self._stations = {camera_key(group[0]): Station() for group in cameras[:MOST_CAMERAS]}

    @property
    def held(self) -> int:
        """The number of cameras whose sums are held."""
        return len(self._stations)

    def add(self, view: View, rendered: Image, photograph: Image, counted: Mask | None) -> dict[str, float]:
        """Take a view's 8-bit images, [H, W, 3]; return its PSNR of static pixels where a file says which these are."""
        still = static_pixels(view)
        known = still if counted is None else counted if still is None else still & counted
        if view.time is not None:
            self._gather(view, rendered, photograph, known, still is not None)
        if still is None or known is None or not known.any():
            return {}
        return {STATIC: psnr(rendered, photograph, known)}

    def _gather(self, view: View, rendered: Image, photograph: Image, known: Mask | None, told: bool) -> None:
        if (station := self._stations.get(camera_key(view))) is None:
            return
        station.views.append(view.name)
        station.renders.add(rendered)
        station.photographs.add(photograph)
        station.told |= told
        if known is not None:
            station.counted = known if station.counted is None else station.counted & known

    def figures(self) -> dict[str, dict[str, float]]:
        """Return the flicker of each view's camera by the name of the view; none of cameras with one moment."""
        found = dict[str, dict[str, float]]()
        for station in self._stations.values():
            if station.renders.count < LEAST_MOMENTS:
                continue
            shown, taken = station.renders.deviation(), station.photographs.deviation()
            still = np.ones(shown.shape[:2], bool) if station.counted is None else station.counted
            if not station.told:
                still = still & (taken.max(axis=2) <= STILL)
            if still.any():
                one = {FLICKER: float(shown[still].mean()), OF_PHOTOGRAPHS: float(taken[still].mean())}
                found |= {name: {**one, SHARE: float(still.mean())} for name in station.views}
        return found


def static_pixels(view: View) -> Mask | None:
    """Return which pixels of a view show nothing that moves, [H, W]; None where no file says that."""
    if view.static_path is None:
        return None
    return load_mask(replace(view, mask_path=view.static_path, alpha="transparency"))


def means(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each figure over the views that have it, in the order in which the figures came."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    return {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}


# PSNR of a rendered image in the colors of its photograph, which no training has seen.

GUESSED = 1.0  # dB by which figures in the photographs' colors are better, from which on the log says why

LEAST = 1e-3  # slope of a regression, below which there is nothing to divide by
# Usable pixels for each number that is fitted to a channel: p numbers of n independent errors add p / n of their
# variance to what is measured elsewhere, here 1 / 64, which is 0.07 dB.
PIXELS = 64


class Fitted(Protocol):
    """Colors of photographs that can be fitted to one."""

    fitted_to_a_channel: ClassVar[int]  # numbers that `fitted` finds for each of red, green and blue

    def fitted(self, image: NDArray[np.float64], photograph: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the matrix, [3, 4], that brings an image nearest to a photograph, pixels [M, 3]."""


class Gains:
    """Gains of red, green and blue."""

    fitted_to_a_channel: ClassVar[int] = 1

    def fitted(self, image: NDArray[np.float64], photograph: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the matrix, [3, 4], of the gains that bring an image nearest to a photograph by least squares, pixels
        [M, 3]."""
        squares, products = (image * image).sum(axis=0), (image * photograph).sum(axis=0)
        gains = np.where((squares > 0) & (products > 0), products / np.where(squares > 0, squares, 1), 1.0)
        return np.column_stack([np.diag(gains), np.zeros(3)])


def color_figures(
    image: NDArray[np.float32], photograph: NDArray[np.uint8], mask: Mask | None, model: Fitted
) -> dict[str, float]:
    """Return `psnr_color` and `psnr_affine`, dB, of an image as it was rendered and a photograph, [height, width, 3].

    mask: pixels that count, [height, width].  Without `psnr_color` where a half has too few pixels to fit colors to.
    Of the image NaN counts as black, and what is infinite as white or black.
    """
    truth, finite = photograph / 255.0, np.nan_to_num(image.astype(np.float64), nan=0.0, posinf=1.0, neginf=0.0)
    counted = np.ones(truth.shape[:2], bool) if mask is None else mask
    changed = in_colors_of(finite, photograph, counted, model)
    corrected = corrected_by_regression(finite, truth, counted)
    own = {} if changed is None else {"psnr_color": psnr(changed, photograph, counted)}
    return {**own, "psnr_affine": psnr(corrected, photograph, counted)}


def mean_figures(rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Return the averages over views of what color_figures returned, with the keys of metrics.json.

    Where views have no `psnr_color`, `psnr_color_views` is the number of those that have, and `psnr_color_reason`
    says why; where none has, it is None.
    """
    found, has = means(rows), [row for row in rows if "psnr_color" in row]
    if not found or len(has) == len(rows):
        return found
    reason = f"{len(rows) - len(has)} of {len(rows)} views have a half with too few pixels to fit colors to"
    return {"psnr_color": None, **found, "psnr_color_views": len(has), "psnr_color_reason": reason}


def in_colors_of(
    image: NDArray[np.float64], photograph: NDArray[np.uint8], counted: Mask, model: Fitted
) -> NDArray[np.float64] | None:
    """Return the image with each half, left and right, in the colors that the other half of the photograph asks for.

    Pixels that are black or white in the photograph say nothing of its colors.  None where a half has fewer than
    PIXELS others for each number that is fitted to a channel: that depends on the photograph and the mask alone, so
    that models are compared on the same views.  Those beyond white in the image are left out of the fit where enough
    others are left; else all count.
    """
    usable = counted & ((photograph > 0) & (photograph < 255)).all(axis=2)
    middle, truth, changed = image.shape[1] // 2, photograph / 255.0, image.copy()
    left, right = np.s_[:, :middle], np.s_[:, middle:]
    fewest = PIXELS * model.fitted_to_a_channel
    if min(np.count_nonzero(usable[half]) for half in (left, right)) < fewest:
        return None
    for half, other in ((left, right), (right, left)):
        below = usable[other] & (image[other] < 1).all(axis=2)
        fitted_to = below if np.count_nonzero(below) >= fewest else usable[other]
        matrix = model.fitted(image[other][fitted_to], truth[other][fitted_to])
        changed[half] = np.minimum(np.einsum("hwc,ac->hwa", image[half], matrix[:, :3]) + matrix[:, 3], 1)
    return changed


def corrected_by_regression(
    image: NDArray[np.float64], truth: NDArray[np.float64], counted: Mask
) -> NDArray[np.float64]:
    """Return (image - b) / a of each channel, where a truth + b is nearest to the image (gsplat).

    Regressing the image on the photograph divides by a slope that noise makes too small: no least-squares correction.
    """
    corrected = image.copy()
    for channel in range(3):
        x, y = truth[..., channel][counted], image[..., channel][counted]
        variance = float(np.mean((x - x.mean()) ** 2))
        slope = float(np.mean((x - x.mean()) * (y - y.mean()))) / variance if variance > 0 else 1.0
        if abs(slope) > LEAST:
            corrected[..., channel] = (image[..., channel] - (y.mean() - slope * x.mean())) / slope
    return np.clip(corrected, 0, 1)


def tell_of_colors(averages: dict[str, Any]) -> None:
    """Log the figures of a split in the photographs' colors, where there are any."""
    if "psnr_color" not in averages:
        return
    figure, reason = averages["psnr_color"], averages.get("psnr_color_reason")
    if figure is None:
        LOG.warning("no PSNR in the photographs' colors: %s", reason)
    elif reason:
        LOG.warning(
            "in the photographs' colors: PSNR %.2f dB, the mean of %s: %s",
            *(figure, pluralize(averages["psnr_color_views"], "view"), reason),
        )
    else:
        differ = figure - averages["psnr"] > GUESSED
        why = "; exposures of these photographs differ, which PSNR counts as errors" if differ else ""
        LOG.info("in the photographs' colors: PSNR %.2f dB%s", figure, why)


# PSNR of a scene that moves, apart for moments that training has seen and for those that it has not.

HELD_OUT, OTHERS = "psnr_held_out_moments", "psnr_other_moments"


def by_moment(psnr: Mapping[str, float], views: Sequence[View], trained: Sequence[View]) -> dict[str, dict[str, float]]:
    """Return the PSNR of views, dB, by their names, once more by whether the moment is one of the views trained on.

    There is none where only one of both kinds is there, as where nothing moves.
    """
    known, times = set(distinct_times(trained)), {view.name: view.time for view in views}
    kinds = {name: OTHERS if time in known else HELD_OUT for name, time in times.items() if time is not None}
    if not known or {kinds.get(name) for name in psnr} != {HELD_OUT, OTHERS}:
        return {}
    return {name: {kinds[name]: value} for name, value in psnr.items()}


LOG = logging.getLogger("clsplat")
PSNR_AND_SSIM = Perceptual()


@dataclass(frozen=True)
class ViewMetrics:
    """One view's figures."""

    view: str
    psnr: float  # dB
    ssim: float
    perceptual: dict[str, float | None] = field(default_factory=dict)
    colors: dict[str, float] = field(default_factory=dict)  # dB, by name, where photographs have colors of their own
    still: dict[str, float] = field(default_factory=dict)  # of static pixels, where the scene moves
    moments: dict[str, float] = field(default_factory=dict)  # dB, by whether the moment is held out

    def line(self) -> dict[str, Any]:
        """Return the figures as in a line of metrics.jsonl."""
        return {
            "view": self.view,
            "psnr": self.psnr,
            "ssim": self.ssim,
            **self.colors,
            **self.moments,
            **self.still,
            **self.perceptual,
        }


def render_view(painter: Painter, camera: DeviceCamera) -> Image:
    """Render to 8 bits, [height, width, 3]: clamped to [0, 1], rounded to the nearest."""
    return to_8_bits(render_floats(painter, camera))


def render_floats(painter: Painter, camera: DeviceCamera, response: Any = None) -> NDArray[np.float32]:
    """Render to floats, [height, width, 3], as they are, or as a camera with that response takes them."""
    picture = painter.paint(camera)
    planes = (response(painter.workspace, camera, picture) if response else picture).get()
    return np.ascontiguousarray(planes[:, : camera.height, : camera.width].transpose(1, 2, 0))


def require_finite(image: NDArray[np.float32], view: View) -> None:
    """Raise NumericError where a picture has values that are not finite."""
    if not np.isfinite(image).all():
        raise NumericError(
            f"view '{view.name}': its picture is not finite, since values of the model are too large for 32 bits; "
            "export the model again, or train it with lower rates"
        )


def device_ssim(workspace: Workspace, photograph: Photograph, image: Image) -> float:
    """Return the SSIM of an 8-bit image, [height, width, 3], and the photograph, computed on the device."""
    camera = photograph.camera
    pixels = workspace.device.upload(np.ascontiguousarray(image.transpose(2, 0, 1)))
    rendered = unpack(workspace, camera, pixels, 1 / 255, "rendered")
    planes = photograph.planes(workspace)
    _, sums = ssim_maps(Comparison(workspace, camera, rendered, planes.colors, gradient=rendered))
    return float(sums.get().sum(dtype=np.float64)) / (3 * camera.width * camera.height)


def measure(
    painter: Painter,
    views: Sequence[View],
    photographs: Photographs,
    perceptual: Perceptual = PSNR_AND_SSIM,
    finite: bool = False,
    colors: Fitted | None = None,
    counted: Iterable[View] | None = None,
    trained: Sequence[View] = (),
) -> list[ViewMetrics]:
    """Return the metrics of every view.

    Masked pixels are black in both images; PSNR and SSIM are means over the other pixels.
    colors: the photographs' in training, for figures in their colors beside PSNR; counted: the views, of somebody who
    counts them; trained: the views that were trained on, for the figures of moments of a scene that moves.
    With `finite`, NumericError is raised for a picture that is not finite, which counts as black otherwise.
    """
    results, stillness = list[ViewMetrics](), Stillness(views)
    for view in views if counted is None else counted:
        photograph = photographs.get(view)
        if photograph.empty:
            LOG.warning("%s: not measured, since its mask leaves out every pixel; look at the mask", view.name)
            continue
        floats = render_floats(painter, photograph.camera, view.response)
        if finite:
            require_finite(floats, view)
        rendered = to_8_bits(floats)
        image, mask = photograph.image(), photograph.counted()
        own = color_figures(floats, image, mask, colors) if colors else {}
        still = stillness.add(view, rendered, image, mask)
        if mask is None:
            similarity = device_ssim(painter.workspace, photograph, rendered)
        else:
            rendered, image = rendered * mask[..., None], image * mask[..., None]
            similarity = ssim(rendered, image, mask)
        more = perceptual.measure(rendered, image)
        results.append(ViewMetrics(view.name, psnr(rendered, image, mask), similarity, more, own, still))
    flicker, moments = stillness.figures(), by_moment({one.view: one.psnr for one in results}, views, trained)
    return [
        replace(one, still={**one.still, **flicker.get(one.view, {})}, moments=moments.get(one.view, {}))
        for one in results
    ]


def mean(results: Sequence[ViewMetrics], perceptual: Perceptual = PSNR_AND_SSIM) -> dict[str, Any]:
    """Return averages over views, with the keys of metrics.json."""
    if not results:
        raise DataError("no view can be measured: the masks leave out every pixel; fix the masks")
    return {
        "psnr": float(np.mean([r.psnr for r in results])),
        "ssim": float(np.mean([r.ssim for r in results])),
        **mean_figures([r.colors for r in results]),
        **means([r.moments for r in results]),
        **means([r.still for r in results]),
        **perceptual.mean([r.perceptual for r in results]),
        "views": len(results),
    }


# The distributions of size, anisotropy and opacity over the Gaussians of a model.

SHARES = (0.05, 0.25, 0.5, 0.75, 0.95)


def distribution(gaussians: Gaussians) -> dict[str, list[float]]:
    """Return quantiles, at SHARES: size (rms scale, scene units), anisotropy (longest by shortest axis), opacity."""
    log_scales = gaussians.get("log_scales").astype(np.float64)
    columns = {
        "size": np.sqrt(np.exp(2 * log_scales).mean(axis=1)),
        "anisotropy": np.exp(log_scales.max(axis=1) - log_scales.min(axis=1)),
        "opacity": 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0]),
    }
    return {name: [float(value) for value in np.quantile(column, SHARES)] for name, column in columns.items()}
