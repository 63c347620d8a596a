"""MS-SSIM against the reference; FLIP and LPIPS if their packages and files are available."""

import sys

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from clsplat.conformance import reference as ref
from clsplat.core.child import ChildResult
from clsplat.core.errors import ConfigError, DataError
from clsplat.metrics import perceptual as perceptual_metrics
from clsplat.metrics.perceptual import Lpips, Perceptual, flip, metric_names, ms_ssim, ms_ssim_scales
from clsplat.stages.evaluate import Evaluate
from tests.support.data_sets import data_set
from tests.support.onnx_writer import distance_network


def images(rng, height: int, width: int, noise: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """A smooth random image and a noisy copy, 8 bits."""
    coarse = rng.uniform(0, 255, (max(2, height // 8), max(2, width // 8), 3))
    photograph = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    image = photograph + rng.normal(0, noise, photograph.shape)
    return np.clip(image, 0, 255).astype(np.uint8), np.clip(photograph, 0, 255).astype(np.uint8)


# 11 px is the window; 22, 44, 88 and 176 are the smallest sides of 2, 3, 4 and 5 scales; odd sides lose a row
@pytest.mark.parametrize(
    ("height", "width", "scales"),
    [(11, 30, 1), (21, 40, 1), (22, 23, 2), (43, 60, 2), (45, 44, 3), (91, 100, 4), (176, 177, 5), (201, 190, 5)],
)
def test_ms_ssim_matches_the_reference(rng, height, width, scales):
    image, photograph = images(rng, height, width)
    assert ms_ssim_scales(image) == scales
    x, y = (pixels.astype(np.float64).transpose(2, 0, 1) / 255 for pixels in (image, photograph))
    assert ms_ssim(image, photograph) == pytest.approx(ref.ms_ssim(x, y, scales), rel=1e-12)
    assert 0 < ms_ssim(image, photograph) < 1


def test_single_scale_matches_scikit_image(rng):
    metrics = pytest.importorskip("skimage.metrics")
    image, photograph = images(rng, 21, 40)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255}
    _, full = metrics.structural_similarity(image, photograph, channel_axis=2, full=True, **options)
    assert ms_ssim(image, photograph) == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-6)


def test_ms_ssim_of_equal_opposite_and_tiny_images(rng):
    image, photograph = images(rng, 60, 50)
    assert ms_ssim(photograph, photograph) == 1
    assert ms_ssim(255 - photograph, photograph) == 0, "negative structure counts as none"
    assert ms_ssim(image[:10], photograph[:10]) is None
    more = images(rng, 60, 50, noise=60)[0]
    assert ms_ssim(more, photograph) < ms_ssim(image, photograph)


def test_averages_explain_a_missing_metric(rng):
    perceptual = Perceptual(("ms_ssim",))
    small = [perceptual.measure(*images(rng, 9, 40)) for _ in range(2)]
    averages = perceptual.mean(small)
    assert averages["ms_ssim"] is None
    assert "smaller than the window of 11 px" in averages["ms_ssim_reason"]
    assert averages["lpips"] is None
    assert averages["lpips_reason"] == "no ONNX file given"
    both = perceptual.mean([perceptual.measure(*images(rng, height, 50)) for height in (50, 30)])
    assert both["ms_ssim_scales"] == 2
    assert "ms_ssim_reason" not in both


def test_flip_matches_its_package_and_is_zero_for_equal_images(rng):
    package = pytest.importorskip("flip_evaluator")
    image, photograph = images(rng, 40, 60)
    assert flip(photograph, photograph) == 0
    _, expected, _ = package.evaluate(
        (photograph / 255).astype("f4"), (image / 255).astype("f4"), "LDR", applyMagma=False
    )
    assert flip(image, photograph) == pytest.approx(expected, rel=1e-6)
    assert 0 < flip(image, photograph) < flip(255 - photograph, photograph) < 1


def test_flip_without_its_package_is_refused_before_training(monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(ConfigError, match=r"pip install '\.\[metrics\]'"):
        Evaluate(metrics=["psnr", "ssim", "flip"]).check()


def test_psnr_and_ssim_are_always_measured():
    with pytest.raises(ValidationError, match="are required, since every"):
        Evaluate(metrics=["flip"])
    with pytest.raises(ConfigError, match="unknown metric 'mssim'; expected one of psnr, ssim, ms_ssim, flip"):
        metric_names(["psnr", "mssim"])


@pytest.fixture
def network(tmp_path):
    def write(**changes: object) -> Lpips:
        path = tmp_path / "distance.onnx"
        path.write_bytes(distance_network(**changes))
        return path

    return write


def test_lpips_runs_the_network_on_the_stated_range(rng, network):
    """The range doubles differences, so this network's squares are four times as large."""
    path = network()
    for height, width in ((40, 30), (33, 57), (40, 30)):  # one network, several sizes
        image, photograph = images(rng, height, width)
        expected = np.mean(((image.astype(np.float64) - photograph) / 255) ** 2)
        assert Lpips(path, "0..1").distance(image, photograph) == pytest.approx(expected, rel=1e-5)
        assert Lpips(path, "-1..1").distance(image, photograph) == pytest.approx(4 * expected, rel=1e-5)


def test_lpips_reports_its_source(rng, network):
    perceptual = Perceptual.open(["psnr", "ssim"], network(), "0..1")
    averages = perceptual.mean([perceptual.measure(*images(rng, 20, 20)) for _ in range(3)])
    assert averages["lpips"] > 0
    assert averages["lpips_input"] == "0..1"
    assert averages["lpips_model"].startswith("distance.onnx sha256:")
    assert "lpips_reason" not in averages


def test_files_that_are_not_lpips_are_refused(rng, network, tmp_path):
    with pytest.raises(DataError, match=r"nowhere.onnx: cannot be read"):
        Evaluate(lpips=str(tmp_path / "nowhere.onnx")).check()
    (tmp_path / "text.onnx").write_text("not a network")
    with pytest.raises(DataError, match="not an ONNX file"):
        Lpips(tmp_path / "text.onnx", "-1..1")
    with pytest.raises(ConfigError, match="expected the inputs in0 and in1") as error:
        Lpips(network(inputs=("image", "photograph")), "-1..1")
    assert "\n" not in str(error.value)
    with pytest.raises(ConfigError, match=r"equal images have distance 0.5"):
        Lpips(network(offset=0.5), "-1..1")


def test_network_that_crashes_opencv_ends_no_process(network, monkeypatch):
    """Children crash instead of OpenCV, which does not crash at the same files, and image sizes, in all versions."""
    path = network()
    ends = iter([ChildResult(-11, ""), ChildResult(0, ""), ChildResult(-11, "")])
    monkeypatch.setattr(perceptual_metrics, "run_module", lambda *words, **values: next(ends))
    monkeypatch.setattr(perceptual_metrics, "_tested_networks", set())
    crash = r"distance.onnx: OpenCV .* crashes with SIGSEGV when it runs this network on images of"
    with pytest.raises(DataError, match=f"{crash} 64x64"):
        Lpips(path, "0..1")
    for _ in range(2):
        lpips = Lpips(path, "0..1")
    small = np.zeros((48, 32, 3), np.uint8)
    with pytest.raises(DataError, match=f"{crash} 32x48"):
        lpips.distance(small, small)


@pytest.mark.parametrize("name", ["segv.onnx", "lpips_11_1.bin"])
def test_damaged_networks_are_refused(name):
    file = data_set("cases") / "onnx" / name
    with pytest.raises((DataError, ConfigError), match=f"{name}: "):
        Lpips(file, "-1..1")
