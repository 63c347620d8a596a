"""Compute perceptual metrics of 8-bit images on the host: MS-SSIM, FLIP, and LPIPS."""

import hashlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.core.child import run_module
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.reading import read_file

# LPIPS with a network from a local ONNX file, run by OpenCV's DNN module, without downloads or torch.

InputRange = Literal["-1..1", "0..1"]
TIMEOUT_S = 300  # enough for a slow machine to read a network of 60 MB and to run it on images of one megapixel
_tested_networks: set[tuple[str, int, int]] = set()  # digest, height and width that ran without a crash
INPUTS = ("in0", "in1")  # the arguments of lpips.LPIPS.forward


class Lpips:
    """Learned perceptual distance (Zhang et al. 2018); 0 for equal images.

    The ONNX file is the output of `clsplat data lpips`, or of `torch.onnx.export` for `lpips.LPIPS(net="vgg")` with
    dynamic height and width.  It has two inputs, `in0` and `in1`, RGB, [1, 3, height, width], and a scalar output.
    The network expects values in [-1, 1]; 3DGS and Mip-Splatting report its results for values in [0, 1].
    """

    def __init__(self, path: Path, inputs: InputRange) -> None:
        data = read_file(path, "an ONNX file of LPIPS")
        self.path, self.inputs = path, inputs
        self.digest = hashlib.sha256(data).hexdigest()
        self._data, gray = data, np.full((64, 64, 3), 128, np.uint8)
        self._test(*gray.shape[:2])
        try:
            self._network = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
        except cv2.error as error:
            raise DataError(
                f"{path}: not an ONNX file that OpenCV {cv2.__version__} can read ({_last_line(error)}); "
                "write one with `clsplat data lpips`"
            ) from error
        if (distance := self.distance(gray, gray)) != 0:
            raise ConfigError(
                f"{path}: not LPIPS: equal images have distance {distance:g}; write it with `clsplat data lpips`"
            )

    def distance(self, image: NDArray[np.uint8], photograph: NDArray[np.uint8]) -> float:
        """Return the distance of two images, [height, width, 3].  Raises ConfigError if the network rejects them."""
        self._test(*image.shape[:2])
        try:
            for name, pixels in zip(INPUTS, (image, photograph), strict=True):
                self._network.setInput(self._planes(pixels), name)
            output = np.asarray(self._network.forward())
        except cv2.error as error:
            size = f"{image.shape[1]}x{image.shape[0]}"
            raise ConfigError(
                f"{self.path}: cannot compare images of {size} ({_last_line(error)}); expected the inputs "
                f"{' and '.join(INPUTS)} of [1, 3, height, width], with dynamic height and width"
            ) from error
        if output.size != 1 or output.dtype.kind != "f" or not np.isfinite(output).all():
            raise ConfigError(
                f"{self.path}: expected one finite float for two images, got {output.ravel()[:4].tolist()}"
            )
        return float(output.ravel()[0])

    def _test(self, height: int, width: int) -> None:
        """Run the network in a child process, once per size.  Raises DataError if OpenCV crashes."""
        if (self.digest, height, width) in _tested_networks:
            return
        seconds = TIMEOUT_S * max(1.0, height * width / 1e6)
        module, size = "clsplat.metrics.perceptual", (str(height), str(width))
        if crash := run_module(module, *size, seconds=seconds, stdin=self._data).crash:
            problem = f"{crash} when it runs this network on images of {width}x{height}"
            raise DataError(f"{self.path}: OpenCV {cv2.__version__} {problem}; export the network again")
        _tested_networks.add((self.digest, height, width))

    def origin(self) -> dict[str, str]:
        """Return the input range and the network, by key of metrics.json.  Compare values only if both are equal."""
        return {"lpips_input": self.inputs, "lpips_model": f"{self.path.name} sha256:{self.digest[:16]}"}

    def _planes(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        values = image.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255)
        return np.ascontiguousarray(values if self.inputs == "0..1" else 2 * values - 1)


def _last_line(error: cv2.error) -> str:
    """Return the last line of OpenCV's message."""
    return (error.err or str(error)).strip().splitlines()[-1][:120]


Metric = Literal["psnr", "ssim", "ms_ssim", "flip"]
METRICS: tuple[Metric, ...] = get_args(Metric)
Image = NDArray[np.uint8]
Floats = NDArray[np.float64]

MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang et al. 2003, finest scale first
RADIUS, SIGMA = 5, 1.5  # px, of the 11 x 11 window
C1, C2 = 0.01**2, 0.03**2


@dataclass(frozen=True)
class Perceptual:
    """The metrics to compute in addition to PSNR and SSIM."""

    names: tuple[Metric, ...] = ()
    lpips: Lpips | None = None

    @classmethod
    def open(cls, names: Sequence[Metric], lpips: str | Path | None, lpips_input: InputRange) -> "Perceptual":
        """Load the metrics.  Raises ConfigError for a missing package, DataError for a missing network."""
        extra_names = tuple(name for name in METRICS[2:] if name in names)
        if "flip" in extra_names:
            _flip_package()
        return cls(extra_names, Lpips(Path(lpips), lpips_input) if lpips is not None else None)

    def measure(self, image: Image, photograph: Image) -> dict[str, float | None]:
        """Return the metrics of one view, by name.  image, photograph: [height, width, 3]."""
        values: dict[str, float | None] = {}
        if "ms_ssim" in self.names:
            values["ms_ssim"] = ms_ssim(image, photograph)
            values["ms_ssim_scales"] = ms_ssim_scales(image)
        if "flip" in self.names:
            values["flip"] = flip(image, photograph)
        if self.lpips is not None:
            values["lpips"] = self.lpips.distance(image, photograph)
        return values

    def mean(self, view_metrics: Sequence[dict[str, float | None]]) -> dict[str, Any]:
        """Return the means over views, with the keys of metrics.json, and the reasons why values are missing."""
        averages: dict[str, Any] = {name: _mean(view_metrics, name) for name in self.names}
        if "ms_ssim" in self.names:
            averages["ms_ssim_scales"] = min(int(metrics["ms_ssim_scales"] or 0) for metrics in view_metrics)
            if averages["ms_ssim"] is None:
                averages["ms_ssim_reason"] = f"images are smaller than the window of {2 * RADIUS + 1} px"
        if self.lpips is None:
            return {**averages, "lpips": None, "lpips_reason": "no ONNX file given"}
        return {**averages, "lpips": _mean(view_metrics, "lpips"), **self.lpips.origin()}


def metric_names(names: Sequence[str]) -> list[Metric]:
    """Return the metrics with these names, in the order of METRICS.  Raises ConfigError for an unknown name."""
    if unknown_names := [name for name in names if name not in METRICS]:
        raise ConfigError(f"unknown metric '{unknown_names[0]}'; expected one of {', '.join(METRICS)}")
    return [name for name in METRICS if name in names]


def _mean(view_metrics: Sequence[dict[str, float | None]], name: str) -> float | None:
    values = [value for metrics in view_metrics if (value := metrics[name]) is not None]
    return float(np.mean(values)) if values else None


def ms_ssim_scales(image: Image) -> int:
    """Return the number of scales, at most five, at which the window fits into the image."""
    side = min(image.shape[:2])
    return sum(side >> scale >= 2 * RADIUS + 1 for scale in range(len(MS_SSIM_WEIGHTS)))


def ms_ssim(image: Image, photograph: Image) -> float | None:
    """Return the multi-scale structural similarity (Wang, Simoncelli and Bovik 2003), in double precision.

    The result is a product over scales, averaged over channels.  At each scale, the mean of the contrast-structure
    factor, multiplied at the coarsest scale by the luminance factor, is raised to the scale's weight.  Each scale
    averages 2 x 2 pixels of the previous one.  Means are over pixels whose 11 x 11 Gaussian window is inside the
    image; negative means count as 0.  Images with a side below 176 px have fewer scales, whose weights are
    renormalized.  Returns None if the image is smaller than the window.
    """
    scales = ms_ssim_scales(image)
    if scales == 0:
        return None
    weights = np.array(MS_SSIM_WEIGHTS[:scales]) / sum(MS_SSIM_WEIGHTS[:scales])
    x, y = image / 255.0, photograph / 255.0
    product = np.ones(3)
    for scale, weight in enumerate(weights):
        if scale > 0:
            x, y = _halve(x), _halve(y)
        luminance, structure = _ssim_factors(x, y)
        similarity = structure * luminance if scale == scales - 1 else structure
        product *= np.maximum(similarity.mean(axis=(0, 1)), 0) ** weight
    return float(product.mean())


def _halve(image: Floats) -> Floats:
    """Average blocks of 2 x 2 pixels; an odd last row or column is ignored."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    even_part = image[:height, :width]
    mean: Floats = (even_part[::2, ::2] + even_part[1::2, ::2] + even_part[::2, 1::2] + even_part[1::2, 1::2]) / 4
    return mean


def ssim_map(image: Image, photograph: Image) -> Floats:
    """Return the structural similarity of every pixel and channel, [H, W, 3], with zero padding as in training."""
    padding = ((RADIUS, RADIUS), (RADIUS, RADIUS), (0, 0))
    luminance, structure = _ssim_factors(np.pad(image / 255.0, padding), np.pad(photograph / 255.0, padding))
    return luminance * structure


def _ssim_factors(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the luminance and contrast-structure factors of pixels with a complete window (Wang et al. 2004)."""
    mx, my = _window_mean(x), _window_mean(y)
    variances = _window_mean(x * x) - mx * mx + _window_mean(y * y) - my * my
    covariance = _window_mean(x * y) - mx * my
    return (2 * mx * my + C1) / (mx * mx + my * my + C1), (2 * covariance + C2) / (variances + C2)


def _window_mean(image: Floats) -> Floats:
    taps = np.exp(-(np.arange(-RADIUS, RADIUS + 1) ** 2) / (2 * SIGMA**2))
    taps /= taps.sum()
    rows = scipy.ndimage.correlate1d(image, taps, axis=0)[RADIUS:-RADIUS]
    return np.asarray(scipy.ndimage.correlate1d(rows, taps, axis=1)[:, RADIUS:-RADIUS])


def flip(image: Image, photograph: Image) -> float:
    """Return the mean FLIP (Andersson et al. 2020) at 67 px per degree.  Raises ConfigError if it is not installed."""
    reference, test = (np.ascontiguousarray(pixels, np.float32) / np.float32(255) for pixels in (photograph, image))
    _, mean, _ = _flip_package().evaluate(reference, test, "LDR", applyMagma=False)
    return float(mean)


def _flip_package() -> ModuleType:
    try:
        import flip_evaluator
    except ImportError as error:
        raise ConfigError("metric 'flip' needs a package; in a checkout, run `pip install '.[metrics]'`") from error
    return flip_evaluator  # type: ignore[no-any-return]


if __name__ == "__main__":  # run in a child process, because a damaged network may crash it
    network = cv2.dnn.readNetFromONNX(np.frombuffer(sys.stdin.buffer.read(), np.uint8))
    for name in INPUTS:
        network.setInput(np.zeros((1, 3, *map(int, sys.argv[1:])), np.float32), name)
    network.forward()
