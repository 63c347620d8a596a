"""Vignetting and response curves per camera: the kernel, whole runs, and the same module as a plug-in."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import clsplat
from clsplat.api.commands import evaluate
from clsplat.conformance.checks.appearance import check_response
from clsplat.conformance.reference.appearance import apply_response, apply_response_backward
from clsplat.core.errors import DataError
from clsplat.core.resources import resource_dir
from clsplat.data_tools.synthetic import write_dataset
from clsplat.training.modules import camera_response
from clsplat.training.run import Run
from tests.support.city import City
from tests.support.deviations import assert_within_bounds
from tests.support.devices import on_devices
from tests.support.runs import FEW, digest, killed, train

EXAMPLE = Path(__file__).parents[2] / "examples" / "lens_and_curves.py"
RESPONSE = (*FEW, "optimize.modules.exposure={}", "optimize.modules.camera_response={rate: 0.02}")


@on_devices("width, height", [(1, 1), (15, 4), (17, 5), (33, 18), (257, 3)])
def test_image_and_derivatives(device, rng, width, height):
    assert_within_bounds(check_response(device, rng, width, height))


def test_reference_against_finite_differences(rng):
    image, gradient, step = *rng.uniform(-0.3, 1.5, (2, 3, 5, 6)), 1e-6
    row = np.concatenate([rng.normal(0, 0.1, 5), rng.normal(0, 0.4, 12)])
    for array, found in zip((image, row), apply_response_backward(image, row, (2.5, 4.0), gradient), strict=True):
        for index in np.ndindex(array.shape):
            ends, value = [], array[index]
            for array[index] in (value + step, value - step):
                ends.append((gradient * apply_response(image, row, (2.5, 4.0))).sum())
            array[index] = value
            assert found[index] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-6)


def test_curves_are_monotone_and_go_from_black_to_white(rng):
    image = np.broadcast_to(np.linspace(0, 1, 200), (3, 1, 200))
    result = apply_response(image, np.concatenate([np.zeros(5), rng.normal(0, 2, 12)]), (0.0, 0.0))
    assert (np.diff(result) > 0).all()
    np.testing.assert_allclose(result[..., [0, -1]], [[[0, 1]]] * 3, atol=1e-12)


@pytest.fixture(scope="module")
def finished(tiny_scene, tmp_path_factory) -> Run:
    """A finished run of twelve steps; tests do not modify it."""
    return train(tiny_scene, tmp_path_factory.mktemp("runs") / "response", *RESPONSE)


@pytest.mark.slow
def test_resumed_run_has_the_same_bits(finished, tiny_scene, tmp_path):
    run = train(tiny_scene, killed(finished.out, tmp_path / "run"), *RESPONSE, resume=True)
    assert digest(run.out) == digest(finished.out)
    assert run.modules["camera_response"].scalars == finished.modules["camera_response"].scalars


@pytest.mark.slow
def test_test_views_use_their_cameras_response(finished, tmp_path):
    measured = finished.metrics["test"]["1"]
    assert evaluate(finished.out)["test"]["1"]["psnr"] == pytest.approx(measured["psnr"], abs=1e-6)
    rows = json.loads((finished.out / camera_response.FILE).read_text())["photographs"]
    assert len(rows) == 10, "of test views too: all have one camera"
    assert len({tuple(row.values()) for row in rows.values()}) == 1
    (finished.out / camera_response.FILE).rename(tmp_path / camera_response.FILE)
    try:
        assert evaluate(finished.out)["test"]["1"]["psnr"] != pytest.approx(measured["psnr"], abs=1e-4)
        (finished.out / camera_response.FILE).write_text('{"photographs": {"a": {"center_x": 0}}}')
        with pytest.raises(DataError, match="expected 17 finite numbers for each photo"):
            evaluate(finished.out)
    finally:
        (tmp_path / camera_response.FILE).rename(finished.out / camera_response.FILE)


@pytest.mark.slow
def test_known_vignetting_is_recovered(tmp_path):
    """From photographs that move over a scene; those about an object do not tell it from darker surroundings."""
    write_dataset(tmp_path / "scene", City(size=48, train=12, test=2, lots=2), workers=1)
    for file in (tmp_path / "scene").rglob("*.png"):
        pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 97)[1::2]])
        pixels[..., :3] = np.rint(pixels[..., :3] * (1 - 0.2 * (x**2 + y**2))[..., None])
        cv2.imwrite(str(file), pixels)
    quick = ("optimize.during=[]", "optimize.modules.camera_response={rate: 0.01, weight: 0.001}")
    run = train(tmp_path / "scene", tmp_path / "run", "optimize.steps=300", *quick)
    row, q = run.modules["camera_response"].row(run.scene.views[0].name), np.array([0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(1 + row[2] * q + row[3] * q**2 + row[4] * q**3, 1 - 0.4 * q, atol=0.04)
    np.testing.assert_allclose(row[:2], 0, atol=0.05)


def rewritten(text: str) -> str:
    """The text of a module without its imports from the package."""
    return re.sub(r"^from clsplat\..+\n|^# isort: off\n", "", text, flags=re.M)


@pytest.mark.slow
@pytest.mark.usefixtures("without_plugins")
def test_plugin_copy_of_the_module_gives_the_same_bits(finished, tiny_scene, tmp_path):
    """The shipped file with its imports from clsplat.plugin, another type, and its kernel next to it is the example."""
    shipped = Path(camera_response.__file__).read_text("utf-8")
    own = rewritten(shipped).replace(
        'KERNEL, FILE = "camera_response.cl"', 'KERNEL, FILE = Path(__file__).with_suffix(".cl")'
    )
    own = own.replace(
        'Literal["camera_response"] = "camera_response"', 'Literal["lens_and_curves"] = "lens_and_curves"'
    )
    assert own == rewritten(EXAMPLE.read_text("utf-8"))
    kernel = (resource_dir("cl_kernels") / "camera_response.cl").read_text("utf-8")
    assert kernel == EXAMPLE.with_suffix(".cl").read_text("utf-8")
    clsplat.load_plugin(EXAMPLE)
    settings = [setting.replace("camera_response", "lens_and_curves") for setting in RESPONSE]
    run = train(tiny_scene, tmp_path / "run", *settings)
    assert digest(run.out) == digest(finished.out)
    assert run.modules["lens_and_curves"].scalars == finished.modules["camera_response"].scalars
    assert run.metrics == finished.metrics
