"""Benchmark cases, which time whole steps and change nothing, and comparisons of measurements."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.api import tools
from clsplat.conformance.bench.cases import (
    BenchCase,
    BenchResult,
    Peaks,
    Work,
    make_case,
    run_bench,
    synthetic_scene,
    with_near,
)
from clsplat.conformance.bench.measurement import compare_conditions, read_measurement, table
from clsplat.core.errors import ConfigError
from clsplat.core.text_table import text_table
from clsplat.formats.splats import MOTION, PARAMETERS
from clsplat.gaussians.gaussians import INTERVAL2
from clsplat.photos.photographs import Photograph
from clsplat.pipeline.loading import load
from clsplat.render.camera import upload_camera

SIZE = (64, 48, 300)  # width, height, Gaussians


@pytest.mark.parametrize(
    ("pipeline", "losses", "columns"),
    [
        ("smoke", ["l1", "dssim"], {"screen_grad"}),
        ("absgs", ["l1", "dssim"], {"screen_grad", "screen_grad_abs"}),
        (
            "micro_splatting_v2",
            ["l1", "l2", "dssim", "covariance_trace"],
            {"screen_grad", "texture", "blend_weight", "screen_radius"},
        ),
    ],
)
def test_case_runs_its_pipeline_and_changes_nothing(device, pipeline, losses, columns):
    timed = make_case(device, *SIZE, load(pipeline).settings)
    trainer = timed.trainer
    assert (INTERVAL2 in trainer.model.gaussians.tables) == (pipeline == "micro_splatting_v2")
    assert trainer.adam.updates["sh_rest"] > 0, "harmonics are updated, so that their update is timed"
    before = {name: trainer.model.gaussians.get(name) for name in PARAMETERS}
    timed.step(record=True)
    view = trainer.step(timed.photograph, 1)
    assert sorted(loss.name for loss in view.losses) == sorted(losses)
    assert np.isfinite(view.loss)
    assert set(trainer.stats.names) == columns
    result = run_bench({"one": timed}, Peaks(100.0, 10.0, 10.0), repeats=2)["one"]
    for name in PARAMETERS:
        np.testing.assert_allclose(trainer.model.gaussians.get(name), before[name], rtol=0, atol=1e-20, err_msg=name)
    assert result.work.gaussians == SIZE[2]
    assert result.work.pairs > SIZE[2]
    assert set(result.floors) <= set(result.stages)
    assert "other" not in result.stages
    assert 0 < result.memory < 2 * result.planned


def test_moving_case_changes_nothing(device, rng):
    parameters, view = synthetic_scene(*SIZE)
    parameters[MOTION] = rng.normal(0, 0.3, (SIZE[2], 5)).astype(np.float32)
    pixels = rng.integers(0, 256, (3, SIZE[1], SIZE[0]), dtype=np.uint8)
    photograph = Photograph(upload_camera(device, replace(view, time=0.5)), device.upload(pixels))
    timed = BenchCase(device, parameters, photograph, "black", with_near(load("dynamic_7k").settings, 0.2))
    np.testing.assert_allclose(timed.trainer.model.gaussians.get(MOTION), parameters[MOTION], rtol=0, atol=1e-20)


def test_case_has_no_edits_due_and_is_timed_after_warm_up(device):
    timed = make_case(device, *SIZE, load("smoke").settings)
    assert not timed.step_times
    assert not timed.stages
    timed.step(record=True)
    timed.repeat()
    assert len(timed.step_times) == len(timed.mean_step_times) == 1
    assert timed.launches <= 26 if device.schedule == "simt" else timed.launches > 0
    assert all(len(times) == 1 for times in timed.stages.values())


def test_case_sorts_as_its_pipeline_does(device):
    for sort in ("radix", "bitonic"):
        timed = make_case(device, *SIZE, load("smoke", [f"rasterizer.sort={sort}"]).settings)
        assert timed.trainer.rasterizer.tiler.sort == sort


PEAKS = {"gflops": 60.0, "gexp": 3.0, "gbytes": 10.0}
TIMES = {"stages": {"sort": 1.0}, "host": 0.5, "step": 2.0, "densify": 9.0}


def measurement(**changes):
    return {"device": "a chip", "pipeline": "splat", "peaks": PEAKS, "scenes": {"A": TIMES}, **changes}


def test_measurement_is_read_without_its_baseline(tmp_path):
    (tmp_path / "x.json").write_text(json.dumps(measurement(against=measurement())))
    assert read_measurement(tmp_path / "x.json", "splat") == measurement()


@pytest.mark.parametrize(
    ("data", "place"),
    [
        ([], "the file"),
        ({}, "device"),
        (measurement(peaks={**PEAKS, "gexp": "fast"}), "peaks.gexp"),
        (measurement(scenes={"A": {**TIMES, "stages": 3}}), "scenes.A.stages"),
        (measurement(scenes={"A": {"stages": {}}}), "scenes.A.host"),
    ],
)
def test_invalid_measurement_is_refused_with_its_key(data, place, tmp_path):
    (tmp_path / "x.json").write_text(json.dumps(data))
    with pytest.raises(ConfigError, match=rf"x\.json: {place}: .*expected the JSON of an earlier"):
        read_measurement(tmp_path / "x.json", "splat")


def test_unchanged_speed_gets_no_remark():
    assert compare_conditions(measurement(), measurement()) == ["earlier: 60 GFLOP/s, 3.0 Gexp/s, copy 10.0 GB/s"]


def test_another_device_is_named():
    assert "  measured on another device: 'a chip'" in compare_conditions(measurement(device="another"), measurement())


def test_slower_machine_is_reported():
    slower = measurement(peaks={**PEAKS, "gflops": 45.0})
    changes = "0.75 of its GFLOP/s, 1.00 of its Gexp/s, 1.00 of its GB/s"
    assert changes in "".join(compare_conditions(slower, measurement()))


def test_unmeasured_scene_is_reported():
    lines = compare_conditions(measurement(scenes={"A": TIMES, "B": TIMES}), measurement())
    assert "  scenes: A; missing: B" in lines


def test_table_in_text_is_plain_and_never_cut(monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    monkeypatch.setenv("FORCE_COLOR", "1")
    long = "a long name [bold]of[/bold] a scene" * 20
    assert text_table([("scene", "MiB"), (long, "7"), ("b", "")], left_columns=1).splitlines() == [
        "scene".ljust(len(long)) + "  MiB",
        long + "    7",
        "b",
    ]
    assert text_table([]) == ""


def test_table_of_a_scene_has_a_row_for_each_stage():
    result = BenchResult(
        work=Work(gaussians=1000, pairs=2000, rows=3, pixels=4),
        stages={"project": 1.2, "blend": 30.0},
        floors={"project": 0.5},
        host=1.0,
        step=22.0,
        steps=20.0,
        densify=3.0,
        memory=2**24,
        planned=2**25,
        launches=20,
        bytes=7 * 2**20,
    )
    earlier = {"stages": {"project": 2.4, "blend": 0.0}, "host": 1.0, "step": 44.0, "densify": 1.0}
    lines = [line.split() for line in table("A", result, earlier).splitlines()]
    assert lines[1:4] == [
        ["stage", "ms", "floor", "ratio", "earlier", "now/earlier"],
        ["project", "1.20", "0.50", "2.40", "2.40", "0.50"],
        ["blend", "30.00"],
    ]
    assert [line[0] for line in lines[4:]] == ["host", "step", "steps", "densify", "memory"]
    assert table("A", result, None).splitlines()[1].split() == ["stage", "ms", "floor", "ratio"]


def test_report_has_the_checks_and_the_times_of_each_schedule(monkeypatch, tmp_path):
    failures = {"simt": [], "simt16": ["wrong"], "wide": []}
    checks = SimpleNamespace(default="simt", schedules=failures, failures=failures, data=lambda: {"verdict": "use it"})
    monkeypatch.setattr(tools, "doctor", lambda device: checks)
    times = SimpleNamespace(data=lambda: {"step": 1.0})
    monkeypatch.setattr(tools, "measure_speed", lambda *_, **__: times)
    tools.report_device(tmp_path / "gpu.json", ["A"])
    expected = {"doctor": {"verdict": "use it"}, "bench": {"simt": {"step": 1.0}}}
    assert json.loads((tmp_path / "gpu.json").read_text()) == expected
