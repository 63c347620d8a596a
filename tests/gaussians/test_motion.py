"""Moving models: files, snapshots, and formats that refuse motion."""

import errno
import itertools
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError, OutputError
from clsplat.formats.splats import MOTION, STATIC_LOG_DURATION, WIDTHS, motion_columns, motion_width
from clsplat.gaussians.conversion import merge_models
from clsplat.gaussians.model import Model, load
from clsplat.gaussians.motion import presence, static_motion
from clsplat.gaussians.sky import Sky


def moving_model(width: int = 5, count: int = 40) -> Model:
    """Gaussians of which the first is there always and the last is not there at 0."""
    rng = np.random.default_rng(width)
    motion = rng.normal(0, 0.2, (count, width)).astype(np.float32)
    motion[:, 3], motion[:, 4] = rng.uniform(0, 1, count), rng.normal(-1, 0.3, count)
    motion[0, :3], motion[0, 4] = 0, STATIC_LOG_DURATION
    motion[0, 5:] = 0
    motion[-1, 3], motion[-1, 4] = 1, -2
    tables = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3, "sh_rest": 9}
    return Model(**{n: rng.normal(size=(count, w)).astype(np.float32) for n, w in tables.items()}, motion=motion)


@pytest.mark.parametrize("width", WIDTHS)
def test_ply_keeps_the_motion(tmp_path, width):
    model = moving_model(width)
    model.save(tmp_path / "model.ply")
    pipeline = load(tmp_path / "model.ply")
    for name, table in model.tables().items():
        np.testing.assert_array_equal(getattr(pipeline, name), table)
    for column in motion_columns(width):
        assert f"property float {column}\n".encode() in (tmp_path / "model.ply").read_bytes()


def test_partial_motion_is_refused(tmp_path):
    moving_model(8).save(tmp_path / "model.ply")
    data = (tmp_path / "model.ply").read_bytes().replace(b"float acceleration_1\n", b"float acceleration_9\n")
    (tmp_path / "model.ply").write_bytes(data)
    with pytest.raises(DataError, match="only some of the motion properties"):
        load(tmp_path / "model.ply")


@pytest.mark.parametrize("name", ["a.spz", "a.sog", "a.splat", "a.glb", "a.usda"])
def test_other_formats_refuse_motion(tmp_path, name):
    with pytest.raises(DataError, match="--time T"):
        moving_model().save(tmp_path / name)
    assert not (tmp_path / name).exists()
    moving_model().at(0.5).save(tmp_path / name)


def test_snapshot_follows_the_kernels_formulas():
    model = moving_model(motion_width(3, True))
    moment, motion = model.at(0.25), model.motion.astype(np.float64)
    there = presence(motion, 0.25) >= 1 / 255
    dt = 0.25 - motion[there, 3:4]
    means = model.means[there] + motion[there, :3] * dt + motion[there, 5:8] * dt**2 + motion[there, 8:11] * dt**3
    np.testing.assert_allclose(moment.means, means, atol=1e-6)
    np.testing.assert_allclose(moment.quats, model.quats[there] + motion[there, 11:] * dt, atol=1e-6)
    np.testing.assert_allclose(moment.opacities, model.opacities[there] * presence(motion, 0.25)[there], rtol=1e-5)
    assert moment.motion is None
    assert len(model.at(0)) < len(model)
    np.testing.assert_array_equal(moment.means[0], model.means[0])
    np.testing.assert_array_equal(moment.logit_opacity[0], model.logit_opacity[0])
    assert moment.at(0.7) is moment
    with pytest.raises(ValueError, match="from 0 \\(start\\)"):
        model.at(1.5)


def test_snapshot_of_a_moved_model_is_the_moved_snapshot():
    model, turn = moving_model(motion_width(2, True)), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    first, other = model.transformed(2.0, turn, (1, 2, 3)).at(0.6), model.at(0.6).transformed(2.0, turn, (1, 2, 3))
    for name, table in first.tables().items():
        np.testing.assert_allclose(table, getattr(other, name), atol=2e-5, err_msg=name)


def test_merged_models_move_as_before():
    moving, standing = moving_model(), replace(moving_model(), motion=None)
    both = merge_models([standing, moving], ["a", "b"])
    np.testing.assert_array_equal(both.motion[40:], moving.motion)
    np.testing.assert_array_equal(both.motion[:40], static_motion(40, 5))
    assert len(both.at(0)) == 40 + len(moving.at(0))
    with pytest.raises(DataError, match="in degree or rotation"):
        merge_models([moving, moving_model(8)], ["a", "b"])


def test_convert_writes_snapshots(tmp_path: Path):
    model, source = moving_model(), tmp_path / "moving.ply"
    model.save(source)
    clsplat.convert(source, tmp_path / "one.spz", time=0.5)
    done = clsplat.convert(source, tmp_path / "frames", frames=3)
    assert [Path(name).name for name in done["files"]] == ["0000.ply", "0001.ply", "0002.ply"]
    np.testing.assert_array_equal(load(tmp_path / "frames" / "0001.ply").means, model.at(0.5).means)
    done = clsplat.convert(source, tmp_path / "frame.spz", frames=2)
    assert [Path(name).name for name in done["files"]] == ["frame_0000.spz", "frame_0001.spz"]
    assert len(clsplat.convert(source, tmp_path / "frames", frames=3)["files"]) == 3  # the same ones again
    with pytest.raises(ConfigError, match=r"0002\.ply: has a frame's name, but is not one of the 2 frames"):
        clsplat.convert(source, tmp_path / "frames", frames=2)
    for wrong in ({"time": 2.0}, {"frames": 1}, {"frames": 3, "time": 0.5}):
        with pytest.raises(ConfigError, match=r"expected|cannot be combined"):
            clsplat.convert(source, tmp_path / "frames", **wrong)


def test_series_reports_lost_data_once(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    model = moving_model()
    replace(model, rendering=replace(model.rendering, background="white")).save(tmp_path / "moving.ply")
    clsplat.convert(tmp_path / "moving.ply", tmp_path / "frame.spz", frames=3)
    (told,) = [record.getMessage() for record in caplog.records if "does not store" in record.getMessage()]
    assert told.startswith(str(tmp_path / "frame_0000.spz"))


def test_snapshots_of_a_static_model_are_refused(tmp_path):
    still = tmp_path / "still.ply"
    moving_model().at(0.5).save(still)
    for out, asked in (("out.spz", {"time": 0.5}), ("out", {"frames": 3})):
        with pytest.raises(ConfigError, match="the model does not move; omit --time and --frames"):
            clsplat.convert(still, tmp_path / out, **asked)
    assert [path.name for path in tmp_path.iterdir()] == ["still.ply"]


def test_series_is_complete_or_absent(tmp_path):
    """Late in it all Gaussians are gone."""
    model = moving_model()
    motion = model.motion.copy()
    motion[:, 3:5] = 0.0, np.log(0.01)
    replace(model, motion=motion).save(tmp_path / "brief.ply")
    with pytest.raises(DataError, match=r"--frames 3: time 0\.5: none of the 40 .*; nothing was written"):
        clsplat.convert(tmp_path / "brief.ply", tmp_path / "frames", frames=3)
    with pytest.raises(DataError, match="nothing was written"):
        clsplat.convert(tmp_path / "brief.ply", tmp_path / "frame.spz", frames=3)
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.name != "brief.ply"]


@pytest.mark.parametrize("before", [False, True])
def test_full_disk_leaves_no_partial_series(before, tmp_path, monkeypatch):
    model, out = moving_model(), tmp_path / "frames"
    replace(model, sky=Sky(np.full((64, 3), 0.5, np.float32))).save(tmp_path / "moving.ply")
    if before:
        model.save(tmp_path / "other.ply")
        clsplat.convert(tmp_path / "other.ply", out, frames=4)
    had = {path: path.read_bytes() for path in out.rglob("*")}
    real, calls = os.fsync, itertools.count()
    monkeypatch.setattr(os, "fsync", lambda number: real(number) if next(calls) < 9 else full())
    with pytest.raises(OutputError, match=r"frames/\d{4}.*: cannot be written \(No space left on device\)"):
        clsplat.convert(tmp_path / "moving.ply", out, frames=4)
    assert {path: path.read_bytes() for path in out.rglob("*")} == had
    assert out.exists() == before
    monkeypatch.undo()
    assert len(clsplat.convert(tmp_path / "moving.ply", out, frames=4)["files"]) == 4
    assert sorted(path.name for path in out.iterdir())[:3] == ["0000.ply", "0000_sky.json", "0001.ply"]


def full() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_too_large_speeds_are_refused_or_dropped(tmp_path):
    model = moving_model()
    motion = model.motion.copy()
    motion[3, 0], motion[3, 3:5] = 1e38, (1e38, 90)
    fast = replace(model, motion=motion)
    with pytest.raises(DataError, match="1 Gaussians have no finite position"):
        fast.at(0.5)
    fast.save(tmp_path / "fast.ply")
    clsplat.convert(tmp_path / "fast.ply", tmp_path / "rest.ply", time=0.5)
    assert np.isfinite(load(tmp_path / "rest.ply").means).all()


def test_some_gaussians_of_a_moving_model_move():
    model = moving_model()
    np.testing.assert_array_equal(model[[3, 5]].motion, model.motion[[3, 5]])
    with pytest.raises(ValueError, match=f"{MOTION} has shape"):
        replace(model, motion=np.zeros((40, 6), np.float32))
