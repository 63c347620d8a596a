"""Renders and their gradients, in NumPy."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from clsplat.api import renderer as devices
from clsplat.api.renderer import Renderer
from clsplat.conformance.scenes import add_world_filter, random_case
from clsplat.core.errors import NumericError
from clsplat.gaussians.model import Model, Rendering
from clsplat.opencl import device as program
from tests.support.devices import on_one_setting

PARAMETERS = ("means", "quats", "log_scales", "logit_opacity", "sh_base", "sh_rest")
SIZE = 33, 21  # px: neither side is whole tiles


def model_of(case) -> Model:
    return Model(**case.parameters, rendering=Rendering(screen_variance=case.variance, compensate=case.compensate))


def test_alpha_is_one_minus_background_weight(device, rng):
    case = random_case(rng, 40, *SIZE)
    renderer = Renderer(model_of(case), device)
    black, white = (renderer.render(case.view, background) for background in (0.0, 1.0))
    assert black.image.shape == (SIZE[1], SIZE[0], 3)
    assert black.alpha.shape == (SIZE[1], SIZE[0])
    np.testing.assert_allclose(white.image - black.image, 1 - black.alpha[..., None].repeat(3, 2), atol=2e-6)


def test_depth_of_a_single_gaussian_is_its_own(device, rng):
    case = random_case(rng, 1, *SIZE)
    picture = Renderer(model_of(case), device).render(case.view, depth=True)
    pose = case.view.world_to_camera
    depth = float(pose[2, :3] @ case.parameters["means"][0] + pose[2, 3])
    assert (picture.alpha > 0).any()
    np.testing.assert_allclose(picture.depth[picture.alpha > 0], depth, rtol=1e-5)
    np.testing.assert_array_equal(picture.depth[picture.alpha == 0], 0)
    np.testing.assert_allclose(picture.median_depth[picture.alpha > 0.51], depth, rtol=1e-5)
    np.testing.assert_array_equal(picture.median_depth[picture.alpha < 0.49], 0)


@on_one_setting
def test_depth_changes_neither_image_nor_alpha(device, rng):
    case = add_world_filter(random_case(rng, 30, *SIZE, compensate=1.0), rng)
    renderer = Renderer(model_of(case), device)
    without, with_depth = renderer.render(case.view), renderer.render(case.view, depth=True)
    np.testing.assert_array_equal(without.image, with_depth.image)
    np.testing.assert_array_equal(without.alpha, with_depth.alpha)


@on_one_setting
@pytest.mark.parametrize(("array", "values"), [("image", np.nan), ("image", -np.inf), ("transmittance", np.nan)])
def test_nonfinite_render_is_an_error(device, rng, monkeypatch, array, values):
    """From a faulty device or model; one pixel is enough, as in `clsplat render`."""
    case = random_case(rng, 20, *SIZE)
    renderer = Renderer(model_of(case), device)
    forward = renderer.rasterizer.forward

    def broken(*arguments):
        frame = forward(*arguments)
        numbers = getattr(frame, array).get()
        numbers[..., 3, 5] = values
        getattr(frame, array).set(numbers)
        return frame

    renderer.render(case.view)
    monkeypatch.setattr(renderer.rasterizer, "forward", broken)
    with pytest.raises(NumericError, match=f"^view '{case.view.name}': the render is not finite"):
        renderer.render(case.view)


def test_gradients_agree_with_finite_differences(smooth, rng):
    background = (0.2, 0.5, 0.9)
    case = random_case(rng, 6, *SIZE)
    model = model_of(case)
    grad_image = rng.normal(size=(SIZE[1], SIZE[0], 3)).astype(np.float32)
    grad_alpha = rng.normal(size=(SIZE[1], SIZE[0])).astype(np.float32)
    renderer = Renderer(model, smooth)
    gradients = renderer.render(case.view, background).backward(image=grad_image, alpha=grad_alpha)

    def loss(changed: Model) -> float:
        renderer.update(changed)
        picture = renderer.render(case.view, background)
        return float((picture.image * grad_image.astype(np.float64)).sum() + (picture.alpha * grad_alpha).sum())

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


@on_one_setting
def test_gradients_by_image_and_by_alpha_add_up(device, rng):
    case = random_case(rng, 20, *SIZE)
    picture = Renderer(model_of(case), device).render(case.view, 0.3)
    grad_image, grad_alpha = rng.normal(size=picture.image.shape), rng.normal(size=picture.alpha.shape)
    both = picture.backward(image=grad_image, alpha=grad_alpha)
    for name in PARAMETERS:
        parts = sum(
            getattr(picture.backward(**{k: v}), name) for k, v in (("image", grad_image), ("alpha", grad_alpha))
        )
        np.testing.assert_allclose(getattr(both, name), parts, atol=1e-4 * max(1e-6, np.abs(parts).max()))


@on_one_setting
def test_batch_has_the_renders_of_its_views(device, rng):
    case = random_case(rng, 20, *SIZE)
    views = [case.view, replace(case.view, camera=case.view.camera.zoomed(2.0))]
    renderer = Renderer(model_of(case), device)
    for result, view in zip(renderer.render_batch(views, 0.3), views, strict=True):
        np.testing.assert_array_equal(result.image, renderer.render(view, 0.3).image)


@on_one_setting
def test_empty_model_renders_the_background(device, rng):
    case = random_case(rng, 3, *SIZE)
    picture = Renderer(model_of(case)[:0], device).render(case.view, 0.25, depth=True)
    assert (picture.image == np.float32(0.25)).all()
    assert not picture.alpha.any()
    assert picture.backward(image=np.ones_like(picture.image)).means.shape == (0, 3)


@on_one_setting
def test_derivatives_of_another_shape_are_refused(device, rng):
    case = random_case(rng, 3, *SIZE)
    picture = Renderer(model_of(case), device).render(case.view)
    with pytest.raises(ValueError, match=r"gradient of alpha: expected the shape"):
        picture.backward(alpha=np.zeros((3, 3)))


@on_one_setting
def test_render_has_a_rich_display(device, rng):
    case = random_case(rng, 3, *SIZE)
    assert Renderer(model_of(case), device).render(case.view)._repr_png_().startswith(b"\x89PNG")


@on_one_setting
def test_renderers_on_one_device_are_independent(device, rng):
    cases = [random_case(rng, count, *size) for count, size in ((40, SIZE), (90, (64, 48)))]
    renderers = [Renderer(model_of(case), device) for case in cases]
    grad_image = [np.ones((case.size[1], case.size[0], 3)) for case in cases]
    alone = []
    for renderer, case, planes in zip(renderers, cases, grad_image, strict=True):
        picture = renderer.render(case.view)
        alone.append((picture.image, picture.backward(image=planes)))
    pictures = [renderer.render(case.view) for renderer, case in zip(renderers, cases, strict=True)]
    for (image, expected), picture, planes in zip(alone, pictures, grad_image, strict=True):
        np.testing.assert_array_equal(image, picture.image)
        gradients = picture.backward(image=planes)
        for name in PARAMETERS:
            np.testing.assert_array_equal(getattr(expected, name), getattr(gradients, name))


@on_one_setting
def test_threads_may_share_a_renderer(device, rng):
    case = random_case(rng, 60, *SIZE)
    renderer = Renderer(model_of(case), device)
    turns = [case.view.shifted(np.array([i / 50, 0, 0])) for i in range(8)]
    planes = np.ones((SIZE[1], SIZE[0], 3))

    def result(view):
        picture = renderer.render(view)
        return picture.image, picture.backward(image=planes).means

    expected = [result(view) for view in turns]
    with ThreadPoolExecutor(4) as pool:
        for ours, theirs in zip(pool.map(result, turns), expected, strict=True):
            for one, other in zip(ours, theirs, strict=True):
                np.testing.assert_array_equal(one, other)


@on_one_setting
def test_threads_sharing_a_device_keep_their_kernel_arguments(device, monkeypatch):
    enqueue = program.cl.enqueue_nd_range_kernel

    def delayed(*arguments):
        time.sleep(0.002)  # here another thread would set its arguments
        return enqueue(*arguments)

    def filled(value: int) -> bool:
        arrays = [device.empty(64) for _ in range(10)]
        start.wait()
        for array in arrays:
            array.fill(value)
        return all((array.get() == value).all() for array in arrays)

    device.zeros(1)  # builds the kernel
    monkeypatch.setattr(program.cl, "enqueue_nd_range_kernel", delayed)
    start = threading.Barrier(4)
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(filled, range(1, 5)))


@on_one_setting
def test_threads_build_a_program_and_open_the_device_once(device, monkeypatch):
    built, opened = [], []

    def slowly(seen: list):
        def make(*arguments, **named):
            time.sleep(0.02)
            seen.append(object())
            return seen[-1]

        return make

    monkeypatch.setattr(program, "Program", slowly(built))
    monkeypatch.setattr(device, "_programs", {})
    monkeypatch.setattr(devices, "Device", slowly(opened))
    devices._open_default.cache_clear()
    with ThreadPoolExecutor(4) as pool:
        programs = list(pool.map(lambda _: device.program("fill.cl"), range(4)))
        actual = list(pool.map(lambda _: devices.default_device(), range(4)))
    devices._open_default.cache_clear()
    assert (len(built), len(set(programs))) == (1, 1)
    assert (len(opened), len(set(actual))) == (1, 1)


@on_one_setting
def test_gradients_belong_to_the_rendered_model(device, rng):
    case = random_case(rng, 20, *SIZE)
    model, plain = model_of(case), model_of(case)
    plain = Model(**{**plain.tables(), "sh_rest": plain.sh_rest[:, :9]}, rendering=plain.rendering)
    renderer, grad_image = Renderer(model, device), np.ones((SIZE[1], SIZE[0], 3))
    picture = renderer.render(case.view)
    expected = picture.backward(image=grad_image)
    renderer.update(plain)  # of another degree
    assert renderer.render(case.view).backward(image=grad_image).sh_rest.shape == (20, 9)
    again = picture.backward(image=grad_image)
    assert renderer.model is plain
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(expected, name), getattr(again, name))


@on_one_setting
def test_in_place_changes_do_not_affect_gradients(device, rng):
    case = random_case(rng, 20, *SIZE)
    model, grad_image = model_of(case), np.ones((SIZE[1], SIZE[0], 3))
    renderer = Renderer(model, device)
    picture = renderer.render(case.view)
    expected = picture.backward(image=grad_image)
    model.means[:] += 0.3
    renderer.update(model)
    again = picture.backward(image=grad_image)
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(expected, name), getattr(again, name))
    assert (renderer.render(case.view).backward(image=grad_image).means != expected.means).any()


@on_one_setting
def test_render_arrays_are_independent_copies(device, rng):
    case = random_case(rng, 20, *SIZE)
    renderer = Renderer(model_of(case), device)
    picture = renderer.render(case.view, depth=True)
    kept = picture.image.copy()
    renderer.render(case.view, 1.0).image[:] = 7
    np.testing.assert_array_equal(picture.image, kept)
    assert repr(picture) == "RenderResult(33 x 21 px of 'view')"
    assert repr(picture.backward()) == "Gradients(of 20 Gaussians)"


@on_one_setting
def test_impossible_backgrounds_and_cameras_are_refused(device, rng):
    case = random_case(rng, 3, *SIZE)
    renderer = Renderer(model_of(case), device)
    with pytest.raises(ValueError, match="expected one number or three in"):
        renderer.render(case.view, (0, 1))
    with pytest.raises(ValueError, match="expected a positive size, positive focal lengths"):
        renderer.render(replace(case.view, camera=replace(case.view.camera, fx=-1.0)))


@on_one_setting
def test_background_defaults_to_the_models(device, rng):
    case = random_case(rng, 3, *SIZE)
    model = model_of(case)
    white = replace(model, rendering=replace(model.rendering, background="white"))
    images = [Renderer(one, device).render(case.view, color).image for one, color in ((white, None), (model, 1.0))]
    np.testing.assert_array_equal(*images)
