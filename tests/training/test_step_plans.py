"""Replayed launches have the arguments that the checked path would give them."""

import numpy as np
import pytest

from clsplat.losses.image import L1, Dssim
from tests.support.device_images import trainer_of
from tests.support.devices import on_devices
from tests.support.plans import check_replays
from tests.support.runs import train

STEPS = "optimize.steps=26", "init.count=300", "densify.every=8", "densify.start=3", "reset_opacity.every=10"
MODULES = (
    "optimize.modules=[{type: dropout, probability: 0.2}, {type: camera_optimizer, start: 4}, "
    "{type: random_background}, {type: exposure, model: affine}]"
)
PENALTIES = (
    "optimize.losses=[{type: l1, weight: [[1, 0.8], [20, 0.7]]}, {type: dssim, weight: 0.2}, "
    "{type: l2, weight: 0.1}, {type: anisotropy, above: 2.0, weight: 0.01}]"
)
CASES = {
    "edits": (),
    "bands": ("rasterizer.pair_budget=1", "rasterizer.launch_tiles=3", "init.count=4000"),
    "modules": (MODULES, "optimize.update=deferred"),
    "penalties": (PENALTIES, "rasterizer.harmonics=host", "rasterizer.sort=bitonic"),
}


@pytest.mark.parametrize("overrides", CASES.values(), ids=CASES.keys())
def test_replays_are_the_launches_of_the_checked_path(tiny_scene, tmp_path, monkeypatch, overrides):
    compared = check_replays(monkeypatch)
    train(tiny_scene, tmp_path / "run", *STEPS, *overrides)
    parts = {"project", "order", "lists", "blend", "backward", "unpack", "dssim"}
    assert (
        parts | ({"gradients", "statistics", "pixel loss"} if PENALTIES in overrides else {"update"}) <= compared.keys()
    )


@on_devices("sort", ["radix", "bitonic", "radix"])
def test_tables_that_moved_without_growing_are_bound_again(device, rng, monkeypatch, sort):
    """A rearrangement that changes nothing, in the middle of a training, leaves the bits of the tables as they are."""
    seed, tables = rng.integers(1 << 30), []
    compared = check_replays(monkeypatch)
    for is_rearranged in (False, True):
        trainer, photograph = trainer_of(device, np.random.default_rng(seed), [L1(weight=0.8), Dssim(weight=0.2)])
        trainer.rasterizer.tiler.sort = sort
        trainer.rasterizer.tiler._capacity = 5000  # no step is repeated
        gaussians = trainer.model.gaussians
        for step in range(1, 11):
            trainer.step(photograph, step)
            if step == 5 and is_rearranged:
                order = np.arange(gaussians.count, dtype=np.uint32)
                gaussians.rearrange(device.upload(order), device.upload(0 * order), gaussians.count)
        tables.append({name: gaussians.get(name) for name in gaussians.tables})
    for name, table in tables[0].items():
        np.testing.assert_array_equal(tables[1][name], table, err_msg=name)
    assert compared["update"] == 8 + 6
