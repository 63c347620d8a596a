"""Rendering in torch, if it is installed."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.api.renderer import Renderer
from clsplat.conformance.scenes import add_world_filter, random_case
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.motion import static_motion
from tests.support.models import model_of

torch = pytest.importorskip("torch")
import clsplat.torch  # noqa: E402

SIZE = 33, 21  # px


def parameters_of(model) -> dict:
    return {name: torch.tensor(getattr(model, name), requires_grad=True) for name in PARAMETERS}


def test_image_and_alpha_match_the_renderer(device, rng):
    case = random_case(rng, 30, *SIZE)
    picture = Renderer(model_of(case), device).render(case.view, 0.25)
    image, alpha = clsplat.torch.render(
        Renderer(model_of(case)[:0], device), case.view, parameters_of(model_of(case)), background=0.25
    )
    np.testing.assert_array_equal(image.detach().numpy(), picture.image)
    np.testing.assert_array_equal(alpha.detach().numpy(), picture.alpha)


def test_gradients_agree_with_finite_differences(smooth, rng):
    case = random_case(rng, 6, *SIZE)
    renderer, parameters = Renderer(model_of(case), smooth), parameters_of(model_of(case))
    grad_image = torch.tensor(rng.normal(size=(SIZE[1], SIZE[0], 3)))
    grad_alpha = torch.tensor(rng.normal(size=(SIZE[1], SIZE[0])))

    def loss(changed: dict) -> "torch.Tensor":
        image, alpha = clsplat.torch.render(renderer, case.view, changed, 0.3)
        return (image.double() * grad_image).sum() + (alpha.double() * grad_alpha).sum()

    loss(parameters).backward()
    for name, table in parameters.items():
        direction = torch.tensor(rng.normal(size=tuple(table.shape)), dtype=torch.float32)
        with torch.no_grad():
            up, down = (loss({**parameters, name: table + sign * 2e-3 * direction}) for sign in (1, -1))
        expected = float(up - down) / 4e-3
        got = float((table.grad * direction).sum())
        scale = float(table.grad.norm() * direction.norm())
        assert got == pytest.approx(expected, abs=2e-3 * scale + 1e-3), name


def test_backward_may_be_called_twice_and_adds_up(device, rng):
    case = random_case(rng, 20, *SIZE)
    renderer, parameters = Renderer(model_of(case), device), parameters_of(model_of(case))
    image, alpha = clsplat.torch.render(renderer, case.view, parameters)
    other, _ = clsplat.torch.render(renderer, case.view, parameters_of(model_of(case)[:5]))
    loss = image.square().sum() + alpha.sum()
    loss.backward(retain_graph=True)
    once = {name: table.grad.clone() for name, table in parameters.items()}
    other.sum().backward()
    loss.backward()
    for name, table in parameters.items():
        np.testing.assert_array_equal(table.grad.numpy(), 2 * once[name].numpy())


def test_optimizer_lowers_the_loss(device, rng):
    case = random_case(rng, 30, *SIZE)
    wanted = torch.tensor(Renderer(model_of(random_case(rng, 30, *SIZE)), device).render(case.view).image)
    renderer, parameters = Renderer(model_of(case), device), parameters_of(model_of(case))
    optimiser = torch.optim.Adam(parameters.values(), lr=0.02)
    losses = []
    for _ in range(25):
        optimiser.zero_grad()
        image, _ = clsplat.torch.render(renderer, case.view, parameters)
        loss = (image - wanted).square().mean()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]


def test_table_changed_in_place_before_backward_is_refused(device, rng):
    case = random_case(rng, 5, *SIZE)
    parameters = parameters_of(model_of(case))
    image, _ = clsplat.torch.render(Renderer(model_of(case), device), case.view, parameters)
    with torch.no_grad():
        parameters["means"] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


def test_second_derivative_is_refused(device, rng):
    case = random_case(rng, 5, *SIZE)
    parameters = parameters_of(model_of(case))
    image, _ = clsplat.torch.render(Renderer(model_of(case), device), case.view, parameters)
    (first,) = torch.autograd.grad(image.square().sum(), [parameters["means"]], create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        first.square().sum().backward()


def test_count_that_differs_from_the_world_filter_is_refused(device, rng):
    case = add_world_filter(random_case(rng, 5, *SIZE), rng)
    renderer = Renderer(model_of(case), device)
    clsplat.torch.render(renderer, case.view, parameters_of(model_of(case)))
    with pytest.raises(ValueError, match="has a world filter of 5 Gaussians, the parameters have 3; expected as many"):
        clsplat.torch.render(renderer, case.view, parameters_of(model_of(case)[:3]))


def test_moving_model_is_refused_but_not_its_snapshot(device, rng):
    case = random_case(rng, 5, *SIZE)
    model = replace(model_of(case), motion=static_motion(5, 5))
    with pytest.raises(
        ValueError, match=r"the renderer's model moves, .* give the renderer one moment, `model\.at\(time"
    ):
        clsplat.torch.render(Renderer(model, device), case.view, parameters_of(model))
    clsplat.torch.render(Renderer(model.at(0.5), device), case.view, parameters_of(model.at(0.5)))


def test_missing_table_and_a_wrong_shape_are_refused(device, rng):
    case = random_case(rng, 5, *SIZE)
    renderer, parameters = Renderer(model_of(case), device), parameters_of(model_of(case))
    with pytest.raises(ValueError, match=r"quats has shape \(5, 3\); expected \(5, 4\)"):
        clsplat.torch.render(renderer, case.view, {**parameters, "quats": parameters["means"]})
    del parameters["quats"]
    with pytest.raises(KeyError, match="quats"):
        clsplat.torch.render(renderer, case.view, parameters)
