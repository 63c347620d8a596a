"""Images and gradients of the device against an oracle that shares no code with the project's reference."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat import Camera, Model, Renderer, Rendering, View
from tests.conformance.oracle import BACKGROUND, FILTERS, KINDS, TABLES, blend, errors, make_scene, project


@pytest.mark.parametrize(("number", "kind"), enumerate(KINDS))
def test_image_and_gradients_equal_the_oracle(device, number, kind):
    screen_filter = list(FILTERS)[number % len(FILTERS)]
    result = errors(device, kind, screen_filter, seed=2)
    image, median, worst = (1e-4, 1e-4, 1e-3) if "needles" in kind else (5e-6, 5e-6, 5e-5)
    assert result["image"][1] < image
    assert result["alpha"][1] < image
    assert result["depth"][1] < image
    for name in TABLES:
        assert result[name][0] < median, name
        assert result[name][1] < worst, name


STEP = 1e-6  # of central differences of the oracle in float64; too short for a pixel to pass a threshold


@pytest.mark.parametrize("kind", ["compact", "off-center", "wide"])
def test_gradients_by_camera_and_depth_agree_with_the_oracle(device, kind):
    tables, camera = make_scene(KINDS[kind], "ewa", seed=3)
    rng = np.random.default_rng(3)
    weights = rng.normal(size=(5, camera.height, camera.width))  # of the image's channels, alpha, and depth
    by_image, by_alpha, by_depth = weights[:3].transpose(1, 2, 0), weights[3], weights[4]

    def loss(tables, camera):
        picture = blend(project(tables, camera, "ewa"), camera, by_image, by_alpha)
        return sum(
            (a * b).sum() for a, b in ((picture.image, by_image), (picture.alpha, by_alpha), (picture.depth, by_depth))
        )

    def derivative(change):
        return (loss(*change(STEP)) - loss(*change(-STEP))) / (2 * STEP)

    def turned(axis, step):
        return replace(camera, pose=Rotation.from_rotvec(step * np.eye(3)[axis]).as_matrix() @ camera.pose)

    def shifted(axis, step):
        return replace(camera, pose=camera.pose + step * np.outer(np.eye(3)[axis], [0, 0, 0, 1]))

    def zoomed(step):
        return replace(camera, fx=camera.fx * np.exp(step), fy=camera.fy * np.exp(step))

    lens = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    variance, _ = FILTERS["ewa"]
    model = Model(**tables, rendering=Rendering(near=camera.near, screen_variance=variance, compensate=1.0))
    result = Renderer(model, device).render(View("oracle", lens, camera.pose), tuple(BACKGROUND))
    actual = result.backward(image=by_image, alpha=by_alpha, depth=by_depth)
    rotation = [derivative(lambda step, k=k: (tables, turned(k, step))) for k in range(3)]
    translation = [derivative(lambda step, k=k: (tables, shifted(k, step))) for k in range(3)]
    np.testing.assert_allclose(actual.rotation, rotation, rtol=2e-5, atol=2e-5 * np.abs(rotation).max())
    np.testing.assert_allclose(actual.translation, translation, rtol=2e-5, atol=2e-5 * np.abs(translation).max())
    assert actual.log_focal == pytest.approx(derivative(lambda step: (tables, zoomed(step))), rel=1e-4)
    for name, table in tables.items():
        direction = rng.normal(size=table.shape)
        gradient = getattr(actual, name)
        expected = derivative(lambda step, n=name, d=direction: ({**tables, n: tables[n] + step * d}, camera))
        scale = np.linalg.norm(gradient) * np.linalg.norm(direction)
        assert (gradient * direction).sum() == pytest.approx(expected, abs=1e-5 * scale), name


def test_gradient_of_depth_needs_a_model_at_rest(device):
    tables, camera = make_scene(KINDS["compact"], "mip", seed=3)
    model = Model(**tables, motion=np.zeros((len(tables["means"]), 5)), rendering=Rendering(near=camera.near))
    lens = Camera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    result = Renderer(model, device).render(View("oracle", lens, camera.pose))
    with pytest.raises(ValueError, match="static model"):
        result.backward(depth=np.ones((camera.height, camera.width)))
