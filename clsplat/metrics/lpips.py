"""LPIPS with a network in a local ONNX file, on OpenCV's DNN module: without downloads and without torch."""

import hashlib
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.errors import ConfigError, DataError
from clsplat.reading import read_file

InputRange = Literal["-1..1", "0..1"]
INPUTS = ("in0", "in1")  # the arguments of lpips.LPIPS.forward


class Lpips:
    """Learned perceptual distance (Zhang et al. 2018); 0 for equal images.

    The file holds a network of two inputs `in0` and `in1`, RGB of [1, 3, height, width], and one number as output: the
    result of `torch.onnx.export` for `lpips.LPIPS(net="vgg")`, with free height and width.  That network expects values
    in [-1, 1]; the tables of 3DGS and Mip-Splatting have values in [0, 1], which give smaller distances.
    """

    def __init__(self, path: Path, inputs: InputRange) -> None:
        data = read_file(path, "an ONNX file of LPIPS")
        self.path, self.inputs = path, inputs
        self.digest = hashlib.sha256(data).hexdigest()
        try:
            self._network = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
        except cv2.error as error:
            raise DataError(
                f"{path}: not an ONNX file that OpenCV {cv2.__version__} reads ({_short(error)})"
            ) from error
        grey = np.full((64, 64, 3), 128, np.uint8)
        if (distance := self.distance(grey, grey)) != 0:
            raise ConfigError(f"{path}: the distance of equal images is {distance:g}, expected 0: this is not LPIPS")

    def distance(self, image: NDArray[np.uint8], photograph: NDArray[np.uint8]) -> float:
        """Return the distance of two images, [height, width, 3]."""
        try:
            for name, pixels in zip(INPUTS, (image, photograph), strict=True):
                self._network.setInput(self._planes(pixels), name)
            output = np.asarray(self._network.forward())
        except cv2.error as error:
            size = f"{image.shape[1]}x{image.shape[0]}"
            raise ConfigError(
                f"{self.path}: cannot compare images of {size} ({_short(error)}); expected the inputs "
                f"{' and '.join(INPUTS)} of [1, 3, height, width], with free height and width"
            ) from error
        if output.size != 1 or not np.isfinite(output).all():
            raise ConfigError(f"{self.path}: expected one finite number for two images, got {output.size} values")
        return float(output.ravel()[0])

    def origin(self) -> dict[str, str]:
        """Return input range and network: figures are comparable only where both are equal."""
        return {"lpips_input": self.inputs, "lpips_model": f"{self.path.name} sha256:{self.digest[:16]}"}

    def _planes(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        values = image.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255)
        return np.ascontiguousarray(values if self.inputs == "0..1" else 2 * values - 1)


def _short(error: cv2.error) -> str:
    """The last line of OpenCV's message, without file and line."""
    return (error.err or str(error)).strip().splitlines()[-1][:120]
