"""The command line for scripts: outputs, one-line errors, exit codes."""

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.commands import clsplat, process
from tests.support.onnx_writer import distance_network
from tests.support.runs import train

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def model(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("cli") / "run"
    train(tiny_scene, out)
    return out / "point_cloud.ply"


def test_run_prints_the_device_and_the_output_paths(tiny_scene, tmp_path):
    done = process("run", "smoke", "--scene", tiny_scene, "--out", tmp_path / "run")
    lines = done.stdout.splitlines()
    assert lines[0].startswith("device: ")
    assert "schedule" in lines[0]
    assert any("test PSNR" in line for line in lines)
    assert any(str(tmp_path / "run" / "report.html") in line for line in lines)
    assert any(re.match(r"\d+,\d{3} Gaussians from ", line) for line in lines)
    assert any(re.match(r"  model    .*\.ply", line) for line in lines)
    log = (tmp_path / "run" / "log.txt").read_text()
    assert "loss" in log
    assert [line for line in lines if line not in log] == []


def test_dry_run_touches_nothing(tiny_scene, tmp_path):
    done = clsplat("run", "smoke", "--scene", tiny_scene, "--out", tmp_path / "run", "--dry-run")
    assert "50 steps" in done.stdout
    assert "densify every 10 (start 15, stop 45), reset_opacity every 20 (stop 30)" in done.stdout
    assert not (tmp_path / "run").exists()


def test_quality_selects_the_variant_of_a_pipeline(tiny_scene, tmp_path):
    arguments = ["--scene", tiny_scene, "--out", tmp_path / "run", "--dry-run"]
    assert "1200 steps" in clsplat("run", "photos", "--quality", "draft", *arguments).stdout
    clsplat("run", "fast", "--quality", "high", *arguments, expect=2)


def test_dry_run_prints_when_each_stage_acts(tiny_scene, tmp_path):
    done = clsplat("run", "splat_7k", "--scene", tiny_scene, "--out", tmp_path / "run", "--dry-run")
    assert "reset_opacity every 500 (stop 501, when_background white)" in done.stdout


def test_set_takes_several_values(tiny_scene, tmp_path):
    sets = ["--set", "optimize.steps=3", "optimize.log_every=1", "--set", "seed=4"]
    clsplat("run", "smoke", "--scene", tiny_scene, "--out", tmp_path, *sets)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert (metrics["steps"], metrics["seed"]) == (3, 4)


def test_failed_start_is_in_the_status(tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "run").mkdir()
    clsplat("run", "smoke", "--scene", tmp_path / "scene", "--out", tmp_path / "run", expect=3)
    status = json.loads((tmp_path / "run" / "status.json").read_text())
    assert (status["state"], status["exit_code"]) == ("failed", 3)
    assert "no dataset found" in status["message"]


def test_check_validates_a_recipe_and_prints_the_schema():
    assert "splat.yaml: valid; init, optimize" in clsplat("check", "splat").stdout
    assert json.loads(clsplat("check", "--schema").stdout)["properties"]["stages"]
    data = json.loads(clsplat("check", "splat", "--json").stdout)
    assert (data["name"], data["valid"]) == ("splat", True)


def test_devices_lists_a_working_device():
    assert "schedule" in clsplat("devices").stdout
    devices = json.loads(clsplat("devices", "--json").stdout)
    assert any(device["fault"] is None for device in devices)


def test_render_writes_one_file_for_each_view(model, tiny_scene, tmp_path):
    clsplat("render", model, "--scene", tiny_scene, "--out", tmp_path / "png")
    files = sorted(path.relative_to(tmp_path / "png") for path in (tmp_path / "png").rglob("*.png"))
    assert [str(file) for file in files] == ["test/r_000.png", "test/r_001.png"]
    clsplat("render", model, "--scene", tiny_scene, "--out", tmp_path / "npy", "--format", "npy", "--split", "all")
    arrays = sorted((tmp_path / "npy").rglob("*.npy"))
    assert len(arrays) == 10
    image = cv2.imread(str(tmp_path / "png" / "test" / "r_000.png"))[..., ::-1]
    exact = np.load(tmp_path / "npy" / "test" / "r_000.npy")
    np.testing.assert_array_equal(image, (np.clip(exact, 0, 1) * 255 + 0.5).astype(np.uint8))
    clsplat("render", model, "--scene", tiny_scene, "--out", tmp_path / "small", "--scale", "2")
    assert cv2.imread(str(tmp_path / "small" / "test" / "r_000.png")).shape == (20, 20, 3)


def test_evaluate_agrees_with_the_run(model, tiny_scene, tmp_path):
    clsplat("evaluate", model, "--scene", tiny_scene, "--downscales", "1,2", "--out", tmp_path / "m.json")
    metrics = json.loads((tmp_path / "m.json").read_text())
    run = json.loads((model.parent / "metrics.json").read_text())
    assert metrics["test"]["1"] == run["test"]["1"]
    assert metrics["test"]["2"]["views"] == 2
    assert metrics["train"]["1"]["views"] == 8


def test_evaluate_with_more_metrics(model, tiny_scene, tmp_path):
    network = tmp_path / "distance.onnx"
    network.write_bytes(distance_network())
    more = ["--metrics", "psnr,ssim,ms_ssim", "--lpips", network, "--lpips-input", "0..1"]
    clsplat("evaluate", model, "--scene", tiny_scene, "--out", tmp_path / "m.json", *more)
    test = json.loads((tmp_path / "m.json").read_text())["test"]["1"]
    assert 0 < test["ms_ssim"] < 1
    assert test["ms_ssim_scales"] == 2  # 40 px
    assert test["lpips"] == pytest.approx(10 ** (-test["psnr"] / 10), rel=0.1)  # this network measures squares
    assert test["lpips_input"] == "0..1"
    clsplat("evaluate", model, "--scene", tiny_scene, "--metrics", "psnr,mssim", expect=2)
    network.write_bytes(distance_network(inputs=("a", "b")))
    clsplat("evaluate", model, "--scene", tiny_scene, *more, expect=2)


def damaged(scene: Path, folder: Path) -> Path:
    shutil.copytree(scene, folder)
    return folder


def test_bad_data_ends_with_exit_code_3(tiny_scene, model, tmp_path):
    missing = damaged(tiny_scene, tmp_path / "missing image")
    (missing / "train" / "r_003.png").unlink()
    assert "r_003.png" in clsplat("run", "smoke", "--scene", missing, "--out", tmp_path / "a", expect=3).stderr
    text = damaged(tiny_scene, tmp_path / "bad image")
    (text / "train" / "r_003.png").write_text("not an image")
    assert "r_003.png" in clsplat("run", "smoke", "--scene", text, "--out", tmp_path / "b", expect=3).stderr
    nan = damaged(tiny_scene, tmp_path / "nan pose")
    frames = json.loads((nan / "transforms_train.json").read_text())
    frames["frames"][2]["transform_matrix"][0][3] = float("nan")
    (nan / "transforms_train.json").write_text(json.dumps(frames))
    clsplat("run", "smoke", "--scene", nan, "--out", tmp_path / "c", expect=3)
    (tmp_path / "empty").mkdir()
    clsplat("run", "smoke", "--scene", tmp_path / "empty", "--out", tmp_path / "d", expect=3)
    clsplat("run", "smoke", "--scene", tmp_path / "nowhere", "--out", tmp_path / "e", expect=3)
    clsplat("render", tiny_scene / "points3d.ply", "--scene", tiny_scene, "--out", tmp_path / "f", expect=3)
    assert not (tmp_path / "f").exists()
    for name in "abcde":
        assert not (tmp_path / name / "point_cloud.ply").exists()
        assert not (tmp_path / name / "metrics.json").exists()


def test_bad_settings_end_with_exit_code_2(tiny_scene, tmp_path):
    out = tmp_path / "out"
    assert "did you mean 'smoke'" in clsplat("run", "smokee", "--scene", tiny_scene, "--out", out, expect=2).stderr
    wrong = ["--set", "optimize.steps=30k"]
    assert "whole number" in clsplat("run", "smoke", "--scene", tiny_scene, "--out", out, *wrong, expect=2).stderr
    clsplat("run", "smoke", "--out", out, expect=2)
    clsplat("run", expect=2)
    clsplat("run", "smoke", "--nonsense", expect=2)
    clsplat("evaluate", tiny_scene / "points3d.ply", "--scene", tiny_scene, "--downscales", "a", expect=2)


def test_unknown_device_error_lists_devices(tiny_scene, tmp_path):
    done = clsplat("run", "smoke", "--scene", tiny_scene, "--out", tmp_path / "x", "--device", "no such chip", expect=4)
    assert "no device matches 'no such chip'; available: " in done.stderr


def test_output_that_cannot_be_written(tiny_scene, tmp_path):
    (tmp_path / "file").write_text("in the way")
    clsplat("run", "smoke", "--scene", tiny_scene, "--out", tmp_path / "file" / "run", expect=7)
    clsplat("run", "smoke", "--scene", tiny_scene, "--out", "/proc/clsplat", expect=7)
    assert (tmp_path / "file").read_text() == "in the way"


@pytest.mark.parametrize("pipeline", ["splat", "micro_splatting"])
def test_bench_times_a_point_cloud_and_counts_memory(tiny_scene, tmp_path, pipeline):
    cloud = tiny_scene / "points3d.ply"
    options = ("--scenes", "", "--model", cloud, "--scene", tiny_scene, "--repeats", "2", "--json")
    done = clsplat("bench", *options, "--pipeline", pipeline)
    actual = json.loads(done.stdout)["scenes"]["points3d"]
    assert "update" in actual["stages"]
    assert "other" not in actual["stages"]
    (tmp_path / "bench.json").write_text(done.stdout)
    again = ("bench", *options, "--against", tmp_path / "bench.json", "--pipeline")
    if pipeline == "splat":
        assert json.loads(clsplat(*again, pipeline).stdout)["against"]["scenes"]["points3d"] == actual
    refused = clsplat(*again, "absgs", expect=2)
    assert f"expected the pipeline 'absgs', got '{pipeline}'" in refused.stderr
    assert actual["work"]["gaussians"] > 100
    assert set(actual["floors"]) <= set(actual["stages"])
    assert 0 < actual["memory"] < 2 * actual["planned"]
