"""Bilateral grids: settings, whole runs, and outputs."""

import hashlib
import json
import os
import subprocess
import sys
from copy import copy
from pathlib import Path

import numpy as np
import pytest

from clsplat.api import commands
from clsplat.api.commands import evaluate
from clsplat.conformance.checks.appearance import random_grids
from clsplat.conformance.checks.images import make_camera, to_planes
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.schedule import Decay, at_step
from clsplat.opencl.device import Device
from clsplat.pipeline import plugins
from clsplat.pipeline.loading import load
from clsplat.render.workspace import Workspace
from clsplat.runs.status import summarize_run
from clsplat.training import archive, checkpoint, memory
from clsplat.training.modules.base import attach_modules, read_color_model
from clsplat.training.modules.bilateral_grid import BilateralGrid, grid_bytes
from clsplat.training.modules.exposure import Exposure, Gain
from clsplat.training.run import Run
from tests.support.runs import FEW, ONE_CORE, digest, train

PLAIN = '''
from typing import Literal
from clsplat.training.modules.exposure import IDENTITY, Appearance, ColorState, Gain, ColorReport


class Plain(Appearance):
    """Colors as they are."""

    type: Literal["plain"] = "plain"

    def create_state(self, run):
        return Views(self, [view.name for view in run.scene.split("train")])

    @property
    def color_model(self):
        return Gain()


class Views(ColorState):
    def start_from(self, log_gains):
        self.scalars |= {f"colors/{view}/steps": 0.0 for view in self.views}

    def report(self):
        steps = {view: self.scalars[f"colors/{view}/steps"] for view in self.views}
        facts = {"meaning": "none", "type": "plain", "photographs": steps}
        return ColorReport(dict.fromkeys(self.views, IDENTITY), facts)

    def update(self, step):
        self.scalars[f"colors/{self.views[step.view_index]}/steps"] += 1
'''
GRID = (*FEW, "optimize.modules.bilateral_grid={grid_shape: [3, 2, 4]}")


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run of twelve steps with a grid of each photograph; nothing is changed in it."""
    return train(tiny_scene, tmp_path_factory.mktemp("runs") / "grids", *GRID)


@pytest.fixture
def with_grids(finished: Run) -> Path:
    """Its folder."""
    return finished.out


def test_key_accepts_cells_per_axis():
    def grid(setting: str):
        return load("smoke", [f"optimize.modules.bilateral_grid={setting}"]).settings.training.modules[0]

    assert grid("{}") == BilateralGrid(grid_shape=[4, 4, 4])
    assert grid("{grid_shape: [16, 16, 8]}").grid_shape == [16, 16, 8]
    assert grid("{when: auto}") == BilateralGrid(when="auto")
    for wrong in ("[4, 4]", "[0, 4, 4]", "[4, 4, 17]", "4"):
        with pytest.raises(ConfigError, match=r"bilateral_grid.*grid_shape"):
            grid(f"{{grid_shape: {wrong}}}")


def test_rate_warms_up_and_decays():
    for steps, warm_up in ((1500, 150), (30_000, 1000)):
        published = Decay(initial=2e-3, final=2e-5, over=steps)
        for known, expected in ((True, published), (False, Exposure().rate_schedule(steps, 50, False))):
            result = BilateralGrid().rate_schedule(steps, 50, known)
            assert at_step(result, 0) == pytest.approx(at_step(expected, 0) / 100)
            for step in range(warm_up, steps + 1, 50):
                assert at_step(result, step) == pytest.approx(at_step(expected, step), rel=0.03)
    assert BilateralGrid(rate=0.02).rate_schedule(7000, 50) == 0.02
    assert at_step(BilateralGrid().rate_schedule(1, 1), 1) > 0


@pytest.mark.slow
def test_checkpoints_contain_grids_moments_and_counts(with_grids):
    state, tables = checkpoint.load(with_grids / "checkpoints" / "step_000012.npz")
    own, _ = archive.split(tables, "modules/bilateral_grid/")
    assert own.keys() == {"values", "moment1", "moment2"}
    counts = [value for name, value in state.modules["bilateral_grid"].items() if name.endswith("/updates")]
    assert (len(counts), sum(counts)) == (8, 12)


def bits(device: Device) -> str:
    """The SHA-256 of what two steps with a grid make of an image and of all grids."""
    rng, result = np.random.default_rng(3), hashlib.sha256()
    first, workspace, camera = random_grids(device, rng, (5, 4, 3)), Workspace(device), make_camera(device, 100, 70)
    planes = [to_planes(device, camera, rng.normal(0.5, 0.4, (3, 70, 100))) for _ in range(2)]
    for step in (1, 2):
        image, _ = first.transform(workspace, camera, planes[0], 1), first.smoothness(workspace, 1)
        gradient, grad_grid = first.differentiate(workspace, camera, *planes, 1)
        first.learn(workspace, 1, grad_grid, step)
        for array in (image, gradient, *first.arrays.values()):
            result.update(array.get().tobytes())
    return result.hexdigest()


@pytest.mark.slow
def test_one_core_gives_the_same_bits(info):
    code = f"from {__name__} import Device, bits\nfrom clsplat.opencl.discovery import choose_device\n"
    code += f"print(bits(Device(choose_device({info.name!r}))))"
    command, own = [sys.executable, "-c", code], {**os.environ, **ONE_CORE}
    done = subprocess.run(command, check=True, env=own, capture_output=True, text=True)
    assert done.stdout.split()[-1] == bits(Device(info))


@pytest.mark.slow
def test_grids_are_written_and_metrics_use_gains(with_grids, few_steps, tmp_path):
    data = json.loads((with_grids / "view_colors.json").read_text())
    arrays = np.load(with_grids / data["file"], allow_pickle=False)
    assert (data["type"], data["grid_shape"]) == ("bilateral_grid", [3, 2, 4])
    assert arrays.shape == (8, 4, 2, 3, 3, 4)
    assert arrays.dtype == np.float32
    assert arrays.mean(axis=(0, 2, 3)) == pytest.approx(np.tile(np.eye(3, 4), (4, 1, 1)), abs=1e-6)
    for row in data["photographs"].values():
        assert row["matrix"] == pytest.approx(arrays[row["row"]].mean(axis=(0, 1, 2)), abs=1e-6)
    assert {"view_colors.json", "view_colors.npy"} < json.loads((with_grids / "checksums.json").read_text()).keys()
    measured = json.loads((with_grids / "metrics.json").read_text())["test"]["1"]
    assert measured["psnr_color"] == pytest.approx(evaluate(with_grids)["test"]["1"]["psnr_color"], abs=1e-6)
    assert read_color_model(with_grids / "point_cloud.ply") == Gain()
    assert digest(with_grids) != digest(few_steps)
    assert ["colors", f"{with_grids}/view_colors.json"] in [line.split() for line in summarize_run(with_grids)]


@pytest.mark.slow
def test_best_model_has_the_grids_of_its_step(tiny_scene, tmp_path):
    wild = "optimize.rates.means=[[8, 1.0e-3], [9, 0.9]]"
    kept = ("scene.validation=2", "optimize.keep=best", "optimize.evaluate.split=validation")
    run = train(tiny_scene, tmp_path / "run", *GRID, *kept, "optimize.evaluate.every=4", wild)
    assert run.best.measured.step == 8, "the last steps ruin it"
    _, tables = checkpoint.load(tmp_path / "run" / "checkpoints" / "step_000008.npz")
    own, _ = archive.split(tables, "modules/bilateral_grid/")
    expected = own["values"].reshape(-1, 3, 4, 4, 2, 3).transpose(0, 3, 4, 5, 1, 2)
    arrays = np.load(tmp_path / "run" / "view_colors.npy")
    assert (arrays == expected + np.eye(3, 4, dtype=np.float32)).all()


@pytest.mark.slow
@pytest.mark.parametrize("cells", [[1, 1, 1], [4, 3, 2]])
def test_training_resumes_its_grids_and_restarts_with_others(finished, cells):
    """Also with as many of them."""
    run, before = copy(finished), finished.modules["bilateral_grid"]
    run.modules = dict(finished.modules)
    (same,) = attach_modules(finished.settings.training.modules, run, 24)
    assert same.scalars == before.scalars
    assert all((table == before.tables()[name]).all() for name, table in same.tables().items())
    (other,) = attach_modules([BilateralGrid(grid_shape=cells)], run, 24)
    assert other is run.modules["bilateral_grid"] is not before
    assert not other.tables()["values"].any()
    assert other.scalars[f"colors/{other.names[0]}/updates"] == 0 < before.scalars[f"colors/{other.names[0]}/updates"]


@pytest.mark.slow
def test_memory_plan_counts_grids_first(finished):
    views, tile = finished.scene.split("train"), int(finished.device.tuning["TILE"])
    width, height = (-(-side // tile) * tile for side in (views[0].camera.width, views[0].camera.height))

    def fixed(*modules) -> int:
        run, training = copy(finished), finished.settings.training.model_copy(update={"modules": [*modules]})
        stages = [training if stage.stage == "optimize" else stage for stage in run.settings.stages]
        run.settings = run.settings.model_copy(update={"stages": stages})
        return run.memory_plan(memory.table_widths(0)).fixed

    wide = BilateralGrid(grid_shape=[16, 16, 8])
    more = fixed(wide) - fixed(Exposure())
    assert more == grid_bytes([16, 16, 8], len(views), height) + 3 * 4 * width * height
    assert more > 3 * 4 * 12 * 16 * 16 * 8 * len(views)
    assert fixed(wide.model_copy(update={"when": "auto"})) == fixed(wide), "as long as it is not chosen"
    off = wide.model_copy(update={"when": "auto", "chosen": "off"})
    assert fixed(off) == fixed() == fixed(Exposure()) - 6 * 4 * width * height


@pytest.mark.slow
def test_dry_run_validates_grids(tiny_scene, tmp_path):
    def describe(shape: str) -> object:
        setting = [f"optimize.modules.bilateral_grid={{grid_shape: {shape}}}"]
        return commands.describe_run("smoke", tiny_scene, tmp_path / "run", set=setting)

    assert describe("[4, 4, 2]")
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match="grid_shape"):
        describe("[4, 4]")


def test_damaged_tables_are_refused():
    good = {name: np.zeros((2, 12, 2, 1, 1), np.float32) for name in ("values", "moment1", "moment2")}
    rows = {"colors/a/row": 0.0, "colors/b/row": 1.0}
    BilateralGrid.check_saved(rows, good)
    BilateralGrid.check_saved(rows, {"values": good["values"]})
    for damaged in (
        {"values": good["values"][:, :5]},
        {**good, "moment2": good["values"][:1]},
        {**good, "more": good["values"]},
        {"moment1": good["values"]},
        {**good, "moment1": good["values"] + np.float32(np.nan)},
        {},
    ):
        with pytest.raises(DataError, match=r"its grids do not have|of its BilateralGrid has"):
            BilateralGrid.check_saved(rows, damaged)
    for damage in ({"colors/b/row": 6.0}, {"colors/a/row": 0.5}, {"colors/c/row": 2.0}):
        with pytest.raises(DataError, match="bilateral grids for 2 photos"):
            BilateralGrid.check_saved(rows | damage, good)


@pytest.mark.slow
def test_checkpoint_without_its_grids_is_refused(with_grids, tmp_path):
    notes, tables = archive.read(with_grids / "checkpoints" / "step_000012.npz")
    left = {name: table for name, table in tables.items() if not name.startswith("modules/")}
    assert len(left) == len(tables) - 3
    with (tmp_path / "step_000012.npz").open("wb") as file:
        archive.write(file, notes, left.items())
    with pytest.raises(DataError, match="its grids do not have"):
        checkpoint.load(tmp_path / "step_000012.npz")


@pytest.mark.slow
@pytest.mark.usefixtures("without_plugins")
def test_plugin_module_is_trained(tiny_scene, few_steps, tmp_path):
    """It makes what a training has of it; one that changes nothing leaves the bits of none."""
    (tmp_path / "mine.py").write_text(PLAIN)
    plugins.load_file(tmp_path / "mine.py")
    train(tiny_scene, tmp_path / "run", *FEW, "optimize.modules.plain={}")
    data = json.loads((tmp_path / "run" / "view_colors.json").read_text())
    assert data["type"] == "plain"
    assert sum(data["photographs"].values()) == 12
    assert digest(tmp_path / "run") == digest(few_steps)
