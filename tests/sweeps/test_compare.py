"""Comparisons of constructed run folders: rows, differences, output, and refusals."""

import base64
import html
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import ClsplatError, ConfigError, DataError
from clsplat.pipeline.loading import load
from clsplat.runs.results import RunFolder
from clsplat.scene.camera import Lens
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.scene.view import load_image
from clsplat.sweeps.compare import crops
from clsplat.sweeps.compare.comparison import RunComparison, differing_keys, flatten, read_published
from clsplat.sweeps.compare.page import write_comparison
from tests.support.commands import clsplat
from tests.support.html_page import HOSTILE, Page

pytestmark = pytest.mark.slow

WHITE = (1.0, 1.0, 1.0)  # behind the photographs of a Blender scene


@pytest.fixture
def make_run(tiny_scene, tmp_path):
    """Write the folder of a run that never was; its renders are the photographs, darker by `error` gray levels."""

    def make(name: str, *overrides: str, psnr: float = 20.0, error: int = 10, **changes: object) -> Path:
        folder = tmp_path / name
        pipeline = load("smoke", [f"scene.path='{tiny_scene}'", *overrides])
        folder.mkdir()
        (folder / "pipeline.yaml").write_text(pipeline.text())
        scale = pipeline.settings.scene.downscale
        averages = {"psnr": psnr, "ssim": psnr / 30, "lpips": None, "lpips_reason": "no ONNX file given", "views": 2}
        metrics = {
            "test": {f"{scale:g}": averages, f"{2 * scale:g}": {**averages, "psnr": psnr + 1}},
            "train": {},
            "gaussians": 1000,
            "steps": 50,
            "train_seconds": 61.0,
            "seed": pipeline.settings.seed,
            "device": "a device",
            "pipeline": "smoke",
            **changes,
        }
        (folder / "metrics.json").write_text(json.dumps(metrics))
        lines = [{"step": s, "kind": "train", "psnr": psnr - 50 / s, "gaussians": 900 + s} for s in (10, 20, 50)]
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        for view in read_scene(tiny_scene).split("test"):
            image = load_image(view, WHITE)
            image[20:, 20:] = np.clip(image[20:, 20:].astype(int) - error, 0, 255)
            write_image(folder / "renders" / f"{view.name}.png", image)
        return folder

    return make


def page_of(tmp_path: Path, *folders: Path) -> str:
    assert write_comparison(folders, tmp_path / "page.html") == len(folders)
    return (tmp_path / "page.html").read_text()


def test_seeds_are_one_row_with_mean_and_deviation(make_run, tmp_path):
    seeds = [make_run(f"seed{i}", f"seed={i}", psnr=20.0 + i) for i in range(3)]
    other = make_run("other", "init.opacity=0.3", psnr=24.0)
    comparison = RunComparison.read([*seeds, other])
    (rows,) = comparison.scenes.values()
    assert [len(row.runs) for row in rows] == [3, 1]
    assert [row.variant.letter for row in rows] == ["A", "B"]
    assert [row.variant.name for row in rows] == ["smoke, init opacity 0.1", "smoke, init opacity 0.3"]
    page = page_of(tmp_path, *seeds, other)
    assert "<td>21.00 <small>± 1.00</small>" in page  # of 20, 21, 22
    assert '<td class="best">24.00</td>' in page, "the best is bold, one run has no deviation"
    assert "<td>22.00 <small>± 1.00</small>" in page, "at half size, where each is one higher"
    assert page.count("<polyline") == 4 + 4 + 2 + 2, "PSNR and Gaussians by run, PSNR and SSIM by size and variant"
    assert "LPIPS" not in page, "it was not measured"


def test_costs_are_shown_if_recorded(make_run, tmp_path):
    def with_records(folder: Path, *lines: dict[str, object]) -> Path:
        (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        return folder

    trained = [{"step": s, "kind": "train", "psnr": 9.0, "gaussians": 9, "cpu_seconds": s / 5} for s in (10, 50)]
    tested = [{"step": s, "kind": "evaluate", "split": "test", "downscale": 1.0, "psnr": 20.0 + s} for s in (30, 50)]
    new = with_records(make_run("new", cpu_seconds=1234.4, device_memory=56_700_000), *trained, *tested)
    old = with_records(make_run("old", "seed=1"), *({**line, "cpu_seconds": None} for line in trained), *tested)
    page = page_of(tmp_path, new)
    assert "CPU seconds</th>" in page
    assert "<td>1,234</td>" in page
    assert "<td>57</td>" in page
    assert "test PSNR over CPU seconds of training, dB" in page
    run = RunFolder.read(new)
    assert run.over_cpu_seconds(run.curve("evaluate", "psnr")) == [(6.0, 50.0), (10.0, 70.0)], "between two reports"
    alone = page_of(tmp_path, old)
    assert "CPU seconds" not in alone
    assert "device memory" not in alone
    assert "<td>1,234</td>" in page_of(tmp_path, new, old), "the mean of those that have noted it"


PUBLISHED = Path(__file__).parents[2] / "examples/published/blender.yaml"


def test_published_results_are_separate_and_have_a_source(make_run, tmp_path):
    tables = read_published(PUBLISHED)
    for table in tables:
        assert list(table.rows) == ["Mip-NeRF", "3DGS", "3DGS + EWA", "Mip-Splatting"]
    run, other = make_run("run", psnr=20.0), make_run("other", "init.opacity=0.3", psnr=19.0)
    write_comparison([run, other], tmp_path / "page.html", published=tables)
    measured, published = (tmp_path / "page.html").read_text().split("Published, not run here")
    assert "<td>35.60</td>" in published, "with the digits of the others"
    assert "35.6" not in measured
    assert '<td class="best">20.00</td>' in measured, "figures of others are larger, and no part of the comparison"
    assert all(table.source.replace('"', "&#34;") in published for table in tables)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("a: 1", "unknown key 'a'"),
        ("tables: []", "tables: expected a list of at least 1"),
        ("- 1", "expected the key 'tables'"),
        (
            "tables: [{title: a, source: b, protocol: c, columns: [d], rows: {e: [1.0, 2.0]}}]",
            "expected 1 values of 'e'",
        ),
        (
            "tables: [{title: a, source: b, protocol: c, columns: [d], rows: {e: [null]}}]",
            "expected at least one value",
        ),
        ("tables: [{title: a, protocol: c, columns: [d], rows: {e: [1.0]}}]", "'source' is missing"),
    ],
)
def test_invalid_file_of_published_results_is_refused(text, complaint, tmp_path):
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(ConfigError, match=rf"p\.yaml:1: .*{complaint}"):
        read_published(tmp_path / "p.yaml")


def test_sizes_unseen_in_training_are_explained(make_run, tmp_path):
    assert "sizes are relative" not in page_of(tmp_path, make_run("whole"))
    halves = make_run("halves", "scene.downscale=2", "scene.levels=2")
    assert "sizes are relative to the original photos; trained at 1/2, 1/4" in page_of(tmp_path, halves)


def test_curves_of_runs_with_one_seed_are_named_by_folder(make_run, tmp_path):
    names = re.findall(r">(A [^<]+)</tspan>", page_of(tmp_path, make_run("first"), make_run("second")))
    assert set(names) == {"A first", "A second (dashed)"}
    seeds = re.findall(r">(A [^<]+)</tspan>", page_of(tmp_path, make_run("third", "seed=1"), tmp_path / "first"))
    assert set(seeds) == {"A seed 0", "A seed 1 (dashed)"}
    (tmp_path / "again").mkdir()
    shutil.copytree(tmp_path / "first", tmp_path / "again" / "first")
    alike = page_of(tmp_path, tmp_path / "first", tmp_path / "again" / "first")
    assert f">A {tmp_path}/first</tspan>" in alike
    assert f">A {tmp_path}/again/first (dashed)</tspan>" in alike
    assert "training PSNR over steps, mean of 5 views, dB" in alike


def test_each_scene_and_size_has_a_table(make_run, tiny_scene, tmp_path):
    shutil.copytree(tiny_scene, tmp_path / "second")
    first, two = make_run("one", psnr=20), make_run("two", f"scene.path='{tmp_path / 'second'}'", psnr=30)
    half = make_run("half", "scene.downscale=2", psnr=40)
    shutil.rmtree(half / "renders")
    comparison = RunComparison.read([first, two, half])
    assert list(comparison.scenes) == ["tiny", "second", "tiny at 1/2"]
    assert len(comparison.variants) == 1, "the scene does not make a variant"
    page = page_of(tmp_path, first, two, half)
    assert '<h2>Mean of 3 scenes</h2>\n<p class="sub">test views at the training size</p>' in page
    assert "<td>30.00" in page[: page.index("<h2>tiny</h2>")]
    assert page.count("No crops: ") == 1, "only the run without renders has none"


def test_differing_settings_are_matched_by_name():
    first = flatten(load("splat").resolved_settings())
    assert first["optimize.steps"] == "30000"
    assert first["optimize.densify.clone.gradient_above"] == "0.0002"
    assert first["optimize.reset_opacity#2.when_background"] == "white"
    assert first["optimize.dssim.weight"] == "0.2"
    two = flatten(load("splat", ["optimize.losses[0].weight=0.7", "optimize.densify.stop=900"]).resolved_settings())
    assert differing_keys([first, two]) == ["optimize.l1.weight", "optimize.densify.stop"]
    assert differing_keys([first, first]) == []
    short = flatten(load("smoke").resolved_settings())
    assert "optimize.densify.prune_large.start" in differing_keys([first, short]), "a rule that only one has"


def test_page_shows_only_differing_settings(make_run, tmp_path):
    page = page_of(tmp_path, make_run("a"), make_run("b", "optimize.densify.every=20"))
    table = page[page.index("Settings that differ (1)") : page.index("<h2>Runs")]
    rows = re.findall(r"<tr><td>(.*?)</td><td>(.*?)</td><td>(.*?)</td>", table)
    assert rows == [("optimize.densify.every", "10", "20")]


def names_of(*folders: Path) -> list[tuple[str, str]]:
    return [(variant.name, variant.folders) for variant in RunComparison.read(folders).variants]


def test_variants_are_named_in_words_and_by_folder(make_run):
    base, seed = make_run("base"), make_run("seed", "seed=1")
    without = make_run("without", "optimize.densify.rules=[clone, split]")
    names = names_of(base, seed, without)
    assert names == [
        ("smoke, with densify prune faint", "base, seed"),
        ("smoke, without densify prune faint", "without"),
    ]
    many = [make_run(f"run{i}", f"optimize.densify.every={10 + i}", f"init.opacity=0.{i + 1}") for i in range(2)]
    assert names_of(*many) == [
        ("smoke, init opacity 0.1, densify every 10", "run0"),
        ("smoke, init opacity 0.2, densify every 11", "run1"),
    ]


def test_decisions_about_photos_make_no_variant(make_run):
    """The same recipe on two scenes, whose photos lead to other settings."""
    decision = "{{key: optimize.during.1.every, value: {value}, reason: {value} photos}}"
    folders = []
    for value in (10, 20):
        folder = make_run(f"of{value}", f"optimize.densify.every={value}")
        file = folder / "pipeline.yaml"
        adapt = f"adapt: {{type: photos, decisions: [{decision.format(value=value)}]}}\n"
        file.write_text(file.read_text() + adapt)
        folders.append(folder)
    assert names_of(*folders) == [("smoke", "of10, of20")]
    other = make_run("other", "optimize.densify.every=30")
    assert len(names_of(*folders, other)) == 2


def crops_of(*folders: Path) -> list[crops.ImageCrop]:
    runs = [RunFolder.read(folder) for folder in folders]
    return crops.find_crops(runs, *runs[0].scene.read(runs[0].photo_folder))


def test_crops_show_where_runs_differ(make_run, monkeypatch):
    """One run is the photograph, the other is darker in the lower right quarter."""
    monkeypatch.setattr(crops, "MIN_SIDE", 12)
    result = crops_of(make_run("equal", error=0), make_run("darker", error=60))
    assert len(result) == 2, "one of each test view"
    for crop in result:
        assert 20 <= crop.x <= 28, "from the middle to the right"
        assert 20 <= crop.y <= 28
        assert crop.percentages == {"left": crop.x / 0.4, "top": crop.y / 0.4, "width": 32.5, "height": 32.5}
        same, darker = crop.psnrs
        assert (same, darker) == (100, pytest.approx(12.6, abs=0.2)), "20 log10(255 / 60)"
        np.testing.assert_array_equal(crop.renders[0], crop.photograph)


def test_single_run_is_compared_with_the_photograph(make_run):
    result = crops_of(make_run("alone", error=60))
    assert len(result) == 2
    assert all(len(crop.psnrs) == 1 and crop.psnrs[0] < 20 for crop in result)


@pytest.mark.parametrize("folder", ["../elsewhere", "/elsewhere"])
def test_renders_outside_the_run_folder_are_refused(make_run, folder):
    run = RunFolder.read(make_run("alone"))
    with pytest.raises(DataError, match=r"render\.folder is outside the run folder"):
        _ = replace(run, settings={"stages": [{"render": {"folder": folder}}]}).render_folder


def test_renders_of_a_bent_lens_are_pinhole_images(make_run):
    folder = make_run("bent", error=0)
    run = RunFolder.read(folder)
    scene, background = run.scene.read(run.photo_folder)
    views = []
    for view in scene.views:
        taken = load_image(view, WHITE).shape
        lens = Lens(taken[1], taken[0], "SIMPLE_RADIAL", (40.0, taken[1] / 2, taken[0] / 2, 0.2))
        views.append(replace(view, lens=lens, camera=lens.pinhole))
        if (folder / "renders" / f"{view.name}.png").is_file():
            write_image(folder / "renders" / f"{view.name}.png", load_image(views[-1], WHITE))
    result = crops.find_crops([run], replace(scene, views=tuple(views)), background)
    assert [crop.psnrs for crop in result] == [[100.0]] * 2


def test_page_of_a_single_run_has_no_best_and_no_seeds(make_run, tmp_path):
    page = page_of(tmp_path, make_run("alone"))
    assert "Where the run differs most from the photo" in page
    assert page.count('<input type="range"') == 2, "one of each test view"
    text = Page(page).text
    assert not any(words in text for words in ("bold", "deviation", "several seeds", "All runs"))


def test_page_without_records_has_no_curves(make_run, tmp_path):
    folder = make_run("run")
    (folder / "metrics.jsonl").unlink()
    metrics = json.loads((folder / "metrics.json").read_text())
    del metrics["test"]["2"]
    (folder / "metrics.json").write_text(json.dumps(metrics))
    page = page_of(tmp_path, folder)
    assert "No curves: the runs have no metrics.jsonl." in page
    assert "20.00" in page


def test_remarks_are_at_the_top(make_run, tmp_path):
    write_comparison([make_run("run")], tmp_path / "page.html", "ablation", ["one failed", HOSTILE])
    text = Page((tmp_path / "page.html").read_text()).text
    assert text.index("ablation: 1 run") < text.index("one failed") < text.index(HOSTILE) < text.index("tiny")


def test_page_is_self_contained(make_run, tmp_path):
    page = page_of(tmp_path, make_run("a"), make_run("b", "init.opacity=0.3"))
    assert not re.search(r"https?://|<link|src=\"(?!data:)|@import", page)
    first = re.search(r'class="slider tagged"><img src="data:image/png;base64,([^"]+)', page)
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(first[1]), np.uint8), cv2.IMREAD_COLOR)
    assert pixels.shape == (40, 40, 3), "crops keep every bit"


def test_markup_in_names_is_shown_as_text(make_run, tmp_path):
    """In the names of a scene, its views, a run's folder, its device and pipeline, and in settings."""
    folder = make_run(HOSTILE, device=f"{HOSTILE} device", pipeline=f"{HOSTILE} pipeline")
    other = make_run("other", "init.opacity=0.3")
    for run in (folder, other):
        settings = (run / "pipeline.yaml").read_text().replace("name: smoke", f"name: {json.dumps(HOSTILE)}")
        (run / "pipeline.yaml").write_text(settings)
    page = Page(page_of(tmp_path, folder, other))
    assert page.elements["script"] == 1, "that of the sliders"
    assert f"{HOSTILE} pipeline" in page.text
    assert str(folder) in page.text
    assert f"{HOSTILE}, init opacity 0.3" in page.text, "a variant's name"
    assert f"{HOSTILE} device" in page.text, "among the settings that differ"


def test_same_runs_give_the_same_bytes(make_run, tmp_path, monkeypatch):
    """Sets of strings have another order in each of these processes."""
    folders = [make_run("a"), make_run("b", "init.opacity=0.3"), make_run("c", "seed=1", device="another")]
    pages = []
    for seed in ("1", "2", "3"):
        monkeypatch.setenv("PYTHONHASHSEED", seed)
        clsplat("compare", *folders, "--out", tmp_path / "page.html")
        pages.append((tmp_path / "page.html").read_bytes())
    assert len(set(pages)) == 1


def test_lpips_of_different_ranges_is_marked(make_run, tmp_path):
    def averages(inputs: str) -> dict[str, object]:
        return {"1": {"psnr": 20, "ssim": 0.5, "lpips": 0.25, "lpips_input": inputs, "views": 2}}

    first, two = make_run("one", test=averages("0..1")), make_run("two", "init.opacity=0.3", test=averages("-1..1"))
    page = page_of(tmp_path, first, two)
    assert "0.2500" in page
    assert "The input range of LPIPS differs between runs (-1..1, 0..1)." in page


@pytest.mark.parametrize(("size", "words"), [("1", "test views"), ("2", "test views at 1/2")])
def test_means_over_other_numbers_of_views_are_marked(make_run, tmp_path, size, words):
    def averages(size: str, **figures: object) -> dict[str, object]:
        return {size: {"psnr": 20, "ssim": 0.5, "views": 7, **figures}}

    few = {"psnr_color": 30.0, "psnr_color_views": 1, "psnr_color_reason": "why"}
    first, two = make_run("one", test=averages(size, **few)), make_run("two", "init.opacity=0.3", test=averages(size))
    three = make_run("three", "init.opacity=0.4", test=averages(size, psnr_color=25.0))
    said = f"The number of {words} with a PSNR in the photos' colors differs between runs (1, 7)."
    assert said in html.unescape(page_of(tmp_path, first, two, three))
    assert "differs between runs" not in page_of(tmp_path, two, three), "what has no figure is not compared"


def broken(make_run, how: str) -> Path:
    folder: Path = make_run("run")
    match how:
        case "missing":
            return folder.with_name("nowhere")
        case "no settings":
            (folder / "pipeline.yaml").unlink()
        case "unfinished":
            (folder / "metrics.json").unlink()
            (folder / "status.json").write_text('{"state": "interrupted"}')
        case "damaged metrics":
            (folder / "metrics.json").write_text('{"test": {"1": {"psnr"')
        case "metrics of something else":
            (folder / "metrics.json").write_text('{"test": {"1": {"psnr": "high"}}}')
        case "damaged records":
            (folder / "metrics.jsonl").write_text("[1, 2]\n")
        case "damaged settings":
            (folder / "pipeline.yaml").write_text("name: [")
        case "settings of something else":
            (folder / "pipeline.yaml").write_text("- a\n")
        case "no such scene setting":
            (folder / "pipeline.yaml").write_text("scene: {pth: x}\nstages: []\n")
    return folder


@pytest.mark.parametrize(("how", "code", "words"), [
    ("missing", 3, "nowhere: has no pipeline.yaml"),
    ("no settings", 3, "has no pipeline.yaml"),
    ("unfinished", 3, "has no metrics.json because the run is interrupted; finish it with --resume"),
    ("damaged metrics", 3, "metrics.json: .*the file is damaged"),
    ("metrics of something else", 3, r"metrics.json: test.1.psnr: "),
    ("damaged records", 3, "metrics.jsonl:1: damaged.*; remove this line"),
    ("damaged settings", 2, r"pipeline.yaml:\d"),
    ("settings of something else", 2, "expected keys such as name and stages"),
    ("no such scene setting", 2, "did you mean 'path'"),
])  # fmt: skip
def test_runs_that_cannot_be_compared_are_refused(make_run, tmp_path, how, code, words):
    with pytest.raises(ClsplatError, match=words) as error:
        write_comparison([broken(make_run, how)], tmp_path / "page.html")
    assert error.value.exit_code == code
    assert "\n" not in str(error.value)
    assert not (tmp_path / "page.html").exists()


def test_same_run_twice_is_refused(make_run, tmp_path):
    folder = make_run("run")
    with pytest.raises(ConfigError, match="listed twice"):
        write_comparison([folder, tmp_path / "." / "run"], tmp_path / "page.html")


def test_page_without_photographs_shows_other_parts(make_run, tmp_path):
    folder = make_run("run")
    text = (folder / "pipeline.yaml").read_text()
    (folder / "pipeline.yaml").write_text(re.sub(r"path: .*tiny.*?,", "path: /nowhere,", text))
    page = page_of(tmp_path, folder)
    assert "No crops: /nowhere: no such folder" in page
    assert "20.00" in page


def test_damaged_render_is_refused(make_run, tmp_path):
    folder = make_run("run")
    (folder / "renders/test/r_001.png").write_bytes((folder / "renders/test/r_001.png").read_bytes()[:40])
    with pytest.raises(DataError, match=r"r_001.png: the end of the file is missing"):
        write_comparison([folder], tmp_path / "page.html")
    cv2.imwrite(str(folder / "renders/test/r_001.png"), np.zeros((41, 50, 3), np.uint8))
    with pytest.raises(DataError, match=r"r_001.png: the image is 50x41 pixels, its camera 40x40"):
        write_comparison([folder], tmp_path / "page.html")


def test_command_compares_runs_and_refuses_missing_ones(make_run, tmp_path):
    done = clsplat("compare", make_run("a"), make_run("b", "seed=1"), "--out", tmp_path / "c.html")
    assert "2 runs compared" in done.stdout
    assert "tiny" in (tmp_path / "c.html").read_text()
    clsplat("compare", tmp_path / "nowhere", "--out", tmp_path / "d.html", expect=3)
    clsplat("compare", expect=2)


def test_many_runs_have_a_line_for_each_variant(make_run, tmp_path):
    """The mean of its seeds, so that the legend leaves room for the lines."""
    make_run("first")
    make_run("other", "optimize.log_every=6")
    runs = []
    for name in ("first", "other"):
        for seed in range(5):
            runs.append(tmp_path / f"{name}_{seed}")
            shutil.copytree(tmp_path / name, runs[-1])
    page = page_of(tmp_path, *runs)
    legend = re.findall(r">([A-Z][^<]*)</tspan>", page)
    assert set(legend) == {"A", "B"}
    assert "training PSNR over steps, mean of 5 views, dB (means)" in page
    number = page.index("Gaussians over steps (means)")
    assert page[number : page.index("</svg>", number)].count("<polyline") == 2
