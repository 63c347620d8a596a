"""Stages that shrink a trained model: which Gaussians and bands are removed, and repeated bits."""

import json
from pathlib import Path

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.core.errors import ConfigError, Interrupted
from clsplat.core.progress import Progress
from clsplat.density.importance import select_largest, sensitivities
from clsplat.formats.packing import morton_order
from clsplat.formats.table import read
from clsplat.gaussians.model import Model, load
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.runs import opening, runner
from clsplat.stages.reduction import PruneLeast, compute_band_energy, expand_bands, score_gaussians
from clsplat.training.run import Run
from tests.support.runs import train

pytestmark = pytest.mark.slow

PIPELINE = """\
name: small
model: {sh_degree: 2}
stages:
  - init: {source: model, file: MODEL}
  - prune_least: {keep: 0.5}
  - optimize:
      steps: 6
      losses: [{type: l1}]
      during:
        - prune_least: {every: 2, stop: 3, remove: 0.2}
        - reduce_sh: {every: 4, degree: 1}
        - checkpoint: {every: 1}
  - reduce_sh: {degree: 1, share: 0.4}
  - export: {file: model.sog, quality: small}
  - evaluate: {split: test, file: model.sog}
  - export
"""


@pytest.fixture(scope="module")
def source(few_steps: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with harmonics of degree 2."""
    file, rng = tmp_path_factory.mktemp("model") / "model.ply", np.random.default_rng(0)
    trained = load(few_steps / "point_cloud.ply").tables()
    Model(**{**trained, "sh_rest": rng.normal(0, 0.05, (len(trained["means"]), 24)).astype(np.float32)}).save(file)
    return file


@pytest.fixture(scope="module")
def pipeline(source: Path) -> str:
    path = source.parent / "small.yaml"
    path.write_text(PIPELINE.replace("MODEL", json.dumps(str(source))))
    return str(path)


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, pipeline: str, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train(tiny_scene, tmp_path_factory.mktemp("runs") / "small", pipeline=pipeline)


def opened(scene: Path, pipeline: str, out: Path, *overrides: str) -> Run:
    """A run whose model was read, and nothing else."""
    checked = load_pipeline(pipeline, [f"scene.path='{scene}'", *overrides])
    run = opening.open_run(checked, out, None)
    checked.stages[0].act(run)
    return run


def test_least_important_gaussians_are_removed(tiny_scene, pipeline, tmp_path):
    run = opened(tiny_scene, pipeline, tmp_path)
    score, before = score_gaussians(run), run.model.gaussians.get("means")
    load_pipeline(pipeline).stages[1].act(run)
    kept = run.model.gaussians.get("means")
    assert len(kept) == round(len(before) / 2)
    order = np.argsort(-score, kind="stable")[: len(kept)]
    np.testing.assert_array_equal(kept, before[np.sort(order)])
    assert score_gaussians(run).sum() > 0.8 * score.sum(), "the others had little weight"


def test_image_change_can_be_the_score(tiny_scene, pipeline, tmp_path):
    run = opened(tiny_scene, pipeline, tmp_path)
    by_weight = score_gaussians(run)
    score = sensitivities(run.survey().render(run.scene.split("train")), run.model.gaussians.count)
    before = run.model.gaussians.get("means")
    PruneLeast(stage="prune_least", remove=0.8, score="sensitivity").act(run)
    kept = np.sort(np.argsort(-score, kind="stable")[: round(0.2 * len(before))])
    np.testing.assert_array_equal(run.model.gaussians.get("means"), before[kept])
    assert not np.array_equal(kept, np.sort(np.argsort(-by_weight, kind="stable")[: len(kept)]))


def test_ties_keep_the_first_gaussians():
    np.testing.assert_array_equal(np.flatnonzero(select_largest(np.array([1.0, 2, 1, 2, 1]), 3)), [0, 1, 3])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_energy_of_bands_is_the_mean_square_over_directions(rng, degree):
    columns = 3 * ((degree + 1) ** 2 - 1)
    rest = rng.normal(size=(4, columns)).astype(np.float32)
    directions = rng.normal(size=(200_000, 3))
    basis = ref.sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), degree)[:, 1:]
    result = compute_band_energy(rest)
    assert result.shape == (4, degree)
    for band in range(degree):
        only = np.where(expand_bands(np.arange(degree)[None].repeat(4, axis=0) == band), rest, 0)
        colors = np.einsum("dk,nkc->dnc", basis, only.reshape(4, -1, 3).astype(np.float64))
        np.testing.assert_allclose(result[:, band], np.square(colors).sum(axis=2).mean(axis=0), rtol=0.03)


def test_lower_degree_keeps_the_lower_bands(tiny_scene, pipeline, tmp_path):
    run = opened(tiny_scene, pipeline, tmp_path)
    for degree in (1, 2, 0):
        before = run.model.gaussians.get("sh_rest")
        stage = load_pipeline(pipeline, [f"reduce_sh.degree={degree}", "reduce_sh.share=0"]).stages[3]
        stage.act(run)
        columns = {1: 9, 2: 9, 0: 0}[degree]
        np.testing.assert_array_equal(run.model.gaussians.get("sh_rest"), before[:, :columns])
        assert run.model.degree == run.model.gaussians.sh_degree == min(degree, 1)


def test_least_important_bands_become_zero(tiny_scene, pipeline, tmp_path):
    run = opened(tiny_scene, pipeline, tmp_path)
    energy = compute_band_energy(run.model.gaussians.get("sh_rest")) * score_gaussians(run)[:, None]
    load_pipeline(pipeline, ["reduce_sh.degree=2", "reduce_sh.share=0.25"]).stages[3].act(run)
    zero = compute_band_energy(run.model.gaussians.get("sh_rest")) == 0
    assert zero.sum() == round(0.25 * energy.size)
    assert energy[zero].max() <= energy[~zero].min()


def test_measured_file_is_read_back(finished, tiny_scene):
    """Metrics are those of the quantized file, not those of the model that it was made from."""
    from clsplat.api.commands import evaluate

    actual = json.loads((finished.out / "metrics.json").read_text())["test"]["1"]
    quantized = evaluate(finished.out / "model.sog", tiny_scene)["test"]["1"]
    exact = evaluate(finished.out / "point_cloud.ply", tiny_scene)["test"]["1"]
    assert actual["psnr"] == pytest.approx(quantized["psnr"], abs=1e-6)
    assert abs(actual["psnr"] - exact["psnr"]) > 1e-4


def test_final_counts_and_degrees(finished, source):
    count = len(read(source))
    model = read(finished.out / "point_cloud.ply")
    assert len(model) == round(0.8 * round(count / 2)) == finished.model.gaussians.count
    assert model.sh_degree == 1
    assert (model.parameters["sh_rest"] == 0).all(axis=1).sum() == round(0.4 * len(model))


def test_interruption_between_edits_changes_no_bits(finished, tiny_scene, pipeline, tmp_path):
    checked = load_pipeline(pipeline, [f"scene.path='{tiny_scene}'", "optimize.log_every=1"])
    for stop_at in (2, 4, 5):
        run = opening.open_run(checked, tmp_path, None)

        def stop(progress: Progress, run: Run = run, stop_at: int = stop_at) -> None:
            run.interrupted = progress.step >= stop_at

        with pytest.raises(Interrupted):
            runner.execute(checked, run, "resume", stop)
    train(tiny_scene, tmp_path, pipeline=pipeline, resume=True)
    for name in ("point_cloud.ply", "model.sog"):
        assert (tmp_path / name).read_bytes() == (finished.out / name).read_bytes()


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ("{}", "set either 'keep' or 'remove'"),
        ("{keep: 0.5, remove: 0.5}", "set either 'keep' or 'remove'"),
        ("{keep: 0.0}", "greater than 0"),
        ("{remove: 1.0}", "less than 1"),
        ("{remove: 0.5, score: weights}", "expected 'weight' or 'sensitivity'"),
    ],
)
def test_invalid_fraction_is_refused(tmp_path, fields, complaint):
    path = tmp_path / "x.yaml"
    path.write_text(f"name: x\nstages:\n  - init\n  - prune_least: {fields}\n")
    with pytest.raises(ConfigError, match=complaint):
        load_pipeline(str(path))


def test_measured_file_is_inside_the_run_folder(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("name: x\nstages:\n  - init\n  - evaluate: {file: ../model.ply}\n")
    with pytest.raises(ConfigError, match="inside the run folder"):
        load_pipeline(str(path))


def test_quality_is_refused_for_formats_without_it(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("name: x\nstages:\n  - init\n  - export: {file: a.glb, quality: small}\n")
    with pytest.raises(ConfigError, match=r"'quality' applies to SPZ and SOG; .* got 'a.glb'"):
        load_pipeline(str(path))


PALETTE = """\
name: palette
model: {sh_degree: 2}
stages:
  - init: {source: model, file: MODEL}
  - palette_sh: {quality: small}
  - optimize: {steps: 4, rates: {sh_rest: 0, sh_base: 0.01}, losses: [l1]}
  - export
  - export: {file: model.sog, quality: small}
"""


@pytest.fixture(scope="module")
def varied_harmonics(source: Path) -> Path:
    """A model with more harmonics than a small palette has vectors."""
    tables, rng = load(source).tables(), np.random.default_rng(1)
    of = rng.integers(0, len(tables["means"]), 3000)
    rest = rng.normal(0, 0.05, (3000, 24)).astype(np.float32)
    file = source.parent / "many.ply"
    Model(**{**{name: table[of] for name, table in tables.items()}, "sh_rest": rest}).save(file)
    return file


def test_sog_stores_the_trained_harmonics(varied_harmonics, tiny_scene, tmp_path):
    (tmp_path / "palette.yaml").write_text(PALETTE.replace("MODEL", json.dumps(str(varied_harmonics))))
    run = train(tiny_scene, tmp_path / "run", pipeline=str(tmp_path / "palette.yaml"))
    model, back = load(run.out / "point_cloud.ply"), load(run.out / "model.sog")
    assert len(np.unique(model.sh_rest, axis=0)) <= 1024 < len(model)
    assert len(np.unique(model.sh_rest)) <= 256
    assert not np.array_equal(model.sh_base, load(varied_harmonics).sh_base), "the other tables were trained"
    ours, theirs = (np.unique(item.sh_rest, axis=0, return_counts=True) for item in (model, back))
    np.testing.assert_array_equal(ours[0], theirs[0])
    np.testing.assert_array_equal(ours[1], theirs[1])


ROUNDED = PALETTE.replace(
    "  - optimize: {steps: 4, rates: {sh_rest: 0, sh_base: 0.01}, losses: [l1]}\n",
    """\
  - round_tables: {means: 0.25, quats: 2, log_scales: 0.1}
  - export: {file: before.ply}
  - optimize:
      steps: 4
      rates: {means: 0, quats: 0, log_scales: 0, sh_rest: 0, sh_base: 0.01}
      losses: [l1]
      during: [average: {every: 1}]
  - round_tables: {sh_base: 0.04}
""",
).replace("palette_sh: {quality: small}", "palette_sh: {quality: small, step: 0.01}")


def test_rounded_tables_are_frozen_and_written_exactly(varied_harmonics, tiny_scene, tmp_path):
    (tmp_path / "rounded.yaml").write_text(ROUNDED.replace("MODEL", json.dumps(str(varied_harmonics))))
    out = train(tiny_scene, tmp_path / "run", pipeline=str(tmp_path / "rounded.yaml")).out
    before, after, back = (load(out / name).tables() for name in ("before.ply", "point_cloud.ply", "model.sog"))
    changed = [name for name in before if not np.array_equal(before[name], after[name])]
    assert sorted(changed) == ["logit_opacity", "sh_base"]
    steps = after["sh_rest"] / 0.01
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
    order = morton_order(after["means"])
    for name in after.keys() - {"logit_opacity"}:
        np.testing.assert_allclose(back[name], after[name][order], rtol=1e-4, atol=1e-5)


LEARNED = PALETTE.replace(
    "  - optimize: {steps: 4, rates: {sh_rest: 0, sh_base: 0.01}, losses: [l1]}\n",
    """\
  - export: {file: before.ply}
  - optimize:
      steps: 6
      rates: {sh_rest: 0.01}
      losses: [l1]
      during: [share_palette: {every: 2}, checkpoint: {every: 3}]
  - share_palette
  - export: {file: after.ply}
  - palette_sh: {quality: small}
""",
)


@pytest.fixture(scope="module")
def palette_run(varied_harmonics: Path, tiny_scene: Path, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("learned")
    (out / "palette.yaml").write_text(LEARNED.replace("MODEL", json.dumps(str(varied_harmonics))))
    return train(tiny_scene, out / "run", pipeline=str(out / "palette.yaml")).out


def test_gaussians_train_their_shared_vector_together(palette_run):
    before, after = (load(palette_run / f"{name}.ply").sh_rest for name in ("before", "after"))
    vectors, labels = np.unique(before, axis=0, return_inverse=True)
    assert len(vectors) <= 1024 < len(before)
    pairs = np.unique(np.concatenate([labels.reshape(-1, 1), after], axis=1), axis=0)
    assert len(pairs) == len(vectors), "each vector became one vector"
    assert not np.array_equal(before, after)


def test_trained_palette_is_rounded_to_sog_precision(palette_run):
    after, model, back = (load(palette_run / name) for name in ("after.ply", "point_cloud.ply", "model.sog"))
    assert len(np.unique(model.sh_rest)) <= 256 < len(np.unique(after.sh_rest))
    assert len(np.unique(model.sh_rest, axis=0)) <= 1024
    np.testing.assert_allclose(model.sh_rest, after.sh_rest, atol=0.01)
    ours, theirs = (np.unique(item.sh_rest, axis=0, return_counts=True) for item in (model, back))
    np.testing.assert_array_equal(ours[0], theirs[0])
    np.testing.assert_array_equal(ours[1], theirs[1])


def test_palette_training_resumes_with_the_same_bits(palette_run, varied_harmonics, tiny_scene, tmp_path):
    (tmp_path / "palette.yaml").write_text(LEARNED.replace("MODEL", json.dumps(str(varied_harmonics))))
    checked = load_pipeline(str(tmp_path / "palette.yaml"), [f"scene.path='{tiny_scene}'", "optimize.log_every=1"])
    run = opening.open_run(checked, tmp_path / "run", None)

    def stop(progress: Progress) -> None:
        run.interrupted = progress.step >= 3

    with pytest.raises(Interrupted):
        runner.execute(checked, run, "resume", stop)
    train(tiny_scene, tmp_path / "run", pipeline=str(tmp_path / "palette.yaml"), resume=True)
    for name in ("point_cloud.ply", "model.sog"):
        assert (tmp_path / "run" / name).read_bytes() == (palette_run / name).read_bytes()


def test_share_palette_needs_a_palette(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("name: x\nstages:\n  - init\n  - share_palette\n")
    with pytest.raises(ConfigError, match=r"share_palette needs 'palette', .* add palette_sh"):
        load_pipeline(str(path))


def test_palette_of_a_model_without_harmonics_changes_nothing(few_steps, tiny_scene, tmp_path):
    source = few_steps / "point_cloud.ply"
    lines = [line for line in PALETTE.replace("sh_degree: 2", "sh_degree: 0").splitlines() if "optimize" not in line]
    (tmp_path / "palette.yaml").write_text("\n".join(lines).replace("MODEL", json.dumps(str(source))))
    run = train(tiny_scene, tmp_path / "run", pipeline=str(tmp_path / "palette.yaml"))
    before, after = load(source).tables(), load(run.out / "point_cloud.ply").tables()
    assert [name for name in before if not np.array_equal(before[name], after[name])] == ["sh_rest"], "of degree 1"
    assert len(load(run.out / "model.sog")) == len(load(source))
