"""`clsplat convert` and `clsplat check MODEL`."""

import gzip
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import clsplat
from clsplat.cli import app
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.files import check_not_run_file
from clsplat.core.harmonics import basis
from clsplat.formats.ply import write_ply
from clsplat.formats.splats import flip_axes, inverse_opacities, opacities
from clsplat.formats.table import CODECS, detect, model_bytes, read, write
from clsplat.gaussians.conversion import parse_transform
from clsplat.gaussians.mixture import masses
from clsplat.gaussians.model import Rendering, load
from clsplat.gaussians.validate import examine, format_report, verdict
from clsplat.viewer.packing import pack
from tests.support.models import splats


@pytest.fixture
def source(tmp_path, rng):
    write(tmp_path / "a.ply", splats(rng, 100))
    return tmp_path / "a.ply"


@pytest.mark.parametrize("name", ["b.spz", "b.sog", "b.glb", "b.splat", "b.usda", "b.usdz", "f/meta.json"])
def test_file_suffix_selects_the_format(name, source, tmp_path):
    done = clsplat.convert(source, tmp_path / name)
    assert done["gaussians"] == 100
    assert done["bytes"] > 0
    assert done["bytes_read"] == source.stat().st_size
    assert len(clsplat.load(tmp_path / name)) == 100
    assert detect(tmp_path / name).name == done["format"]


def test_only_files_of_no_run_are_replaced(few_steps, tmp_path):
    run = shutil.copytree(few_steps, tmp_path / "run")
    (tmp_path / "pipeline.yaml").write_text("of a project")
    for place in (run / "web.spz", tmp_path / "out" / "web.spz"):
        for _ in range(2):
            clsplat.convert(run, place)
    for name in ("report.html", "metrics.json"):
        assert (run / name).is_file()
        with pytest.raises(ConfigError, match="is a file of a run; use another name"):
            check_not_run_file(run / name)


def test_convert_replaces_no_file_of_a_run(source, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "status.json").write_text("{}")
    (run / "point_cloud.ply").write_text("trained")
    with pytest.raises(ConfigError, match=r"point_cloud\.ply: is a file of a run; use another name"):
        clsplat.convert(source, run / "point_cloud.ply")
    assert (run / "point_cloud.ply").read_text() == "trained"
    assert clsplat.convert(source, run / "new.spz")["gaussians"] == 100


def test_merged_model_has_the_highest_sh_degree(source, tmp_path, rng):
    write(tmp_path / "b.glb", splats(rng, 30, 1))
    done = clsplat.convert([source, tmp_path / "b.glb"], tmp_path / "c.ply")
    pipeline = load(tmp_path / "c.ply")
    assert (done["gaussians"], pipeline.sh_degree) == (130, 3)
    assert not pipeline.sh_rest[100:, 9:].any()
    np.testing.assert_array_equal(pipeline.means[:100], load(source).means)


def test_merging_reports_each_dropped_setting(tmp_path, rng, caplog):
    said = [{"near": 0.2}, {"near": 5.0, "background": "white", "screen_variance": 0.1, "alpha": "mask"}, {"near": 0.2}]
    for name, numbers in zip("abc", said, strict=True):
        write(tmp_path / f"{name}.ply", replace(splats(rng, 10), rendering=numbers))
    a, b, c = (tmp_path / f"{name}.ply" for name in "abc")
    clsplat.convert([a, b, c], tmp_path / "d.ply")
    assert caplog.messages == [
        f"{b}: has near = 5.0, screen_variance = 0.1, background = white, alpha = mask; the values of {a} are used"
    ]
    caplog.clear()
    clsplat.convert([b, a], tmp_path / "d.ply")
    assert (
        "has near = 0.2, screen_variance = 0.3, background = not set, alpha = transparency; the values of"
        in caplog.text
    )


EXTREME = {
    "logits": {"logit_opacity": 800},
    "logits and a world filter": {"logit_opacity": 800, "filter_variance": 0.01},
    "scales and a world filter": {"log_scales": 500, "filter_variance": 0.01},
    "scales": {"log_scales": 120},
    "large scales": {"log_scales": 9e14},
}


@pytest.mark.parametrize("name", EXTREME)
@pytest.mark.filterwarnings("error")
def test_extreme_values_raise_no_numpy_warnings(name, tmp_path, rng):
    first = splats(rng, 40, 1)
    for table, value in EXTREME[name].items():
        if table == "filter_variance":
            first.parameters[table] = np.full((40, 1), value, np.float32)
        else:
            first.parameters[table][:10], first.parameters[table][10:20] = value, -value
    write(tmp_path / "a.ply", first)
    assert examine(tmp_path / "a.ply")["gaussians"] == 40
    for file in ("b.spz", "b.sog", "b.glb"):
        assert clsplat.convert(tmp_path / "a.ply", tmp_path / file)["gaussians"] == 40
    model = load(tmp_path / "a.ply")
    clsplat.convert(tmp_path / "a.ply", tmp_path / "b.ply", drop_below=0.1)
    assert np.isfinite(model.scales).all()
    assert model.opacities.min() >= 0
    assert pack(model).count > 0
    assert np.isfinite(
        masses({n: t.astype(np.float64) for n, t in first.parameters.items()}, lambda logs: logs[:, 0])
    ).all()


@pytest.mark.parametrize("text", ["scale=1e39", "scale=1e-200", "translate=0,1e300,0 rotate=0,20,1"])
@pytest.mark.filterwarnings("error")
def test_too_large_transform_is_named(text, source, tmp_path):
    with pytest.raises(ConfigError, match=rf"--transform '{text}': expected a scale from 1e-15 to 1e\+15"):
        clsplat.convert(source, tmp_path / "b.ply", transform=text)
    far = load(source)
    far.means[0] = 3e38
    for model in (far, replace(load(source), rendering=Rendering(near=5e14))):
        model.save(tmp_path / "far.ply")
        with pytest.raises(ConfigError, match="--transform: the result does not fit in a model file; use a smaller"):
            clsplat.convert(tmp_path / "far.ply", tmp_path / "b.ply", transform="scale=1e10")
    assert not (tmp_path / "b.ply").exists()


def test_faint_opacities_keep_their_digits():
    logit = np.array([-800, -80, -40, 0, 40, 800], np.float32)
    expected = [0, np.exp(-80.0), np.exp(-40.0), 0.5, 1, 1]
    np.testing.assert_allclose(1 / inverse_opacities(logit), expected, rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(opacities(logit), expected, atol=1e-16)


def test_mip_model_is_not_merged_with_a_plain_one(source, tmp_path, rng):
    write(tmp_path / "b.ply", splats(rng, 30, 1, "mip"))
    with pytest.raises(DataError, match=r"b\.ply: is a mip model, .*a\.ply is a plain model; merge only"):
        clsplat.convert([source, tmp_path / "b.ply"], tmp_path / "c.ply")


def test_transform_rotates_harmonics_with_directions(source, tmp_path, rng):
    """The color toward a turned direction is that of the source toward the direction."""
    text = "rotate=20,-50,130 scale=3 translate=1,2,3"
    clsplat.convert(source, tmp_path / "b.ply", transform=text)
    before, after = load(source), load(tmp_path / "b.ply")
    turn = Rotation.from_euler("xyz", [20, -50, 130], degrees=True).as_matrix()
    directions = rng.normal(size=(10, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    old = np.einsum("dk,nkc->ndc", basis(directions), before.sh_rest.reshape(100, 15, 3))
    new = np.einsum("dk,nkc->ndc", basis(directions @ turn.T), after.sh_rest.reshape(100, 15, 3))
    np.testing.assert_allclose(new, old, atol=1e-5)
    np.testing.assert_allclose(after.means, 3 * before.means @ turn.T + [1, 2, 3], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(after.log_scales, before.log_scales + np.log(3), atol=1e-5)


def test_transform_is_a_matrix_or_steps_from_left_to_right():
    words = parse_transform("translate=1,0,0 rotate=0,0,90 scale=2")
    np.testing.assert_allclose(words @ [0, 0, 0, 1], [0, 2, 0, 1], atol=1e-12)
    rows = ",".join(str(value) for value in words.ravel())
    np.testing.assert_allclose(parse_transform(rows), words)
    np.testing.assert_allclose(parse_transform("1,0,0,5,0,1,0,6,0,0,1,7")[:3, 3], [5, 6, 7])


WRONG = {
    "transform": (
        ["scale=0", "rotate=1", "turn=1,2,3", "1,2,3", "scale=nan", "2,0,0,0,0,1,0,0,0,0,1,0"],
        "",
    ),
    "crop": (["1,2,3", "0,0,0,-1,1,1", "a", "0,0,0,1,1,nan"], "expected x0,y0,z0"),
}


@pytest.mark.parametrize(("option", "text"), [(option, text) for option, (texts, _) in WRONG.items() for text in texts])
def test_invalid_option_is_refused_before_writing(option, text, source, tmp_path):
    with pytest.raises(ConfigError, match=WRONG[option][1] or "--transform .*expected"):
        clsplat.convert(source, tmp_path / "b.spz", **{option: text})
    assert not (tmp_path / "b.spz").exists()


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        (
            "b.glb",
            {"quality": "small"},
            r"b\.glb: --quality is only for SPZ and SOG; use a name that ends in \.spz or ",
        ),
        ("b.compressed.ply", {}, "compressed PLY can be read but not written"),
        ("b.xyz", {}, r"no format matches the name 'b.xyz'; use a name that ends in \.ply, "),
        ("b.ply", {"sh_degree": 4}, "expected 0 to 3"),
        ("b.spz", {"quality": "best"}, "--quality 'best': expected one of small, balanced, high"),
    ],
)
def test_option_without_meaning_is_refused(name, options, words, source, tmp_path):
    with pytest.raises(ConfigError, match=words):
        clsplat.convert(source, tmp_path / name, **options)
    assert not (tmp_path / name).exists()


def test_inputs_are_not_overwritten(source, tmp_path, rng):
    write(tmp_path / "b.ply", splats(rng, 30))
    (tmp_path / "link.ply").symlink_to(source)
    clsplat.convert(source, tmp_path / "f" / "meta.json", sh_degree=0)
    data = source.read_bytes()
    for sources, out in [
        (source, source),
        (source, tmp_path / "f" / ".." / "a.ply"),
        (tmp_path / "link.ply", source),
        (source, tmp_path / "link.ply"),
        ([tmp_path / "b.ply", source], source),
        (tmp_path / "f", tmp_path / "f" / "meta.json"),
    ]:
        with pytest.raises(ConfigError, match="is one of the input files; use another name"):
            clsplat.convert(sources, out, sh_degree=0)
    assert source.read_bytes() == data
    assert (tmp_path / "link.ply").is_symlink()


def test_crop_and_min_opacity_filter_gaussians(source, tmp_path):
    model = load(source)
    box = (-1.0, -1.0, -1.0, 1.0, 2.0, 3.0)
    clsplat.convert(source, tmp_path / "b.ply", crop=box, drop_below=0.3, sh_degree=1)
    pipeline = load(tmp_path / "b.ply")
    inside = ((model.means >= box[:3]) & (model.means <= box[3:])).all(axis=1) & (model.opacities >= 0.3)
    np.testing.assert_array_equal(pipeline.means, model.means[inside])
    np.testing.assert_array_equal(pipeline.sh_rest, model.sh_rest[inside, :9])
    assert 0 < len(pipeline) < 100
    with pytest.raises(DataError, match="none of 100 Gaussians is left"):
        clsplat.convert(source, tmp_path / "c.ply", crop="50,50,50,51,51,51")


def test_spz_with_ply_axes_is_rotated(source, tmp_path):
    upside_down = {"transform": "rotate=180,0,0", "quality": "high"}
    clsplat.convert(source, tmp_path / "ply_axes.spz", **upside_down)
    expected, pipeline = load(source), load(tmp_path / "ply_axes.spz")
    np.testing.assert_allclose(np.sort(-pipeline.means[:, 1]), np.sort(expected.means[:, 1]), atol=1e-3)
    clsplat.convert(tmp_path / "ply_axes.spz", tmp_path / "right.ply", transform="rotate=180,0,0")
    right = load(tmp_path / "right.ply").tables()
    for name, table in flip_axes(pipeline.tables()).items():
        if name != "quats":  # a rotation names its axes differently
            np.testing.assert_allclose(right[name], table, atol=1e-5, err_msg=name)


def test_nonfinite_gaussians_are_dropped(tmp_path, rng, caplog):
    bad = splats(rng, 20)
    bad.parameters["means"][3, 1], bad.parameters["sh_rest"][7, 0] = np.nan, np.inf
    write_ply(tmp_path / "a.ply", bad.parameters, {})
    with pytest.raises(DataError, match=r"means, sh_rest have values that are not finite; .* `clsplat convert`"):
        load(tmp_path / "a.ply")
    assert clsplat.convert(tmp_path / "a.ply", tmp_path / "b.spz")["gaussians"] == 18
    assert "dropped 2 Gaussians" in caplog.text
    with pytest.raises(DataError, match="2 Gaussians have values that are not finite, which GLB cannot store"):
        write(tmp_path / "b.glb", bad)


def test_gaussians_without_rotation_are_dropped(tmp_path, rng, caplog):
    bad = splats(rng, 20)
    bad.parameters["quats"][3:5] = 0
    write_ply(tmp_path / "a.ply", bad.parameters, {})
    assert clsplat.convert(tmp_path / "a.ply", tmp_path / "b.ply")["gaussians"] == 18
    assert "dropped 2 Gaussians with quaternions of length 0" in caplog.text


@pytest.mark.parametrize(("table", "value"), [("log_scales", 3e38), ("sh_base", -3e38), ("sh_rest", 1e16)])
def test_values_beyond_any_codebook_are_refused_or_dropped(table, value, tmp_path, rng, caplog):
    large = splats(rng, 20, 1)
    large.parameters[table][3:5, 1] = value
    write_ply(tmp_path / "a.ply", large.parameters, {})
    told = f"2 of 20 Gaussians have {table} beyond 1e+15"
    (tmp_path / "out").mkdir()
    for place in ("a.sog", "meta.json"):
        with pytest.raises(DataError, match=re.escape(f"{told}; SOG cannot store these: `clsplat convert MODEL OTHER")):
            write(tmp_path / "out" / place, large)
    assert list((tmp_path / "out").iterdir()) == []
    result = clsplat.check(tmp_path / "a.ply")
    assert told in result["findings"]
    json.dumps(result, allow_nan=False)
    assert clsplat.convert(tmp_path / "a.ply", tmp_path / "b.sog")["gaussians"] == 18
    assert f"{told}; they are dropped" in caplog.text
    assert len(load(tmp_path / "b.sog")) == 18


def test_nonfinite_tables_are_not_reported_as_too_large(tmp_path, rng, caplog):
    large = splats(rng, 1200)
    large.parameters["sh_base"][:1100, 1] = 1e20
    large.parameters["log_scales"][7] = np.inf
    write_ply(tmp_path / "a.ply", large.parameters, {})
    assert clsplat.convert(tmp_path / "a.ply", tmp_path / "b.ply")["gaussians"] == 100
    assert "1,100 of 1,200 Gaussians have sh_base beyond 1e+15; they are dropped" in caplog.text


@pytest.mark.parametrize("name", ["b.ply", "b.sog", "b.glb"])
def test_unreadable_setting_is_not_written(name, source, tmp_path):
    with pytest.raises(DataError, match=r"says near = .*; expected a number from 0 to 1e\+15"):
        write(tmp_path / name, replace(read(source), rendering={"near": 2e16}))
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize("number", ["NaN", "1e999"])
def test_nonfinite_settings_in_a_comment_are_refused(number, source, tmp_path):
    write(tmp_path / "a.ply", replace(read(source), rendering={"note": 5}))
    (tmp_path / "a.ply").write_bytes(
        (tmp_path / "a.ply").read_bytes().replace(b'{"note": 5}', f'{{"note": {number}}}'.encode())
    )
    with pytest.raises(DataError, match=r"a\.ply: its comment is not valid JSON"):
        clsplat.convert(tmp_path / "a.ply", tmp_path / "b.glb")


def test_sizes_are_human_readable(tmp_path, rng):
    same = splats(rng, 300).rows(np.zeros(300, int))
    write(tmp_path / "a.spz", same)
    done = CliRunner().invoke(app, ["convert", str(tmp_path / "a.spz"), str(tmp_path / "b.ply")])
    assert done.exit_code == 0, done.output
    assert re.search(r" MB, \d{1,3},\d{3}\.\d % of the input", done.output), done.output


def test_run_folder_is_read_as_its_model(source, tmp_path):
    (tmp_path / "point_cloud.ply").write_bytes(source.read_bytes())
    (tmp_path / "log.txt").write_bytes(bytes(5000))
    assert clsplat.convert(tmp_path, tmp_path / "b.spz")["bytes_read"] == source.stat().st_size
    with pytest.raises(ConfigError, match="is one of the input files"):
        clsplat.convert(tmp_path, tmp_path / "point_cloud.ply")


def test_check_describes_a_model(source, tmp_path):
    clsplat.convert(source, tmp_path / "b.spz")
    result = clsplat.check(tmp_path / "b.spz")
    assert (result["format"], result["gaussians"], result["sh_degree"], result["mode"]) == ("SPZ", 100, 3, "default")
    model = load(tmp_path / "b.spz")
    np.testing.assert_allclose(result["bounds"], [model.means.min(axis=0), model.means.max(axis=0)])
    assert result["valid"]
    assert verdict(result) == f"{tmp_path / 'b.spz'}: valid"
    assert "SPZ, 100 Gaussians, SH degree 3" in format_report(result)
    json.dumps(result, allow_nan=False)


def test_missing_model_and_pipeline_file_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"a\.spz: cannot be read \(No such file or directory\)"):
        clsplat.check(tmp_path / "a.spz")
    assert "stages" in clsplat.check("smoke")


def test_model_size_counts_only_its_files(few_steps, source, tmp_path):
    size = (few_steps / "point_cloud.ply").stat().st_size
    folder = tmp_path / "f" / "meta.json"
    assert clsplat.convert(few_steps, tmp_path / "b.ply")["bytes_read"] == size
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "film.webp").write_bytes(bytes(10**6))
    written = clsplat.convert(source, folder)["bytes"]
    assert written == sum(file.stat().st_size for file in (tmp_path / "f").iterdir()) - 10**6
    for place in (folder, tmp_path / "f"):
        assert clsplat.convert(place, tmp_path / "b.ply")["bytes_read"] == written == model_bytes(place)


def test_file_name_is_printed_unchanged(source, tmp_path):
    write(tmp_path / "not_finite_no_rotation.ply", read(source))
    result = clsplat.check(tmp_path / "not_finite_no_rotation.ply")
    assert format_report(result).startswith(f"{tmp_path / 'not_finite_no_rotation.ply'}: PLY")
    assert "0 not finite, 0 without rotation, 0 flat, " in format_report(result)


def test_check_counts_invisible_gaussians(tmp_path, rng):
    odd = splats(rng, 40)
    p = odd.parameters
    p["logit_opacity"][:] = np.linspace(-3, 3, 40)[:, None]
    p["means"][0] = np.nan
    p["log_scales"][1, 2] = -20
    p["logit_opacity"][2:5] = -30
    p["quats"][5] = 0
    write_ply(tmp_path / "a.ply", p, {})
    result = clsplat.check(tmp_path / "a.ply")
    assert result["degenerate"] == {"not_finite": 1, "no_rotation": 1, "flat": 1, "invisible": 3}
    assert not result["valid"]
    assert "1 of 40 Gaussians have values that are not finite; 1 quaternions have length 0" in verdict(result)
    json.dumps(result, allow_nan=False)


@pytest.mark.parametrize(
    ("table", "values", "words"),
    [
        ("log_scales", (0.5, 3.0), "not logarithmic"),
        ("logit_opacity", (0.01, 0.99), "not logits"),
        ("sh_base", (0.1, 0.9), "not SH coefficients"),
    ],
)
def test_check_detects_activated_values(table, values, words, tmp_path, rng):
    model = splats(rng, 60)
    assert not [text for text in checked(tmp_path, model)["findings"] if words in text]
    model.parameters[table][:] = rng.uniform(*values, model.parameters[table].shape)
    assert [text for text in checked(tmp_path, model)["findings"] if words in text]


@pytest.mark.parametrize("name", ["a.splat", "a.spz", "a.sog", "a.glb", "a.usda"])
def test_formats_without_empty_models_refuse_them(name, tmp_path, rng):
    with pytest.raises(DataError, match="the model has no Gaussians; only a PLY can be empty"):
        write(tmp_path / name, splats(rng, 0))
    write(tmp_path / "a.ply", splats(rng, 0))
    assert verdict(clsplat.check(tmp_path / "a.ply")).endswith("it has no Gaussians; export it again")


def test_bright_colors_are_coefficients(tmp_path, rng):
    """All above gray, but beyond what a color can be."""
    model = splats(rng, 60)
    model.parameters["sh_base"][:] = rng.uniform(0.02, 1.7, (60, 3))
    assert not [text for text in checked(tmp_path, model)["findings"] if "colors" in text]


def checked(tmp_path, model):
    write_ply(tmp_path / "a.ply", model.parameters, {})
    return clsplat.check(tmp_path / "a.ply")


PIPELINE = """name: formats
scene: {path: SCENE}
stages:
  - init: INIT
  - optimize: {steps: 1, losses: [l1]}
  - export: {file: FILE}
"""


@pytest.mark.parametrize("name", ["a.spz", "a.sog"])
def test_run_starts_from_any_format_and_exports_any(name, tiny_scene, tmp_path, rng, caplog):
    caplog.set_level("INFO")
    out = tmp_path / "run"
    write(tmp_path / name, splats(rng, 40, 1))
    text = PIPELINE.replace("SCENE", str(tiny_scene)).replace("FILE", name)
    (tmp_path / "p.yaml").write_text(text.replace("INIT", f"{{source: model, file: '{tmp_path / name}'}}"))
    clsplat.run(tmp_path / "p.yaml", out=out)
    assert f"{out / name}: axes" not in caplog.text  # which it wrote itself
    pipeline = load(out / name)
    assert len(pipeline) == 40
    assert detect(out / name).name == detect(tmp_path / name).name
    assert clsplat.check(out)["whole"]
    assert clsplat.render_views(out / name, tiny_scene, tmp_path / "views") == 2


def test_folder_of_images_is_a_model(source, tmp_path):
    clsplat.convert(source, tmp_path / "f" / "meta.json", sh_degree=0)
    assert clsplat.check(tmp_path / "f")["format"] == "SOG"
    assert len(read(tmp_path / "f")) == 100
    assert len(load(tmp_path / "f")) == 100


def test_formats_page_lists_every_format():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
    for codec in CODECS:
        row = f"| {codec.name} | {', '.join(f'`{ending}`' for ending in codec.endings)} |"
        assert row in page, row


def test_infinite_opacities_and_flat_scales_are_limits(tmp_path, rng, caplog):
    """NaN, and infinite scales, are not."""
    first = splats(rng, 6, 0)
    first.parameters["logit_opacity"][:2, 0] = np.inf, -np.inf
    first.parameters["log_scales"][1:3, 0] = -np.inf
    write(tmp_path / "a.ply", first)
    assert examine(tmp_path / "a.ply")["valid"]
    assert [text for text in caplog.messages if "3 Gaussians have an opacity of 0 or 1, or a scale of 0" in text]
    assert clsplat.convert(tmp_path / "a.ply", tmp_path / "b.glb")["gaussians"] == 6
    pipeline = load(tmp_path / "b.glb")
    np.testing.assert_allclose(pipeline.opacities[:2], [1, 0], atol=2e-6)
    np.testing.assert_allclose(pipeline.scales[1:3, 0], 1e-6, rtol=1e-5)
    first.parameters["log_scales"][3] = np.inf
    first.parameters["logit_opacity"][4] = np.nan
    write(tmp_path / "a.ply", first)
    with pytest.raises(DataError, match="log_scales, logit_opacity have values that are not finite"):
        load(tmp_path / "a.ply")
    assert clsplat.convert(tmp_path / "a.ply", tmp_path / "b.ply")["gaussians"] == 4


def test_empty_result_is_an_error(tmp_path, rng):
    first = splats(rng, 6, 0)
    write(tmp_path / "a.ply", first.rows(slice(0)))
    first.parameters["means"][:] = np.nan
    write(tmp_path / "b.ply", first)
    for name in ("a.ply", "b.ply"):
        with pytest.raises(DataError, match="the model has no Gaussians, or none with valid values"):
            clsplat.convert(tmp_path / name, tmp_path / "c.ply")
    assert not (tmp_path / "c.ply").exists()


FOREIGN = {
    "lfs.ply": (b"version https://git-lfs.github.com/spec/v1\n", "a Git LFS pointer; fetch the content with `git lfs"),
    "page.spz": (b"\n<!DOCTYPE html>", "the file is a web page; download"),
    "page.html": (b"<html>", "the file is a web page; download"),
    "empty.glb": (b"", "the file is empty; copy"),
    "a.ply.gz": (gzip.compress(b"ply\nformat ascii 1.0\nend_header\n"), "the file is compressed with gzip; unpack"),
    "a.b3dm": (b"b3dm\1\0\0\0", "unknown model format"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_check_and_convert_give_the_same_cause(name, tmp_path):
    content, words = FOREIGN[name]
    (tmp_path / name).write_bytes(content)
    for command in (clsplat.check, lambda file: clsplat.convert(file, tmp_path / "out.ply")):
        with pytest.raises(DataError, match=f"{name}: .*{words}"):
            command(tmp_path / name)


def test_model_file_is_refused_as_a_pipeline(tmp_path, rng):
    write(tmp_path / "meta.json", splats(rng, 6, 0))
    (tmp_path / "meta.json").rename(tmp_path / "Scene.JSON")
    assert clsplat.check(tmp_path / "Scene.JSON")["format"] == "SOG"
    assert clsplat.convert(tmp_path / "Scene.JSON", tmp_path / "a.ply")["gaussians"] == 6
    for name in ("a.gltf", "A.SPLAT", "b.Spz", "c.usdz", "d.USDA", "e.ksplat", "lod-meta.json", "f.compressed.ply"):
        (tmp_path / name).write_text("no model")
        with pytest.raises(DataError, match=name):
            clsplat.check(tmp_path / name)
        with pytest.raises(DataError, match=f"{name}: cannot be read|no/{name}: unknown model format"):
            clsplat.check(tmp_path / "no" / name)
