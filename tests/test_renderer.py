"""Pictures and their gradients, NumPy in and out."""

import numpy as np
import pytest

from clsplat.api.renderer import Renderer
from clsplat.gaussians.model import Model, Rendering
from tests.scenes import random_case, with_world_filter

PARAMETERS = ("means", "quats", "log_scales", "logit_opacity", "sh_base", "sh_rest")
SIZE = 33, 21  # px: neither side is whole tiles


def model_of(case) -> Model:
    return Model(**case.parameters, rendering=Rendering(screen_variance=case.variance, compensate=case.compensate))


@pytest.fixture
def smooth(device):
    """The device without thresholds in blending, where derivatives have no jumps."""
    from clsplat.opencl.device import Device

    opened = Device(device.info, device.schedule)
    opened.tuning.update(device.tuning, ALPHA_MIN="1e-30f", TRANSMITTANCE_MIN="1e-30f")
    return opened


def test_alpha_is_what_the_background_does_not_show_through(device, rng):
    case = random_case(rng, 40, *SIZE)
    renderer = Renderer(model_of(case), device)
    black, white = (renderer.render(case.view, background) for background in (0.0, 1.0))
    assert black.image.shape == (SIZE[1], SIZE[0], 3)
    assert black.alpha.shape == (SIZE[1], SIZE[0])
    np.testing.assert_allclose(white.image - black.image, 1 - black.alpha[..., None].repeat(3, 2), atol=2e-6)


def test_depth_is_that_of_a_single_gaussian(device, rng):
    case = random_case(rng, 1, *SIZE)
    picture = Renderer(model_of(case), device).render(case.view, depth=True)
    pose = case.view.world_to_camera
    depth = float(pose[2, :3] @ case.parameters["means"][0] + pose[2, 3])
    assert (picture.alpha > 0).any()
    np.testing.assert_allclose(picture.depth[picture.alpha > 0], depth, rtol=1e-5)
    np.testing.assert_array_equal(picture.depth[picture.alpha == 0], 0)


def test_depth_changes_neither_image_nor_alpha(device, rng):
    case = with_world_filter(random_case(rng, 30, *SIZE, compensate=1.0), rng)
    renderer = Renderer(model_of(case), device)
    without, with_depth = renderer.render(case.view), renderer.render(case.view, depth=True)
    np.testing.assert_array_equal(without.image, with_depth.image)
    np.testing.assert_array_equal(without.alpha, with_depth.alpha)


@pytest.mark.parametrize("background", [0.0, (0.2, 0.5, 0.9)])
def test_gradients_agree_with_finite_differences(smooth, rng, background):
    case = random_case(rng, 6, *SIZE)
    model = model_of(case)
    by_image = rng.normal(size=(SIZE[1], SIZE[0], 3)).astype(np.float32)
    by_alpha = rng.normal(size=(SIZE[1], SIZE[0])).astype(np.float32)
    renderer = Renderer(model, smooth)
    gradients = renderer.render(case.view, background).backward(image=by_image, alpha=by_alpha)

    def loss(changed: Model) -> float:
        renderer.update(changed)
        picture = renderer.render(case.view, background)
        return float((picture.image * by_image.astype(np.float64)).sum() + (picture.alpha * by_alpha).sum())

    for name in PARAMETERS:
        table = getattr(model, name)
        direction = rng.normal(size=table.shape).astype(np.float32)
        step = np.float32(2e-3)
        tables = model.tables()
        up, down = (
            loss(Model(**{**tables, name: table + sign * step * direction}, rendering=model.rendering))
            for sign in (1, -1)
        )
        expected = (up - down) / (2 * step)
        got = float((getattr(gradients, name) * direction).sum())
        scale = float(np.linalg.norm(getattr(gradients, name)) * np.linalg.norm(direction))
        assert got == pytest.approx(expected, abs=2e-3 * scale + 1e-3), name


def test_gradients_by_image_and_by_alpha_add_up(device, rng):
    case = random_case(rng, 20, *SIZE)
    picture = Renderer(model_of(case), device).render(case.view, 0.3)
    by_image, by_alpha = rng.normal(size=picture.image.shape), rng.normal(size=picture.alpha.shape)
    both = picture.backward(image=by_image, alpha=by_alpha)
    for name in PARAMETERS:
        parts = sum(getattr(picture.backward(**{k: v}), name) for k, v in (("image", by_image), ("alpha", by_alpha)))
        np.testing.assert_allclose(getattr(both, name), parts, atol=1e-4 * max(1e-6, np.abs(parts).max()))


def test_no_gaussian_gives_the_background(device, rng):
    case = random_case(rng, 3, *SIZE)
    picture = Renderer(model_of(case)[:0], device).render(case.view, 0.25, depth=True)
    assert (picture.image == np.float32(0.25)).all()
    assert not picture.alpha.any()
    assert picture.backward(image=np.ones_like(picture.image)).means.shape == (0, 3)


def test_derivatives_of_another_shape_are_refused(device, rng):
    case = random_case(rng, 3, *SIZE)
    picture = Renderer(model_of(case), device).render(case.view)
    with pytest.raises(ValueError, match=r"derivative by alpha has shape \(3, 3\); expected"):
        picture.backward(alpha=np.zeros((3, 3)))


def test_pictures_show_themselves(device, rng):
    case = random_case(rng, 3, *SIZE)
    assert Renderer(model_of(case), device).render(case.view)._repr_png_().startswith(b"\x89PNG")
