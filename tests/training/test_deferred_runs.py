"""Runs whose harmonics are updated when a view sees them, on the device and on the host: the bits of one at once.

And runs that update only the rows that each view sees.
"""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, MemoryLimitError
from clsplat.formats.ply import write_ply
from clsplat.formats.table import read as read_ply
from clsplat.losses.base import LossValue, Penalty
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import load
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.runs import opening, run_folder, runner
from clsplat.runs.describe import describe
from clsplat.runs.state import RunState
from clsplat.sweeps.experiment import run_pipeline
from clsplat.training import checkpoint
from clsplat.training.memory import offload_target
from clsplat.training.sh_offload import device_capacity
from tests.support.runs import FEW, digest, killed, train

pytestmark = pytest.mark.slow

DEFERRED, HOST = "optimize.update=deferred", "rasterizer.harmonics=host"
WAYS = {"deferred": (DEFERRED,), "host": (HOST,), "both": (DEFERRED, HOST)}


def spread_of(few_steps, file, near):
    """Settings of a run from 2,000 Gaussians, of which views see so many, with growth and harmonics."""
    model = read_ply(few_steps / "point_cloud.ply").parameters
    model, count = {name: table[:2000] for name, table in model.items()}, 2000
    model["means"][near:, 2] += 500
    rng = np.random.default_rng(0)
    model["sh_rest"] = rng.normal(0, 0.05, (count, 45)).astype(np.float32)
    write_ply(file, model, {})
    return "init.source=model", f"init.file='{file}'", *FEW, "optimize.checkpoint.keep=9"


@pytest.fixture(scope="module")
def spread(few_steps, tmp_path_factory):
    return spread_of(few_steps, tmp_path_factory.mktemp("spread") / "spread.ply", 500)


@pytest.fixture(scope="module")
def at_once(spread, tiny_scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "at_once"
    train(tiny_scene, out, *spread)
    return out


def tables(out, step):
    return checkpoint.load(out / "checkpoints" / f"step_{step:06d}.npz")[1]


@pytest.mark.parametrize("way", WAYS)
def test_run_gives_the_bits_of_immediate_updates(way, spread, at_once, tiny_scene, tmp_path):
    """In the file, and in each checkpoint with the moments; Gaussians have been added; a run resumes."""
    out = train(tiny_scene, tmp_path / "run", *spread, *WAYS[way]).out
    for step in (4, 8, 12):
        expected = tables(at_once, step)
        for name, table in tables(out, step).items():
            np.testing.assert_array_equal(table.view(np.uint32), expected[name].view(np.uint32), err_msg=name)
    assert len(tables(out, 12)["gaussians/means"]) > len(tables(out, 4)["gaussians/means"])
    for name in ("step_000012.npz", "step_000008.npz"):
        (out / "checkpoints" / name).unlink()
    (out / "point_cloud.ply").unlink()
    train(tiny_scene, out, *spread, *WAYS[way], resume=True)
    assert digest(out) == digest(at_once)


def test_run_resumes_with_offloaded_harmonics(spread, at_once, tiny_scene, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(at_once, out)
    for path in (*sorted((out / "checkpoints").iterdir())[1:], out / "point_cloud.ply"):
        path.unlink()
    train(tiny_scene, out, *spread, HOST, resume=True)
    assert digest(out) == digest(at_once)


def test_too_large_plan_suggests_the_host(spread, tiny_scene, tmp_path):
    """The harmonics stay where the settings say; the plan of the host needs less of the device."""
    run = train(tiny_scene, tmp_path / "first", *spread, "optimize.steps=1")
    count, own = run.model.gaussians.count, run.memory_plan()
    assert run.model.gaussians.on_host is None
    other = run.memory_plan(harmonics="host")
    between = (other.required_bytes(count) + own.required_bytes(count)) // 2
    assert other.required_bytes(count) < between < own.required_bytes(count)
    assert "MiB on the host" in other.text(count)
    assert "on the host" not in own.text(count)
    replace(other, memory=between).check(count)
    with pytest.raises(MemoryLimitError, match=r"rasterizer\.harmonics=auto"):
        replace(own, memory=between).check(count, ", or rasterizer.harmonics=auto")
    with pytest.raises(MemoryLimitError) as refused:
        replace(other, memory=0).check(count)
    assert "rasterizer.harmonics" not in str(refused.value)


@pytest.mark.parametrize(("more", "told"), [(("rasterizer.harmonics=device",), True), ((), False)])
def test_offloading_is_suggested_only_if_it_helps(more, told, tiny_scene, tmp_path, small):
    """Where views see all Gaussians a training is refused before its first step, and the host is no remedy."""
    own = [f"scene.path='{tiny_scene}'", *FEW, *more]
    with pytest.raises(MemoryLimitError) as refused:
        run_pipeline(load("smoke", own), RunState.read(tmp_path / "run"), Device(small(7700)), "new")
    assert ("rasterizer.harmonics=auto" in str(refused.value)) == told
    assert "for 7,995 Gaussians" in str(refused.value)


@pytest.fixture(scope="module")
def small(spread, tiny_scene, info, tmp_path_factory):
    """Devices with memory of their own that hold about so many Gaussians in these runs."""
    plan = train(tiny_scene, tmp_path_factory.mktemp("runs") / "first", *spread, "optimize.steps=1").memory_plan()
    return lambda held: replace(info, memory=plan.required_bytes(held), unified=False)


def test_harmonics_move_to_the_host_if_the_device_is_full(spread, at_once, tiny_scene, tmp_path, small, caplog):
    """2,000 Gaussians become more than 3,000; a resumed run moves them where it needs to, whatever it did before."""
    out, own, device = tmp_path / "run", [f"scene.path='{tiny_scene}'", *spread], small(3150)
    with caplog.at_level("INFO", "clsplat"):
        run_pipeline(load("smoke", own), RunState.read(out), Device(device), "new")
    (told,) = [
        record.message for record in caplog.records if "moving SH coefficients to the host, since" in record.message
    ]
    assert not told.startswith("step 0: ")
    assert digest(out) == digest(at_once)
    for memory in (device.memory, 8 << 30):
        for name in ("checkpoints/step_000012.npz", "checkpoints/step_000008.npz", "point_cloud.ply"):
            (out / name).unlink()
        run_pipeline(load("smoke", own), RunState.read(out), Device(replace(device, memory=memory)), "resume")
        assert digest(out) == digest(at_once)
    assert read_yaml(out / "pipeline.yaml").data["rasterizer"]["harmonics"] == "auto"


def test_run_with_few_visible_rows_resumes_from_any_checkpoint(few_steps, tiny_scene, tmp_path, small):
    """Growth ends above what the estimate of the host allows, and below what the views that were looked at do."""
    own = [f"scene.path='{tiny_scene}'", *spread_of(few_steps, tmp_path / "few.ply", 200), "optimize.steps=16"]
    device, out = small(2050), tmp_path / "run"
    run_pipeline(load("smoke", own), RunState.read(out), Device(device), "new")
    expected = digest(out)
    with run_folder.open_run_folder(RunState.read(out), "resume", step=0) as status:
        run = opening.open_run(load("smoke", own), out, Device(device), "resume", status)
        checkpoint.restore(run)
    assert run.model.gaussians.on_host is not None
    assert run.model.gaussians.count > run.memory_plan(harmonics="host").limit
    for step in (12, 8, 4):
        for file in (out / "checkpoints").iterdir():
            if int(file.stem[-6:]) > step:
                file.unlink()
        (out / "point_cloud.ply").unlink()
        run_pipeline(load("smoke", own), RunState.read(out), Device(device), "resume")
        assert digest(out) == expected


def test_too_large_model_starts_with_harmonics_on_the_host(spread, tiny_scene, tmp_path, small, caplog):
    """As where the settings say it."""
    for name, more in (("auto", ()), ("host", (HOST,))):
        with caplog.at_level("INFO", "clsplat"):
            own = [f"scene.path='{tiny_scene}'", *spread, "densify.start=99", *more]
            run_pipeline(load("smoke", own), RunState.read(tmp_path / name), Device(small(1900)), "new")
    messages = [one.message for one in caplog.records if "moving SH coefficients to the host" in one.message]
    assert [one.startswith("step 0: ") for one in messages] == [True, True]
    assert ["the device can hold only 1," in one for one in messages] == [True, False]
    assert digest(tmp_path / "auto") == digest(tmp_path / "host")


def test_harmonics_stay_on_the_device_if_views_see_all(tiny_scene, tmp_path, info):
    """They would need more of the device than they do now; the estimate of the host does not know that."""
    run = train(tiny_scene, tmp_path / "run", *FEW, "optimize.steps=1")
    own = run.memory_plan()
    run.device.info = replace(info, memory=own.required_bytes(run.model.gaussians.count), unified=False)
    held = run.memory_plan(harmonics="device").limit
    assert run.harmonics == "auto"
    assert device_capacity(run) == held < run.memory_plan(harmonics="host").limit


def test_harmonics_stay_on_the_device_if_the_host_is_no_help(tiny_scene, info):
    """A stage needs them on the device, there are none, or the device's memory is the host's."""
    own = f"scene.path='{tiny_scene}'"
    average = "optimize.during=[{average: {every: 2}}]"
    actual = [load("smoke", [own, *more]).settings.harmonics for more in ([], [average], ["model.sh_degree=0"])]
    assert actual == ["auto", "device", "device"]
    apart, shared = (replace(info, unified=unified) for unified in (False, True))
    actual = [offload_target("auto", apart), offload_target("auto", shared), offload_target("host", shared)]
    assert actual == ["host", "device", "host"]


def test_dry_run_reports_offloaded_harmonics(tiny_scene, tmp_path):
    own = [f"scene.path='{tiny_scene}'", HOST]
    text = describe(load("smoke", own), RunState.read(tmp_path / "run"), None, "new")
    assert "MiB on the host" in text
    assert "on the host" not in describe(load("smoke", own[:1]), RunState.read(tmp_path / "run"), None, "new")


def test_device_holds_the_visible_part_of_host_harmonics(spread, tiny_scene, tmp_path):
    """Half of these Gaussians are far apart: the last view sees some of the blocks."""
    run = train(tiny_scene, tmp_path / "run", *spread, HOST)
    gaussians = run.model.gaussians
    held = {name: table.array.nbytes for name, table in gaussians.tables.items()}
    assert set(gaussians.on_host.tables) == {"sh_rest", "adam/sh_rest/moment1", "adam/sh_rest/moment2"}
    assert held["sh_rest"] == gaussians.on_host.block_size * 4 * gaussians.tables["sh_rest"].array.shape[0]
    assert 0 < len(gaussians.on_host.loaded_blocks) <= gaussians.tables["sh_rest"].array.shape[0]


def test_settings_that_need_all_harmonics_are_refused(tiny_scene):
    own = f"scene.path='{tiny_scene}'", "optimize.during=[{average: {every: 2}}]"
    assert load("smoke", own)
    with pytest.raises(
        ConfigError, match=r"average: .* harmonics on the host \(rasterizer\): it changes the harmonics"
    ):
        load("smoke", [*own, HOST])


def test_harmonics_on_the_host_can_be_reduced(spread, tiny_scene, tmp_path):
    """After the training, where no band is left, and in it, as on the device."""
    during = "optimize.during=[{reduce_sh: {degree: 1, every: 4, stop: 5}}, {reduce_sh: {degree: 0, every: 8}}]"
    actual = [
        train(tiny_scene, tmp_path / way, *spread[:2], "optimize.steps=10", during, f"rasterizer.harmonics={way}")
        for way in ("device", "host")
    ]
    assert [run.model.gaussians.sh_degree for run in actual] == [0, 0]
    assert digest(actual[0].out) == digest(actual[1].out)


class OnHarmonics(Penalty):
    """A penalty on what waits."""

    def add(self, inputs):
        inputs.gradients["sh_rest"].fill(0)
        return LossValue("harmonics", lambda: 0.0)


def test_penalty_on_harmonics_is_refused(few_steps, tiny_scene, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(few_steps, out)
    checked = load("smoke", [f"scene.path='{tiny_scene}'", *FEW, DEFERRED])
    with run_folder.open_run_folder(RunState.read(out), "restart", step=0) as status:
        run = opening.open_run(checked, out, None, "restart", status)
        run.losses.append(OnHarmonics(weight=1.0))
        with pytest.raises(ConfigError, match="a penalty on sh_rest"):
            runner.execute(checked, run, "restart", lambda progress: None)


def test_run_of_visible_rows_resumes_bit_for_bit(tiny_scene, few_steps, tmp_path):
    """From Gaussians of which each view sees a part."""
    spread = read_ply(few_steps / "point_cloud.ply").parameters
    spread["means"][::2] *= 6
    write_ply(tmp_path / "spread.ply", spread, {})
    first = ("init.source=model", f"init.file='{tmp_path / 'spread.ply'}'", *FEW)
    seen = (*first, "optimize.update=seen", "optimize.checkpoint.keep=9")
    train(tiny_scene, tmp_path / "all", *first)
    train(tiny_scene, tmp_path / "seen", *seen)
    again = killed(tmp_path / "seen", tmp_path / "again")
    whole = digest(tmp_path / "seen")
    assert digest(tmp_path / "all") != whole
    train(tiny_scene, again, *seen, resume=True)
    assert digest(again) == whole
