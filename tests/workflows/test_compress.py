"""`clsplat compress`: targets, the extent of the search, and outputs."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import clsplat
from clsplat.api.commands import evaluate
from clsplat.cli import app
from clsplat.core import lock
from clsplat.core.errors import ConfigError, DataError, Interrupted, OutputError
from clsplat.core.files import LOCK
from clsplat.formats.table import detect, read
from clsplat.gaussians.model import Rendering
from clsplat.gaussians.sky import Sky
from clsplat.pipeline.loading import Pipeline
from clsplat.runs import model_file, runner
from clsplat.runs.model_file import ModelSource
from clsplat.training.run import Run
from clsplat.workflows import compress
from clsplat.workflows.compress import SOG_STAGES, CompressionTarget, Entry, Ladder, format_table, ordered_keeps, page
from clsplat.workflows.finetune import Tuning
from tests.support.html_page import Page
from tests.support.runs import NO_PROCESS

pytestmark = pytest.mark.slow

KEEP, STEPS = (1.0, 0.5), 20


def entry(size: int, psnr: float, keep: float = 0.5) -> Entry:
    return Entry("a<b>.sog", keep, 3, "small", 10, size, psnr, 0.9)


@pytest.fixture(scope="module")
def searched(few_steps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished search for a file of any size."""
    out = tmp_path_factory.mktemp("search") / "small"
    clsplat.compress_model(few_steps, target="1MB", out=out, keep=KEEP, steps=STEPS)
    assert "nothing to resume" not in (out / "keep_50" / "log.txt").read_text()
    return out


@pytest.mark.parametrize(
    ("text", "most", "change"),
    [
        ("5MB", 5_000_000, None),
        ("1.5 mb", 1_500_000, None),
        ("2MiB", 2_097_152, None),
        ("-.5 dB", None, -0.5),
        ("0dB", None, 0),
    ],
)
def test_targets_are_parsed(text, most, change):
    result = CompressionTarget.parse(text)
    assert (result.max_bytes, result.psnr_change) == (most, change)


@pytest.mark.parametrize("text", ["", "5", "MB", "-5MB", "0MB", "0.5B", "0.1dB", "1e3MB", "-0.1 dB\n5MB", "٥MB"])
def test_invalid_target_is_refused(text):
    with pytest.raises(ConfigError, match="expected a size such as 5MB"):
        CompressionTarget.parse(text)


def test_file_is_copied_with_its_sky(few_steps, tmp_path, rng):
    sky = Sky(rng.random((64, 3), np.float32))
    replace(clsplat.load(few_steps), sky=sky).save(tmp_path / "rung.sog")
    compress._copy(tmp_path / "rung.sog", tmp_path / "compressed.sog")
    np.testing.assert_array_equal(clsplat.load(tmp_path / "compressed.sog").sky.texels, sky.texels)


def test_best_file_for_a_size_and_smallest_for_a_loss():
    entries = [entry(900, 30.0), entry(700, 29.95), entry(500, 29.5)]
    assert CompressionTarget.parse("800B").best(entries, 30) is entries[1]
    assert CompressionTarget.parse("-0.1dB").best(entries, 30) is entries[1]
    assert CompressionTarget.parse("-0.6dB").best(entries, 30) is entries[2]
    assert CompressionTarget.parse("0dB").best(entries, 31) is None
    assert CompressionTarget.parse("400B").best(entries, 30) is None
    assert CompressionTarget.parse("400B").nearest(entries) is entries[2]
    assert CompressionTarget.parse("0dB").nearest(entries) is entries[0]


def test_search_shrinks_until_no_file_can_be_better():
    rung = [entry(900, 30.0), entry(500, 29.5)]
    assert not CompressionTarget.parse("600B").is_decided(rung, 30), "fewer Gaussians let more settings fit"
    assert CompressionTarget.parse("1kB").is_decided(rung, 30), "all fit"
    assert not CompressionTarget.parse("-0.1dB").is_decided(rung, 30)
    assert CompressionTarget.parse("0dB").is_decided(rung, 31), "none is good enough"


def test_unsearched_format_is_refused_before_anything_is_opened():
    with pytest.raises(ConfigError, match="--format 'glb': expected one of sog, spz"):
        clsplat.compress_model("model.ply", "scene", format="glb")


@pytest.mark.parametrize("keeps", [[], [0.0], [1.2], [float("nan")], [0.501, 0.5]])
def test_invalid_fractions_are_refused(keeps):
    with pytest.raises(ConfigError, match="--keep: expected fractions"):
        ordered_keeps(keeps)
    assert ordered_keeps([0.5, 1, 0.7, 0.5]) == [1, 0.7, 0.5]


def test_every_file_is_measured_after_reading_it_back(searched, few_steps, tiny_scene):
    data = json.loads((searched / "compress.json").read_text())
    whole = len(read(few_steps / "point_cloud.ply"))
    assert data["source"]["gaussians"] == whole
    assert {(item["keep"], item["gaussians"]) for item in data["points"]} == {(1.0, whole), (0.5, round(whole / 2))}
    for item in data["points"][::3]:
        file = searched / item["file"]
        assert file.stat().st_size == item["bytes"]
        assert read(file).sh_degree == item["degree"]
        assert evaluate(file, tiny_scene)["test"]["1"]["psnr"] == pytest.approx(item["psnr"], abs=1e-9)


def test_chosen_file_is_the_best(searched):
    data = json.loads((searched / "compress.json").read_text())
    assert data["chosen"]["psnr"] == max(item["psnr"] for item in data["points"])
    assert (searched / "compressed.sog").read_bytes() == (searched / data["chosen"]["file"]).read_bytes()


def test_page_shows_every_file_and_the_curve(searched):
    text = (searched / "compress.html").read_text()
    data = json.loads((searched / "compress.json").read_text())
    assert all(item["file"] in text for item in data["points"])
    assert text.count("<polyline") == len(KEEP)
    assert text.count('class="chosen"') == 1
    Page(text)


def test_page_names_the_scene_and_links_to_the_file(searched, few_steps, tiny_scene):
    text = (searched / "compress.html").read_text()
    assert f"<title>{tiny_scene.name} · point_cloud.ply, compressed to " in text
    assert str(few_steps / "point_cloud.ply") in text
    assert '<a href="compressed.sog">compressed.sog</a>' in text
    before = page(CompressionTarget.parse("-1dB"), entry(2000, 31), [entry(900, 30.5)], None, "test", "fox", "a.ply")
    assert "<a" not in before, "as long as none is written"


def test_names_of_files_are_escaped():
    source = entry(2000, 31)
    text = page(CompressionTarget.parse("-1dB"), source, [entry(900, 30.5)], None, "test", "a<b>", "a<b>.ply")
    assert "a<b>" not in text
    assert "a&lt;b&gt;" in text
    assert "No file has met the target" in text
    assert re.findall(r'<polyline[^>]* stroke="([^"]+)"[^>]*dasharray', text) == ["var(--target)"]


def test_repeated_search_trains_nothing_and_gives_the_same_bytes(searched, few_steps):
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in searched.rglob("*.ply")}
    files = {path.name: path.read_bytes() for path in (searched / "trials").iterdir()}
    result = clsplat.compress_model(few_steps, target="-40dB", out=searched, keep=KEEP, steps=STEPS)
    assert {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in before} == before
    assert {path.name: path.read_bytes() for path in (searched / "trials").iterdir()} == files
    assert result["chosen"]["bytes"] == min(item["bytes"] for item in result["points"])


def test_model_and_its_scene_are_opened_once(few_steps, tmp_path, monkeypatch):
    opened: list[Path] = []

    def load(path):
        opened.append(path)
        return clsplat.load(path)

    monkeypatch.setattr(model_file, "load", load)
    monkeypatch.setattr(compress, "load", load)
    (tmp_path / "own.txt").write_text("mine")
    with pytest.raises(ConfigError, match="contains files that are not part of"):
        clsplat.compress_model(few_steps, target="1MB", out=tmp_path, keep=KEEP, steps=STEPS)
    assert opened == [few_steps / "point_cloud.ply"]


def interrupted(pipeline: Pipeline, run: Run, run_stages=runner.run_stages) -> None:
    run.interrupted = True
    run_stages(pipeline, run)


def test_interrupted_search_resumes_when_repeated(few_steps, tmp_path, monkeypatch):
    run_stages = runner.run_stages
    monkeypatch.setattr(runner, "run_stages", interrupted)
    search = {"target": "1MB", "out": tmp_path / "out", "keep": [0.5], "steps": STEPS}
    with pytest.raises(Interrupted, match=r"^stopped in keep_50; run the same command again to resume$"):
        clsplat.compress_model(few_steps, **search)
    monkeypatch.setattr(runner, "run_stages", run_stages)
    assert Path(clsplat.compress_model(few_steps, **search)["file"]).is_file()
    assert "resumed at step 0" in (tmp_path / "out" / "keep_50" / "log.txt").read_text()


def test_another_search_needs_another_folder(searched, few_steps, tmp_path):
    with pytest.raises(ConfigError, match="a search with different steps; remove the folder, or use another --out"):
        clsplat.compress_model(few_steps, target="1MB", out=searched, keep=KEEP, steps=STEPS + 1)
    (tmp_path / "own.txt").write_text("mine")
    with pytest.raises(ConfigError, match="contains files that are not part of a search"):
        clsplat.compress_model(few_steps, target="1MB", out=tmp_path, keep=KEEP, steps=STEPS)


def test_search_does_not_resume_with_other_photographs(few_steps, tiny_scene, tmp_path, monkeypatch):
    shutil.copytree(tiny_scene, tmp_path / "scene")
    ask = {"target": "1MB", "out": tmp_path / "out", "keep": [0.5], "steps": STEPS}
    monkeypatch.setattr(runner, "run_stages", interrupted)
    with pytest.raises(Interrupted):
        clsplat.compress_model(few_steps, tmp_path / "scene", **ask)
    first, second, *_ = sorted((tmp_path / "scene" / "train").iterdir())
    second.write_bytes(first.read_bytes())
    with pytest.raises(ConfigError, match=r"a search with different photographs"):
        clsplat.compress_model(few_steps, tmp_path / "scene", **ask)


def test_concurrent_search_in_a_folder_is_refused(few_steps, tmp_path):
    with lock.lock_folder(tmp_path), pytest.raises(OutputError, match="is in use by this process"):
        clsplat.compress_model(few_steps, target="1MB", out=tmp_path, keep=[1.0])
    assert list(tmp_path.iterdir()) == []


def test_search_killed_early_resumes_and_removes_leftovers(few_steps, tmp_path):
    out, names = tmp_path / "out", [LOCK, f".compress.json.{NO_PROCESS}-0.partial"]
    out.mkdir()
    for name in names:
        (out / name).write_text("x")
    search = {"target": "1MB", "out": out, "keep": [1.0], "steps": STEPS}
    clsplat.compress_model(few_steps, **search)
    before = sorted(out.rglob("*"))
    assert not {path.name for path in before} & set(names)
    for name in (
        f".compress.html.{NO_PROCESS}-0.partial",
        f"trials/.keep_100_degree_0_small.sog.{NO_PROCESS}-0.partial",
    ):
        (out / name).write_text("x")
    clsplat.compress_model(few_steps, **search)
    assert sorted(out.rglob("*")) == before


@pytest.mark.parametrize("text", ["", "[]"])
def test_damaged_search_record_is_reported_with_a_remedy(text, few_steps, tmp_path):
    (tmp_path / "compress.json").write_text(text)
    with pytest.raises(ConfigError, match=r"compress\.json: is not the record of a search; remove .*, or use another"):
        clsplat.compress_model(few_steps, target="1MB", out=tmp_path, keep=[1.0])


def test_unreachable_target_leaves_page_and_nearest_file(few_steps, tmp_path):
    with pytest.raises(ConfigError, match=r"no file meets it; the closest, .*_degree_0_balanced\.spz") as error:
        clsplat.compress_model(few_steps, target="1B", out=tmp_path / "out", format="spz", keep=[1.0])
    assert "give a larger size" in str(error.value)
    assert not (tmp_path / "out" / "compressed.spz").exists()
    assert "No file has met" in (tmp_path / "out" / "compress.html").read_text()
    assert detect(tmp_path / "out" / "trials" / "keep_100_degree_0_balanced.spz").name == "SPZ"


def test_earlier_file_stays_if_none_meets_the_new_target(few_steps, tmp_path):
    ask = {"out": tmp_path / "out", "format": "spz", "keep": [1.0]}
    clsplat.compress_model(few_steps, target="1MB", **ask)
    assert detect(tmp_path / "out" / "compressed.spz").name == "SPZ"
    with pytest.raises(ConfigError, match=r"no file meets it; .*; the existing compressed\.spz is for another target"):
        clsplat.compress_model(few_steps, target="2B", **ask)
    assert (tmp_path / "out" / "compressed.spz").is_file()


def test_spz_losses_are_reported_once_per_search(few_steps, tiny_scene, tmp_path, caplog):
    caplog.set_level("INFO")
    model = clsplat.load(few_steps / "point_cloud.ply")
    model = replace(model, rendering=replace(model.rendering, near=0.001))
    model.save(tmp_path / "a.ply")
    ask = {"out": tmp_path / "out", "format": "spz", "keep": KEEP, "steps": STEPS}
    clsplat.compress_model(tmp_path / "a.ply", tiny_scene, target="-90dB", **ask)
    assert len(list((tmp_path / "out" / "trials").iterdir())) > 1
    (told,) = [text for text in caplog.messages if "does not store" in text]
    assert told.startswith(f"{tmp_path / 'out' / 'compressed.spz'}: SPZ does not store near = 0.001")
    assert "read with the axes of SPZ" not in caplog.text


def test_command_prints_a_table(searched, few_steps):
    arguments = ["--target", "-40dB", "--out", str(searched), "--keep", "1,0.5", "--steps", str(STEPS)]
    result = CliRunner().invoke(app, ["compress", str(few_steps), *arguments])
    assert result.exit_code == 0, result.output
    assert format_table(json.loads((searched / "compress.json").read_text())) in result.output
    assert "compressed.sog: " in result.output


def test_zero_loss_has_no_sign(monkeypatch):
    same = {"psnr": 30.0, "bytes": 10}
    actual = {"chosen": {**same, "psnr": 29.999}, "source": same, "file": "a.sog", "page": "a.html"}
    monkeypatch.setattr("clsplat.api.commands.compress_model", lambda *_, **__: actual)
    monkeypatch.setattr("clsplat.workflows.compress.format_table", lambda _: "")
    output = CliRunner().invoke(app, ["compress", "a.ply"]).output
    assert "0.00 dB" in output
    assert "-0.00" not in output


def test_candidate_is_trained_with_the_models_render_settings(few_steps, tmp_path):
    """A mip model keeps its filter, and photographs are read as the model's run read them."""
    model = clsplat.load(few_steps / "point_cloud.ply")
    mip = replace(model, rendering=Rendering(near=0.05, screen_variance=0.1, compensate=1.0, background="white"))
    ladder = Ladder(tmp_path, Tuning("compress", ModelSource.from_model(few_steps, None), mip, 20, None))
    settings = ladder.pipeline(few_steps / "point_cloud.ply", 0.7).settings
    screen = settings.model.screen_filter
    assert (settings.model.near, screen.variance, screen.compensate) == (0.05, 0.1, 1)
    assert (settings.scene.background, settings.model.sh_degree) == ("white", model.sh_degree)
    assert (settings.stages[1].keep, settings.training.steps, settings.training.rates.means.over) == (0.7, 20, 20)
    assert [stage.stage for stage in settings.stages] == ["init", "prune_least", "optimize", "export"]


@pytest.mark.parametrize(("steps", "lengths", "starts"), [(None, (400, 200), (200, 500)), (100, (40, 20), (20, 50))])
def test_palette_averages_start_midway_through_training(steps, lengths, starts, few_steps, tmp_path):
    """Their steps count from the first stage that is run, not from that of the recipe."""
    model = clsplat.load(few_steps / "point_cloud.ply")
    tuning = Tuning("compress", ModelSource.from_model(few_steps, None), model, steps, None)
    settings = tuning.pipeline(SOG_STAGES, {"init.file": str(few_steps / "point_cloud.ply")}).settings
    stages = [stage for stage in settings.stages if stage.stage == "optimize"]
    assert tuple(stage.steps for stage in stages) == lengths
    assert tuple(stage.during[-1].start for stage in stages) == starts


@pytest.mark.parametrize("steps", [19, 1, 0, -5])
def test_too_few_steps_for_an_average_are_refused(steps, few_steps, tmp_path):
    with pytest.raises(ConfigError, match=f"--steps {steps}: expected at least 20"):
        clsplat.compress_model(few_steps, target="1MB", out=tmp_path, steps=steps)


def test_model_of_unknown_size_leaves_no_folder(few_steps, tmp_path, monkeypatch):
    def damaged(path):
        raise DataError("a level is missing")

    monkeypatch.setattr(compress, "model_bytes", damaged)
    with pytest.raises(DataError, match="a level is missing"):
        clsplat.compress_model(few_steps, target="1MB", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
