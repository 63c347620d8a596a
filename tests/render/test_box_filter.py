"""The screen filter `box`: settings, model files, conflicts, and a run."""

import json
import re
from dataclasses import replace
from inspect import getsource

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.resources import resource_dir
from clsplat.core.settings import variants
from clsplat.density.statistics import Statistic
from clsplat.formats.table import read, write
from clsplat.gaussians.model import Model, Rendering, load
from clsplat.gaussians.validate import examine
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.packing import pack
from clsplat.viewer.page import Page
from tests.support.models import splats
from tests.support.runs import train

BOX = "model.screen_filter=box"


def boxed(rng: np.random.Generator, count: int = 50) -> Model:
    return Model(**splats(rng, count).parameters, rendering=Rendering(0.05, 1 / 12, 1.0, "white", pixel_box=1.0))


def test_box_filter_has_no_settings():
    settings = load_pipeline("splat_7k", [BOX]).settings.model
    assert settings.screen_filter.pixel_box
    assert settings.screen_filter.variance == 1 / 12
    with pytest.raises(ConfigError, match=r"'box' has a fixed variance of .* `screen_filter: box`"):
        load_pipeline("splat_7k", ["model.screen_filter.type=box"])


def test_resolved_file_names_the_box_filter(tmp_path):
    pipeline = load_pipeline("box_7k")
    (tmp_path / "again.yaml").write_text(pipeline.text())
    assert load_pipeline(tmp_path / "again.yaml").settings.model == pipeline.settings.model


@pytest.mark.parametrize(("name", "rule"), [("steep_7k", "split_steepest"), ("auto_7k", "clone")])
def test_rule_that_reads_conics_is_refused(name, rule):
    words = rf"stages\[1\]\.optimize\..*: '{rule}' cannot be .*box \(model.screen_filter\): .*another screen filter"
    with pytest.raises(ConfigError, match=words):
        load_pipeline(name, [BOX])


def test_statistics_declare_that_they_read_conics():
    reading = {
        name
        for path in resource_dir("cl_kernels").glob("*.cl")
        for name, body in re.findall(r"\nvoid (accumulate_\w+)\((.*?)\n}", path.read_text(), re.S)
        if "SPLAT_XX" in body
    }
    assert reading == {"accumulate_gain", "accumulate_splitting"}
    kinds = [kind for kind in variants(Statistic).values() if any(name in getsource(kind) for name in reading)]
    assert len(kinds) == 2
    assert all("box" in kind.conflicts for kind in kinds)


@pytest.mark.parametrize("name", ["a.ply", "a.sog", "a.glb"])
def test_formats_with_settings_keep_the_box_filter(name, rng, tmp_path, caplog):
    boxed(rng).save(tmp_path / name)
    actual = load(tmp_path / name).rendering
    assert (actual.pixel_box, actual.compensate, actual.screen_variance) == (1.0, 1.0, 1 / 12)
    assert read(tmp_path / name).mode == "mip", "the nearest for programs that know no box"
    assert not caplog.messages


@pytest.mark.parametrize("name", ["a.spz", "a.splat", "a.usda"])
def test_other_formats_report_the_lost_box_filter(name, rng, tmp_path, caplog):
    boxed(rng).save(tmp_path / name)
    assert "pixel_box = 1.0" in caplog.text


def test_files_of_other_models_do_not_name_the_box_filter(rng, tmp_path):
    replace(boxed(rng), rendering=Rendering(0.05, 0.1, 1.0)).save(tmp_path / "a.ply")
    assert b"pixel_box" not in (tmp_path / "a.ply").read_bytes()[:2000]


def test_invalid_filter_in_a_file_is_refused(rng, tmp_path):
    numbers = {"near": 0.2, "pixel_box": -1}
    write(tmp_path / "a.ply", replace(splats(rng, 5), rendering={"near": 0.2}))
    data = (tmp_path / "a.ply").read_bytes().replace(b'{"near": 0.2}', json.dumps(numbers).encode())
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(DataError, match=r"pixel_box = -1; expected a number from 0"):
        load(tmp_path / "a.ply")


def test_box_model_is_not_merged_with_another(rng, tmp_path):
    boxed(rng).save(tmp_path / "a.ply")
    replace(boxed(rng), rendering=Rendering(0.05, 0.1, 1.0)).save(tmp_path / "b.ply")
    with pytest.raises(DataError, match=r"is a mip model, but .*a.ply is a model with a pixel box filter; merge"):
        clsplat.convert([tmp_path / "a.ply", tmp_path / "b.ply"], tmp_path / "c.ply")


def test_check_and_viewer_page_name_the_box_filter(rng, tmp_path):
    boxed(rng).save(tmp_path / "a.ply")
    assert examine(tmp_path / "a.ply")["mode"] == "box"
    header = pack(boxed(rng)).header
    assert (header["variance"], header["compensate"], header["box"]) == (1 / 12, 1.0, 1)
    assert "box" not in pack(replace(boxed(rng), rendering=Rendering())).header
    stand = Viewpoint.from_points(boxed(rng).means, (), None)
    text = Page("a", {"a": pack(boxed(rng))}, stand).text()
    assert "pixel box, drawn here as a blur of 0.0833333 px², normalized" in text


def test_reloaded_model_renders_like_the_run(tiny_scene, tmp_path):
    run = train(tiny_scene, tmp_path / "run", "optimize.steps=12", pipeline="box_7k")
    told = json.loads((tmp_path / "run" / "metrics.json").read_text())["test"]["1"]["psnr"]
    again = clsplat.evaluate(tmp_path / "run" / "point_cloud.ply", scene=tiny_scene)
    assert again["test"]["1"]["psnr"] == pytest.approx(told, abs=1e-3)
    plain = load(tmp_path / "run" / "point_cloud.ply")
    assert plain.rendering.pixel_box == 1
    replace(plain, rendering=replace(plain.rendering, pixel_box=0.0)).save(tmp_path / "blur.ply")
    blur = clsplat.evaluate(tmp_path / "blur.ply", scene=tiny_scene)["test"]["1"]["psnr"]
    assert abs(blur - told) > 1e-4, "another filter draws another picture"
    assert run.model.pixel_box == 1
