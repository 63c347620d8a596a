"""One training step from its parts, as in pipelines, benchmarks, and notebooks; also with NumPy losses."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from clsplat.conformance.checks.images import image_pair as images
from clsplat.conformance.checks.images import make_comparison
from clsplat.core.errors import ConfigError
from clsplat.density.statistics import SplatStats
from clsplat.gaussians.conversion import from_points
from clsplat.gaussians.gaussians import INTERVAL2, DeviceModel, Gaussians
from clsplat.gaussians.structs import moment_tables
from clsplat.losses.base import ImageLoss, Loss, require_loss_value
from clsplat.losses.host import HostLoss
from clsplat.losses.image import L1, L2, Dssim
from clsplat.losses.penalties import Anisotropy
from clsplat.opencl.device import Array, Device
from clsplat.opencl.discovery import DeviceInfo
from clsplat.photos.photographs import Photographs
from clsplat.photos.sampling import Sampler
from clsplat.pipeline.loading import load
from clsplat.render.filters import FilterViews, measure_intervals
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs import opening
from clsplat.scene.detect import read_scene
from clsplat.training.adam import Adam, Rates
from clsplat.training.trainer import StepTrainer
from tests.support.device_images import gradient_of, trainer_of
from tests.support.devices import NAMES, each_once, on_devices

STEPS = 8  # of smoke, before its first edit
PENALTIES = (
    "optimize.losses=[l1, {type: dssim, weight: 0.3}, {type: covariance_trace, pixels: 2.0}, {type: anisotropy, "
    "above: 2.0, weight: 0.01}]"
)
BLUR = "optimize.views.transforms=[{type: blur, sigma: 1.5}]"


@pytest.fixture
def any_device(info: DeviceInfo) -> Device:
    """A device with the schedule that it would choose."""
    return Device(info)


@pytest.mark.parametrize("overrides", [(), (PENALTIES, BLUR)], ids=["losses", "penalties and a blur"])
def test_steps_of_a_trainer_are_those_of_a_pipeline(tiny_scene, tmp_path, overrides):
    """The same tables and losses, bit for bit, without a run."""
    checked = load("smoke", [f"scene.path='{tiny_scene}'", *overrides])
    run = opening.open_run(checked, tmp_path, None)
    init, optimize = checked.stages[:2]
    init.run(run)
    losses = [view.loss for view in islice(optimize.iterate(run), STEPS)]

    scene, device = read_scene(tiny_scene), Device(run.device.info, run.device.schedule)
    first = from_points(scene.points, 0.1, degree=1)
    gaussians = Gaussians(device, first)
    if overrides:
        gaussians.add(INTERVAL2, 1)
        views = FilterViews(device, scene.split("train"))
        measure_intervals(gaussians, views, views.focal, 0.2, 1.0, gaussians[INTERVAL2])
    photographs = Photographs(device, scene.background)
    trainer = StepTrainer(
        Rasterizer(device),
        DeviceModel(gaussians, degree=0),
        Adam(gaussians),
        SplatStats(gaussians),
        photographs.background,
        optimize.losses,
        optimize.rates,
        scene.extent,
    )
    sampler = Sampler(scene.split("train"), optimize.views, seed=0)
    for step in range(1, STEPS + 1):
        sample = sampler.at(step)
        view = trainer.step(photographs.get(sample.view), step, sample.transforms)
        assert view.loss == losses[step - 1], step
    trained = run.model.gaussians
    assert gaussians.tables.keys() == trained.tables.keys()
    for name in trained.tables:
        np.testing.assert_array_equal(gaussians.get(name), trained.get(name), err_msg=name)
    assert (gaussians.get("means") != first["means"]).any()


def test_differentiating_updates_nothing(device, rng):
    trainer, photograph = trainer_of(device, rng, [L1()])
    before = {name: trainer.model.gaussians.get(name) for name in trainer.model.gaussians.tables}
    view = trainer.differentiate(photograph, 1)
    assert np.abs(view.pixel_sums.get()[:, :60]).max() > 0
    for name, table in before.items():
        np.testing.assert_array_equal(trainer.model.gaussians.get(name), table)
    assert trainer.adam.updates["means"] == 0


@on_devices(
    "missing, sort, rows, losses",
    each_once(
        [1, None],
        ["bitonic", "radix"],
        ["all", "all", "seen", "deferred"],
        [
            [L1(weight=0.8), Dssim(weight=0.2)],
            [L1(), Anisotropy(above=1.0)],
            [HostLoss(lambda *_: mean_difference(*_))],
        ],
    ),
)
def test_step_without_room_is_repeated(device, rng, missing, sort, rows, losses):
    """Room for all pairs but `missing`, or for a single pair: the same bits as with room."""
    state, pairs, results = rng.bit_generator.state, [], []
    for is_short in (False, True):
        rng.bit_generator.state = state
        trainer, photograph = trainer_of(device, rng, losses)
        trainer.rasterizer.tiler.sort, trainer.rows = sort, rows
        for step in range(1, 4):
            if is_short:
                trainer.rasterizer.tiler._capacity = pairs[step - 1] - missing if missing else 1
            frame = trainer.step(photograph, step).frame
            pairs.append(frame.lists.pairs)
            assert frame.lists.capacity >= frame.lists.pairs
        gaussians = trainer.model.gaussians
        results.append({name: gaussians.get(name) for name in gaussians.tables} | trainer.adam.updates)
    for name, expected in results[0].items():
        np.testing.assert_array_equal(results[1][name], expected, err_msg=name)
    assert trainer.adam.updates["means"] == 3


@pytest.mark.parametrize("device", [(name, setting) for name in NAMES for setting in ("simt", "simt16")], indirect=True)
def test_step_waits_after_its_last_launch(device, rng, monkeypatch):
    """Nothing is allocated, and nothing read but the number of pairs."""
    trainer, photograph = trainer_of(device, rng, [L1(weight=0.8), Dssim(weight=0.2)])
    trainer.rasterizer.tiler.sort, events = "bitonic", []
    photograph = replace(photograph, mask=None)
    for step in range(1, 4):
        trainer.step(photograph, step)
    copy, enqueue, empty = Array._copy_later, cl.enqueue_nd_range_kernel, Device.empty

    def copy_later(array, host, **part):
        wait = copy(array, host, **part)
        return lambda: [events.append("wait"), wait()][1]

    monkeypatch.setattr(Array, "_copy_later", copy_later)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", lambda *a: [events.append("launch"), enqueue(*a)][1])
    monkeypatch.setattr(Device, "empty", lambda *a: [events.append("allocation"), empty(*a)][1])
    trainer.step(photograph, 4)
    assert events == ["launch"] * (len(events) - 1) + ["wait"]
    assert len(events) > 10


def test_update_uses_the_mean_gradient_of_several_views(device, rng):
    """The first moment is 0.1 times the mean; no parameter changes before, and the next mean starts from zero."""
    trainer, photograph = trainer_of(device, rng, [L1()])
    trainer.views_per_update = 2
    gaussians, noise = trainer.model.gaussians, rng.integers(0, 256, (3, 30, 40)).astype(np.uint8)
    views = [photograph, replace(photograph, colors=device.upload(noise))]
    gradients = []
    for view in views:
        result = trainer.differentiate(view, 1)
        arrays = trainer.rasterizer.gradients(trainer.model, result.frame, result.pixel_sums)
        gradients.append(arrays["means"].get()[:, :60].T)
    before = gaussians.get("means")
    trainer.step(views[0], 1)
    np.testing.assert_array_equal(gaussians.get("means"), before)
    trainer.step(views[1], 2)
    moment = gaussians.get(moment_tables("means")[0])
    np.testing.assert_allclose(moment, 0.1 * np.mean(gradients, axis=0), rtol=1e-5, atol=1e-9)
    assert (gaussians.get("means") != before).any()
    assert trainer.adam.updates["means"] == 1
    assert not gaussians.get("gradient/views").any()


@pytest.mark.parametrize("loss", [Loss(), print])
def test_loss_of_an_unknown_kind_is_refused(any_device, rng, loss):
    trainer, photograph = trainer_of(any_device, rng, [L1(), loss])
    with pytest.raises(ConfigError, match=r"^the loss \w+: expected a subclass of ImageLoss or of Penalty$"):
        trainer.step(photograph, 1)


@pytest.mark.parametrize(("step", "expected"), [(1, 0.3), (9, 0.3), (10, 0.6)])
def test_rates_and_weights_use_the_global_step(any_device, rng, step, expected):
    """The first update of Adam moves by the rate, and means by the rate times the extent."""
    weight = {"points": [[0, 1.0], [10, 0.25]], "between": "steps"}
    trainer, photograph = trainer_of(any_device, rng, [L1(weight=weight)])
    trainer.extent = 3.0
    trainer.rates = Rates(means={"points": [[0, 0.1], [10, 0.2]], "between": "steps"}, quats=0.0)
    before = {name: trainer.model.gaussians.get(name) for name in ("means", "quats")}
    full = L1().add(trainer.differentiate(photograph, 1).comparison).value()
    view = trainer.step(photograph, step)
    moved = np.abs(trainer.model.gaussians.get("means") - before["means"])
    assert (moved > 0).any(axis=1).sum() > 20
    np.testing.assert_allclose(moved[moved > 0], expected, rtol=1e-3)
    np.testing.assert_array_equal(trainer.model.gaussians.get("quats"), before["quats"])
    assert view.loss == pytest.approx(full * (0.25 if step >= 10 else 1.0), rel=1e-6)


def test_stale_parameters_do_not_change(any_device, rng):
    trainer, photograph = trainer_of(any_device, rng, [L1(), Anisotropy(above=1.0)])
    before = {name: trainer.model.gaussians.get(name) for name in ("logit_opacity", "log_scales")}
    view = trainer.step(photograph, 1, frozen=["logit_opacity"])
    assert [loss.name for loss in view.losses] == ["l1", "anisotropy"]
    np.testing.assert_array_equal(trainer.model.gaussians.get("logit_opacity"), before["logit_opacity"])
    assert (trainer.model.gaussians.get("log_scales") != before["log_scales"]).any()


@pytest.mark.parametrize("losses", [[L1()], [L1(), Anisotropy(above=1.0)]], ids=["losses", "a penalty"])
def test_invisible_rows_do_not_change(device, rng, losses):
    """Their moments too; penalties give gradients to all rows, and change no other ones than losses do."""
    trainer, photograph = trainer_of(device, rng, losses)
    gaussians = trainer.model.gaussians
    means = gaussians.get("means")
    means[::4] += [0, 0, -50]
    gaussians.set("means", means)
    trainer.step(photograph, 1)  # moments for all that a penalty gives some
    trainer.rows = "seen"
    before = {name: gaussians.get(name) for name in gaussians.tables}
    visible = trainer.step(photograph, 2).frame.depth_key.get()[:60] != 0xFFFFFFFF
    assert 20 < visible.sum() <= 45
    for name in ("means", "log_scales", "adam/log_scales/moment1", "adam/log_scales/moment2"):
        changed = (gaussians.get(name) != before[name]).any(axis=1)
        assert not changed[~visible].any(), name
        assert changed[visible].sum() > 15, name


def test_masked_pixels_have_no_gradient(any_device, rng):
    trainer, photograph = trainer_of(any_device, rng, [Dssim(), L2()])
    comparison = trainer.differentiate(photograph, 1).comparison
    for planes in (comparison.gradient, comparison.image, comparison.photograph):
        assert (planes.get()[:, :30, :13] == 0).all()
        assert (planes.get()[:, :30, 13:40] != 0).mean() > 0.3
    assert comparison.unmasked_size == 3 * 30 * 27


# ---- losses in NumPy


def mean_difference(image: np.ndarray, photograph: np.ndarray) -> tuple[float, np.ndarray]:
    """L1 as a notebook would write it."""
    difference = image - photograph
    return float(np.abs(difference).mean()), np.sign(difference) / difference.size


@pytest.mark.parametrize(("width", "height"), [(1, 1), (16, 16), (17, 33), (65, 12)])
def test_numpy_loss_matches_the_device_loss(any_device, rng, width, height):
    x, y = images(rng, width, height)
    weight = [[0, 0.5], [10, 1.5]]
    results = []
    for loss in (L1(weight=weight), HostLoss(mean_difference, weight)):
        comparison = make_comparison(any_device, x, y)
        comparison.step = 5
        value = loss.add(comparison)
        results.append((value.value(), gradient_of(comparison)))
    (l1, gradient), (host, host_gradient) = results
    assert host == pytest.approx(l1, rel=1e-6)
    np.testing.assert_allclose(host_gradient, gradient, rtol=1e-6)
    assert value.name == "mean_difference"


@pytest.mark.parametrize("place", [0, 1, 2])
def test_numpy_loss_adds_to_others_in_any_order(any_device, rng, place):
    x, y = images(rng, 40, 30)
    results = []
    for loss in (L1(weight=0.7), HostLoss(mean_difference, 0.7)):
        losses: list[ImageLoss] = [Dssim(weight=0.2), L2(weight=3.0)]
        losses.insert(place, loss)
        comparison = make_comparison(any_device, x, y)
        values = [item.add(comparison).value() for item in losses]
        results.append((sum(values), gradient_of(comparison)))
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-6)
    np.testing.assert_allclose(results[1][1], results[0][1], atol=1e-6 * np.abs(results[0][1]).max())


def test_numpy_loss_trains_like_the_device_loss(any_device, rng):
    """With a mask: what it leaves out is black in both images that the function is given."""
    state, tables = rng.bit_generator.state, []
    seen = []

    def watched(image: np.ndarray, photograph: np.ndarray) -> tuple[float, np.ndarray]:
        seen.append((image.shape, image[:, :13].any(), photograph[:, :13].any(), photograph[:, 13:].all(axis=2).mean()))
        return mean_difference(image, photograph)

    for loss in (L1(), HostLoss(watched)):
        rng.bit_generator.state = state
        trainer, photograph = trainer_of(any_device, rng, [loss])
        for step in range(1, 4):
            trainer.step(photograph, step)
        tables.append(trainer.model.gaussians.get("means"))
    np.testing.assert_allclose(tables[1], tables[0], atol=1e-6)
    assert [item[:3] for item in seen] == [((30, 40, 3), False, False)] * 3
    assert seen[0][3] > 0.9


def test_derivative_of_another_shape_is_refused(any_device, rng):
    x, y = images(rng, 5, 4)
    loss = HostLoss(lambda image, photograph: (0.0, np.zeros((3, 4, 5), np.float32)))
    with pytest.raises(ValueError, match=r"gradient of shape \(3, 4, 5\); expected that of the image, \(4, 5, 3\)"):
        loss.add(make_comparison(any_device, x, y))


@pytest.mark.parametrize("found", [None, 0.0, (0.0,), ("much", np.zeros((4, 5, 3))), (0.0, "much"), (0.0, None, 1)])
def test_loss_with_an_invalid_return_value_is_refused(any_device, rng, found):
    def odd(image, photograph):
        return found

    with pytest.raises(ValueError, match=r"^the loss '?(odd)?.* returned .*; expected ") as caught:
        HostLoss(odd).add(make_comparison(any_device, *images(rng, 5, 4)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("weight", "reason"),
    [
        ("heavy", "expected a number, points"),
        (float("nan"), "expected a number, points"),
        (-1.0, "expected values at least 0"),
        ([[0, 1.0], [9, -1.0]], "expected values at least 0"),
    ],
)
def test_invalid_weight_is_refused(weight, reason):
    with pytest.raises(ConfigError, match=rf"^the weight of the loss is .*; {reason}") as caught:
        HostLoss(mean_difference, weight)
    assert "\n" not in str(caught.value)
    assert HostLoss(mean_difference, np.float32(0.5)).weight == 0.5


def test_losses_of_a_run_are_added_to_those_of_its_pipeline(tiny_scene: Path, tmp_path: Path):
    checked = load("smoke", [f"scene.path='{tiny_scene}'", "optimize.losses=[l1]"])
    run = opening.open_run(checked, tmp_path, None)
    run.losses.append(HostLoss(mean_difference, 0.5))
    checked.stages[0].run(run)
    view = next(checked.stages[1].iterate(run))
    assert [loss.name for loss in view.losses] == ["l1", "mean_difference"]
    assert view.losses[1].value() == pytest.approx(0.5 * view.losses[0].value(), rel=1e-6)


def test_loss_that_returns_none_is_named():
    class Silent(ImageLoss):
        def add(self, comparison):
            pass

    with pytest.raises(ConfigError, match="the loss Silent: expected a LossValue from 'add', got NoneType"):
        require_loss_value(Silent(), Silent().add(None))


@pytest.mark.parametrize("more", [[], [Anisotropy(above=1.0)]], ids=["losses", "a penalty"])
def test_later_steps_allocate_nothing_on_the_device(device, rng, monkeypatch, more):
    trainer, photograph = trainer_of(device, rng, [L1(weight=0.8), Dssim(weight=0.2), *more])
    tiny = dict.fromkeys(("means", "log_scales", "quats", "logit_opacity", "sh_base", "sh_rest"), 1e-30)
    trainer.rates = Rates(**tiny)  # so that the number of pairs stays
    for step in (1, 2):
        trainer.step(photograph, step)
    monkeypatch.setattr(Device, "empty", lambda self, *shape: pytest.fail(f"{shape} were allocated"))
    trainer.step(photograph, 3)
