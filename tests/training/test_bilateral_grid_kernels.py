"""Bilateral grids (color_grid.cl and its tables) against float64, and in a training step."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance.checks.appearance import check_grid, check_table, random_grids
from clsplat.conformance.checks.images import make_camera, to_planes
from clsplat.conformance.scenes import random_case
from clsplat.density.statistics import SplatStats
from clsplat.losses.image import L2
from clsplat.photos.photographs import Photograph
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.training.adam import Adam, Rates
from clsplat.training.modules.bilateral_grid import BilateralGrid, GridState
from clsplat.training.modules.exposure import Affine, Exposure, ExposureState, color_gradients, transform_colors
from clsplat.training.trainer import StepTrainer
from tests.support.deviations import assert_within_bounds
from tests.support.devices import on_devices, on_one_setting, product

MORE = ((2, 1, (16, 16, 16)), (15, 4, (2, 2, 2)), (16, 16, (3, 3, 3)), (129, 65, (4, 4, 4)), (3, 257, (4, 16, 1)))
WIDTH, HEIGHT = 50, 36


@on_devices("width, height, nodes", MORE)
def test_image_and_derivatives(device, rng, width, height, nodes):
    assert_within_bounds(check_grid(device, rng, width, height, nodes))


def test_fourth_plane_is_copied(device, rng):
    assert_within_bounds(check_grid(device, rng, 33, 18, (4, 4, 4), channels=4))


@on_devices("nodes", product([(16, 16, 8)]))
def test_smoothness_updates_and_mean(device, rng, nodes):
    assert_within_bounds(check_table(device, rng, nodes))


@on_one_setting
def test_identity_only_clips_white(device, rng):
    image = rng.uniform(-0.5, 1.5, (3, 18, 33)).astype(np.float32)
    camera, workspace = make_camera(device, 33, 18), Workspace(device)
    grids = GridState(BilateralGrid(), ("a",), device)
    result = grids.transform(workspace, camera, to_planes(device, camera, image), 0)
    assert (result.get()[:, :18, :33] == np.minimum(image, 1)).all()
    assert not grids.smoothness(workspace, 0).get().any()


def test_constant_luminance_reads_the_adjacent_levels(device):
    """Beyond black and white the outer ones; only the gradient through the luminance is cut there."""
    camera, grids = make_camera(device, 20, 5), random_grids(device, np.random.default_rng(0), (2, 2, 3))
    values = np.zeros((3, 3, 4, 3, 2, 2), np.float32)
    values[1, range(3), 3] = np.array([0.1, 0.3, 0.2], np.float32)[:, None, None]  # added at each level
    grids.load({}, {"values": values.reshape(grids.shape)})
    for gray, expected in ((-0.2, 0.1), (0.0, 0.1), (0.25, 0.2), (0.5, 0.3), (0.6, 0.28)):
        planes = to_planes(device, camera, np.full((3, 5, 20), gray, np.float32))
        actual = grids.transform(Workspace(device), camera, planes, 1).get()[:, :5, :20]
        assert actual == pytest.approx(gray + expected, abs=1e-6), gray


class Case:
    """A trainer of a random scene; its photograph is the second of two, which have grids of their own."""

    def __init__(self, device, rng, nodes=(3, 2, 4), share=None) -> None:
        case, self.scalars = random_case(rng, 40, WIDTH, HEIGHT), {}
        model, pixels = case.model(device), rng.integers(0, 256, (3, HEIGHT, WIDTH)).astype(np.uint8)
        mask = None if share is None else device.upload((rng.random((1, HEIGHT, WIDTH)) < share).astype(np.uint8))
        self.photograph = Photograph(replace(case.device_camera(device), view_index=1), device.upload(pixels), mask)
        parts = Rasterizer(device), model, Adam(model.gaussians), SplatStats(model.gaussians, [])
        behind = device.upload(np.array([0.2, 0.5, 0.9], np.float32))
        self.trainer = StepTrainer(*parts, behind, (L2(),), Rates())
        self.state = GridState(BilateralGrid(grid_shape=list(nodes), weight=0.1), ("a", "b"), device)
        self.state.rate, self.trainer.modules = 0.01, [self.state]
        self.state.start_from({"b": np.array([0.3, 0.1, -0.2])})
        self.values = self.state.tables()["values"]

    def loss(self, at: int, change: float) -> float:
        """The loss with one value of the grid changed."""
        values = self.values.copy()
        values[1].reshape(-1)[at] += change
        self.state.load(self.state.scalars, {"values": values})
        return self.trainer.compare(self.photograph, 1).loss


@on_devices("share", [None, 0.7])
def test_step_gradient_is_that_of_its_losses(device, rng, share):
    """By finite differences of the loss; l2 is smooth.  Adam's first moment is a tenth of the gradient."""
    case, step = Case(device, rng, share=share), 2e-3
    places = rng.choice(case.values[1].size, 24, replace=False)
    numeric = [(case.loss(at, step) - case.loss(at, -step)) / (2 * step) for at in places]
    case.state.load(case.state.scalars, {"values": case.values})
    case.trainer.step(case.photograph, 1)
    result = case.state.tables()
    assert result["moment1"][1].ravel()[places] == pytest.approx(0.1 * np.array(numeric), rel=0.02, abs=2e-6)
    assert not result["moment1"][0].any(), "the other photo has no update"
    assert case.state.scalars["colors/b/updates"] == 1


@on_one_setting
def test_mean_over_images_and_cells_stays_at_identity(device, rng):
    case = Case(device, rng)
    for step in (1, 2, 3):
        case.trainer.step(case.photograph, step)
    values = case.state.tables()["values"].reshape(2, 12, 4, 6).astype(np.float64)
    largest = np.float32(np.abs(values).max())
    assert largest > 0.1
    # a value is rounded in 5 + 1 additions, their mean in a division, its difference from that once: half an ulp of the
    # largest at most for each value and operation; a mean without one of the 12 values is off by much more
    operations = (6 - 1) + (2 - 1) + 1 + 1
    bound = operations * float(np.spacing(largest)) / 2
    assert bound < 2e-7
    assert values.mean(axis=(0, 3)) == pytest.approx(np.zeros((12, 4)), abs=bound)


@on_one_setting
def test_single_cell_equals_the_affine_kind(device, rng):
    """Its image, and the derivatives by both."""
    values = rng.normal(0, 0.2, (2, 12, 1, 1, 1)).astype(np.float32)
    grids = GridState(BilateralGrid(grid_shape=[1, 1, 1]), ("a", "b"), device)
    grids.load({}, {"values": values})
    affine = ExposureState(Exposure(model=Affine(weight=0)), ("a", "b"))
    affine.scalars.update(zip(affine.table.keys("b"), map(float, values[1].ravel()), strict=True))
    camera, workspace = make_camera(device, 33, 18), Workspace(device)
    image, gradient = (to_planes(device, camera, rng.uniform(0, 1, (3, 18, 33))) for _ in range(2))
    result = grids.transform(workspace, camera, image, 1).get()
    expected = transform_colors(workspace, camera, image, affine.matrix(1)).get()
    assert result == pytest.approx(expected, abs=1e-6)
    passed, grad_grid = grids.differentiate(workspace, camera, image, gradient, 1)
    passed, grad_grid = passed.get(), grad_grid.get()
    through, grad_matrix = color_gradients(workspace, camera, image, affine.matrix(1), gradient)
    assert passed == pytest.approx(through.get(), abs=1e-5)
    assert grad_grid == pytest.approx(grad_matrix().ravel(), rel=1e-4, abs=1e-4)


@on_one_setting
def test_mask_hides_pixels_regardless_of_their_colors(device, rng):
    case = Case(device, rng, share=0.5)
    values = case.values.copy().reshape(2, 12, -1)
    values[1, [3, 7, 11]] = 0.2  # added to black
    case.state.load({}, {"values": values.reshape(case.state.shape)})
    image = case.trainer.compare(case.photograph, 1).comparison.image.get()[:, :HEIGHT, :WIDTH]
    hidden = ~case.photograph.unmasked_pixels()
    assert (image[:, hidden] == 0).all()
    assert (image[:, ~hidden] > 0.1).all()
