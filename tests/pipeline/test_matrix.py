"""Files with `matrix:`: their cells, and refusals."""

import json

import pytest

from clsplat.core.errors import ConfigError
from clsplat.pipeline.matrix import load_experiment
from clsplat.pipeline.recipes import json_schema
from tests.support.pipelines import OWN, SMALL, STAGES, names

pytestmark = pytest.mark.slow


@pytest.fixture
def write(tmp_path):
    def write(text: str, name: str = "x.yaml") -> str:
        path = tmp_path / name
        path.write_text(text)
        return str(path)

    return write


def test_cells_of_a_file_with_stages(write):
    experiment = load_experiment(write(SMALL))
    assert names(experiment) == [
        "steps=4-opacity=0.1-seed=0",
        "steps=4-opacity=0.1-seed=1",
        "steps=6-opacity=0.1-seed=0",
        "steps=6-opacity=0.1-seed=1",
    ]
    settings = [cell.pipeline.settings for cell in experiment.cells]
    assert [(s.stages[1].steps, s.seed) for s in settings] == [(4, 0), (4, 1), (6, 0), (6, 1)]
    assert all(s.name == "sweep" for s in settings)


def test_cells_of_pipelines_and_scenes(write, tmp_path):
    other = write("name: other\n" + STAGES, "other.yaml")
    scenes = [str(tmp_path / "a" / "images"), str(tmp_path / "b" / "images")]
    experiment = load_experiment(
        write(f"name: both\nmatrix:\n  pipelines: [smoke, {other}]\n  scenes: {json.dumps(scenes)}\n")
    )
    assert names(experiment) == ["smoke-a-images", "smoke-b-images", "other-a-images", "other-b-images"]
    assert [cell.pipeline.settings.scene.path for cell in experiment.cells] == scenes * 2
    assert [cell.pipeline.settings.name for cell in experiment.cells] == ["smoke", "smoke", "other", "other"]


def test_cells_with_other_step_counts(write):
    (cell,) = load_experiment(write("name: s\nmatrix: {pipelines: [splat_7k], seeds: [3], steps: 700}\n")).cells
    training = cell.pipeline.settings.training
    assert (training.steps, training.during[1].every, training.during[1].stop) == (700, 10, 400)


def test_steps_need_a_stage_that_trains(write):
    text = "name: s\nmatrix: {seeds: [3], steps: 700}\nstages:\n  - init: {count: 300}\n  - export\n"
    with pytest.raises(ConfigError, match="has no training stage; add one, such as 'optimize'"):
        load_experiment(write(text))


def test_cells_do_not_share_values(write):
    """Values inside nested lists and dicts of the file are not shared."""
    text = (
        "name: s\nmatrix: {set: {optimize.losses.0.weight: [0.1, 0.2], optimize.rates.quats: [0.5, 0.25]}}\n" + STAGES
    )
    text = text.replace("      log_every: 2\n", "      log_every: 2\n      rates: {quats: 0.125}\n")
    optimizes = [cell.pipeline.settings.stages[1] for cell in load_experiment(write(text)).cells]
    assert [(o.losses[0].weight, o.rates.quats) for o in optimizes] == [
        (0.1, 0.5),
        (0.1, 0.25),
        (0.2, 0.5),
        (0.2, 0.25),
    ]


def test_ambiguous_short_keys_are_distinguished(write):
    text = (
        "name: s\nmatrix: {set: {optimize.checkpoint.every: [2], optimize.log_every: [2], init.count: [9]}}\n" + STAGES
    )
    assert names(load_experiment(write(text))) == ["every=2-log_every=2-count=9"]
    text = "name: s\nmatrix: {set: {optimize.checkpoint.keep: [1], checkpoint.keep: [2]}}\n" + STAGES
    assert names(load_experiment(write(text))) == ["optimize.checkpoint.keep=1-checkpoint.keep=2".replace(".", "-")]


def test_values_that_are_lists_or_text(write):
    text = "name: s\nmatrix: {set: {evaluate.downscales: [[1], [1, 2]], init.source: [auto, random]}}\n" + STAGES
    experiment = load_experiment(write(text))
    assert names(experiment)[:2] == ["downscales=1-source=auto", "downscales=1-source=random"]
    assert names(experiment)[3] == "downscales=1+2-source=random"
    assert experiment.cells[3].pipeline.settings.stages[2].downscales == [1, 2]


def test_options_reach_every_cell(write):
    experiment = load_experiment(write(SMALL), ["optimize.log_every=3", "scene.downscale=2"])
    assert {cell.pipeline.settings.stages[1].log_every for cell in experiment.cells} == {3}
    assert {cell.pipeline.settings.scene.downscale for cell in experiment.cells} == {2}


def test_files_without_a_matrix_are_pipelines(write):
    assert load_experiment("smoke") is None
    assert load_experiment(write("- a\n")) is None


REFUSED = {
    "misspelled axis": (SMALL.replace("seeds:", "seds:"), r"x.yaml:3: matrix.seds: unknown key 'seds'; did you mean"),
    "no axis": ("name: s\nmatrix: {}\n" + STAGES, r"x.yaml:2: matrix: expected at least one of pipelines, scenes"),
    "empty axis": ("name: s\nmatrix: {set: {init.count: []}}\n" + STAGES, r"init.count: expected a list of at least 1"),
    "not a list": (SMALL.replace("[4, 6]", "4"), r"x.yaml:5: matrix.set.optimize.steps: expected a list, got 4"),
    "text for a seed": (SMALL.replace("[0, 1]", "[0, one]"), r"matrix.seeds\[1\]: expected a whole number, got 'one'"),
    "misspelled setting": (
        SMALL.replace("optimize.steps", "optimize.stps"),
        r"x.yaml:5: matrix.set.optimize.stps\[0\]: unknown key 'stps'; did you mean 'steps'",
    ),
    "misspelled stage": (
        SMALL.replace("optimize.steps", "optimze.steps"),
        r"x.yaml:5: matrix.set.optimze.steps\[0\]: no 'optimze' in this pipeline; did you mean optimize",
    ),
    "wrong value": (
        SMALL.replace("[4, 6]", "[4, 30k]"),
        r"x.yaml:5: matrix.set.optimize.steps\[1\]: .*expected a whole number, got '30k'",
    ),
    "twice": (SMALL.replace("[4, 6]", "[4, 4]"), r"x.yaml:2: matrix: duplicate value in \[4, 4\] of 'optimize.steps'"),
    "unknown pipeline": (
        "name: s\nmatrix:\n  pipelines: [smoke,\n    smokee]\n",
        r"x.yaml:4: matrix.pipelines\[1\]: no pipeline named 'smokee'; did you mean 'smoke'",
    ),
    "pipelines and stages": ("name: s\nmatrix: {pipelines: [smoke]}\n" + STAGES, r"x.yaml:3: stages: unknown key"),
    "no stages": (OWN, r"'stages' is missing"),
    "no name": ("matrix: {seeds: [1]}\n" + STAGES, r"'name' is missing"),
    "too many": (SMALL.replace("[0, 1]", str(list(range(600)))), r"x.yaml: the matrix has 1200 cells"),
    "base is wrong": (SMALL.replace("count: 300", "cuont: 300"), r"x.yaml:8: stages\[0\].init.cuont: unknown key"),
    "matrix is text": ("name: s\nmatrix: all\n" + STAGES, r"x.yaml:2: matrix: "),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_invalid_matrices_are_refused(case, write):
    text, words = REFUSED[case]
    with pytest.raises(ConfigError, match=words) as error:
        load_experiment(write(text))
    assert "\n" not in str(error.value)


def test_option_cannot_contradict_the_matrix(write):
    with pytest.raises(ConfigError, match=r"the matrix already lists values of optimize\.steps"):
        load_experiment(write(SMALL), ["optimize.steps=3"])


def test_duplicate_name_is_refused(write, tmp_path):
    (tmp_path / "sub").mkdir()
    paths = [write("name: p\n" + STAGES, "p.yaml"), write("name: p\n" + STAGES, "sub/p.yaml")]
    with pytest.raises(ConfigError, match="two cells of the matrix would be named 'p'"):
        load_experiment(write(f"name: s\nmatrix: {{pipelines: {json.dumps(paths)}}}\n"))


def test_schema_knows_the_matrix():
    schema = json_schema()
    assert set(schema["$defs"]["Matrix"]["properties"]) == {"pipelines", "scenes", "seeds", "set", "steps", "options"}
    assert schema["properties"]["matrix"] == {"$ref": "#/$defs/Matrix"}
    assert "stages" not in schema["required"]
