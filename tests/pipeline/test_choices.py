"""Settings that follow from a measure of the photographs: what is measured, chosen, written, and overridden."""

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError
from clsplat.core.schedule import at_step
from clsplat.pipeline.choices import choose, undone
from clsplat.pipeline.loading import load
from clsplat.pipeline.stretching import in_steps
from clsplat.pipeline.yaml_file import yaml_text
from clsplat.runs import time_budget
from clsplat.runs.describe import describe
from clsplat.runs.state import RunState
from clsplat.scene.detect import read_scene
from clsplat.scene.quality import measured, nearest_points
from clsplat.scene.quality import told as text_of
from clsplat.scene.scene import Tracks
from clsplat.stages.densify import Densify
from clsplat.sweeps.experiment import run_pipeline
from tests.support.outdoor_scene import Yard
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow

DEGREE = "{keys: [model.sh_degree], by: photographs, values: [[0, 0], [8, 1], [24, 2]], since: few say little}"
RESET = "{keys: [reset_opacity.stop], by: photographs, values: [[0, 1], [9, null]], since: they decay}"
PATIENCE = "{keys: [optimize.patience], by: photographs, values: [[0, 4], [8, null]], since: many are enough}"
KEEP = (
    "{keys: [scene.validation, optimize.keep, optimize.patience], by: photographs, "
    "values: [[0, 0, last, null], [8, auto, best, 2], [9, 0, last, null]], since: few are learnt by heart}"
)
AUTO = "model.background={type: auto, chosen: on, reason: it is blue}"
BOTH = f"choices=[{DEGREE}, {RESET}]"


def test_the_last_row_that_a_measure_reaches_decides():
    settings = load("smoke", [BOTH]).settings
    for count, degree, stop in ((1, 0, 1), (7, 0, 1), (8, 1, 1), (23, 1, None), (500, 2, None)):
        chosen = choose(settings, {"photographs": count})
        reset = next(stage for stage in chosen.training.during if stage.stage == "reset_opacity")
        assert (chosen.model.sh_degree, reset.stop) == (degree, stop)
        assert [one.chosen for one in chosen.choices] == [[degree], [stop]]
        assert chosen.choices[0].instead_of == [settings.model.sh_degree]
        counted = "1 training photograph" if count == 1 else f"{count:,.4g} training photographs"
        assert chosen.choices[0].reason == f"{counted}; few say little"
        assert undone(chosen) == settings
        assert choose(chosen, {"photographs": 30}) == chosen, "a choice that is made stays"


def test_without_the_measure_the_value_of_the_file_stays():
    settings = load("smoke", [BOTH.replace("photographs", "points")]).settings
    chosen = choose(settings, {"photographs": 3})
    assert chosen.model == settings.model
    assert chosen.choices[0].reason == "the dataset does not tell points"


@pytest.mark.parametrize(
    ("override", "left"),
    [
        ("model.sh_degree=2", ["reset_opacity.stop"]),
        ("model={sh_degree: 2}", ["reset_opacity.stop"]),
        ("stages.1.during.2.stop=7", ["model.sh_degree"]),
        ("optimize.during=[checkpoint: {every: 5}, reset_opacity: {every: 9}]", ["model.sh_degree"]),
        ("optimize.steps=7", ["model.sh_degree", "reset_opacity.stop"]),
    ],
)
def test_an_override_takes_the_place_of_a_choice(tmp_path, override, left):
    text = load("smoke", [BOTH]).text()
    (tmp_path / "own.yaml").write_text(text)
    names = [stage.stage for stage in load("smoke").settings.training.during]
    override = override.replace("during.2", f"during.{names.index('reset_opacity')}")
    if override.startswith("optimize.during"):
        override = "optimize.during=[{stage: reset_opacity, every: 9}]"
    assert [one.keys for one in load(str(tmp_path / "own.yaml"), [override]).settings.choices] == [
        [key] for key in left
    ]


@pytest.mark.parametrize(
    ("choices", "complaint"),
    [
        (DEGREE.replace("sh_degree", "sh_degre"), "sh_degre"),
        (DEGREE.replace("[8, 1]", "[8, 9]"), "at 8 photographs: model.sh_degree: "),
        (DEGREE.replace("[8, 1]", "[8, 1], [8, 2]"), "growing finite numbers"),
        (DEGREE.replace("[8, 1]", "[.nan, 1]"), "growing finite numbers"),
        (DEGREE.replace("[0, 0]", "[1, 0]"), "the first one from 0"),
        (DEGREE.replace("photographs", "moons"), "photographs_per_point"),
        (f"{DEGREE}, {DEGREE}", "chosen twice"),
        (
            DEGREE.replace("model.sh_degree", "optimize.patience").replace("[0, 0]", "[0, 4]"),
            "'patience' is for 'keep: best'",
        ),
        (DEGREE.replace("model.sh_degree", "scene.holdout"), "before photographs are measured"),
    ],
)
def test_a_choice_that_cannot_be_made_is_refused_before_a_run(choices, complaint):
    with pytest.raises(ConfigError, match=complaint):
        load("smoke", [f"choices=[{choices}]"])


def test_in_fewer_steps_schedules_end_earlier_and_bounds_stay():
    values = "[[0, {probability: [[0, 0.0], [50, 0.2]]}], [24, null]]"
    schedule = f"{{keys: [optimize.modules.dropout], by: photographs, values: {values}, since: few}}"
    settings = load("smoke", [f"choices=[{schedule}, {RESET}]"]).settings
    dropout, reset = in_steps(settings, settings.training.steps // 2).choices
    assert dropout.values == [[0, {"probability": [[0, 0.0], [25, 0.2]]}], [24, None]]
    assert reset == settings.choices[1]
    chosen = in_steps(choose(settings, {"photographs": 3}), settings.training.steps // 2)
    assert chosen.choices[0].chosen == [{"probability": chosen.training.modules[0].probability}]
    assert (chosen.choices[0].instead_of, settings.choices[0].chosen) == ([None], None)


def test_what_is_measured_of_a_scene(tiny_scene):
    scene = read_scene(tiny_scene)
    train_names = [view.name for view in scene.split("train")]
    rows = {name: np.arange(i % 2 + 1) for i, name in enumerate(train_names)}  # point 0 in all, point 1 in each second
    others = {view.name: np.array([0, 1, 2]) for view in scene.split("test")}
    found = measured(replace(scene, tracks=Tracks(np.zeros((3, 3)), {**rows, **others})))
    count = len(train_names)
    assert found["photographs"] == count
    assert found["pixels"] == 40 * 40
    assert found["points"] == len(scene.points)
    assert found["photographs_per_point"] == (count + count // 2) / 2, "of points that training photographs show"
    sizes = measured(scene.downscaled(1, 2))
    assert (sizes["photographs"], sizes["pixels"]) == (count, 1600), "each photograph counts once"
    assert "photographs_per_point" not in sizes


def test_nearest_points_are_before_any_training_photograph(tiny_scene):
    """The depth that a hundredth of what they show is nearer than; what lies behind a camera does not count."""
    scene = read_scene(tiny_scene)
    trained, tested = scene.split("train")[:2], scene.split("test")[0]
    depths = [np.r_[-3.0, 1:102], np.array([-1, 1.5, 9, 9]), np.array([0.5])]
    positions, seen = [], {}
    for view, own in zip((*trained, tested), depths, strict=True):
        to_world = np.linalg.inv(np.vstack([view.world_to_camera, [0, 0, 0, 1]]))
        seen[view.name] = np.arange(len(own)) + sum(map(len, positions))
        positions.append(np.column_stack([0 * own, 0 * own, own, own**0]) @ to_world[:3].T)

    points = np.concatenate(positions)
    points[seen[trained[1].name][2:]] = [[np.inf], [np.nan]]  # of a damaged file

    def nearest(*views):
        tracks = Tracks(points, {view.name: seen[view.name] for view in views})
        return nearest_points(replace(scene, tracks=tracks))

    assert nearest(*trained, tested) == pytest.approx(1.505), "of 102 points; one shows one alone"
    assert nearest(trained[0]) == pytest.approx(2), "one in a hundred may be mistaken"
    assert nearest(tested) is None
    assert nearest_points(scene) is None


@pytest.mark.parametrize(("near", "warned"), [(0.001, False), (3, True)])
def test_a_run_warns_where_points_lie_before_the_near_plane(tmp_path, rng, caplog, near, warned):
    Yard(rng).write(tmp_path / "yard")
    asked = load("smoke", [f"scene.path='{tmp_path / 'yard'}'", f"model.near={near}"])
    describe(asked, tmp_path / "run", None, "new")
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    told = [message for message in warnings if "model.near" in message]
    assert len(told) == warned
    assert all(f"model.near={near} scene units" in one and "set model.near to " in one for one in told)


def test_a_run_writes_what_it_chose_and_repeats_without_choosing(tiny_scene, tmp_path):
    asked = load("smoke", [f"scene.path='{tiny_scene}'", *FEW, BOTH])
    run_pipeline(asked, tmp_path / "run", None, "new")
    written = load(str(tmp_path / "run" / "pipeline.yaml"))
    assert written.settings.model.sh_degree == 1
    assert [one.chosen for one in written.settings.choices] == [[1], [1]]
    assert "model.sh_degree=1, since 8 training photographs; few say little" in (tmp_path / "run/log.txt").read_text()
    assert RunState.read(tmp_path / "run").is_whole(asked), "the same command finds it up to date"
    plain = train(tiny_scene, tmp_path / "plain", *FEW, "model.sh_degree=1", "reset_opacity.stop=1")
    assert digest(plain.out) == digest(tmp_path / "run")
    run_pipeline(written, tmp_path / "again", None, "new")
    assert digest(tmp_path / "again") == digest(tmp_path / "run")


def test_a_description_tells_choices_and_reasons_once(tiny_scene, tmp_path, caplog):
    caplog.set_level("INFO")
    asked = load("smoke", [f"scene.path='{tiny_scene}'", *FEW, BOTH])
    text = describe(asked, tmp_path / "run", None, "new")
    assert "model.sh_degree=1, since 8 training photographs; few say little" in text
    assert "few say little" not in caplog.text
    assert not (tmp_path / "run").exists()


def test_a_choice_may_keep_photographs_out_to_choose_by(tiny_scene, tmp_path):
    settings = [f"scene.path='{tiny_scene}'", *FEW]
    asked = load("smoke", [*settings, f"choices=[{KEEP}]"])
    run_pipeline(asked, tmp_path / "run", None, "new")
    plain = "scene.validation=auto", "optimize.keep=best", "optimize.patience=2"
    train(tiny_scene, tmp_path / "plain", *FEW, *plain)
    assert digest(tmp_path / "run") == digest(tmp_path / "plain")
    found = [json.loads((tmp_path / name / "metrics.json").read_text()) for name in ("run", "plain")]
    assert found[0]["validation"] == found[1]["validation"]
    assert RunState.read(tmp_path / "run").is_whole(asked)
    for name in ("point_cloud.ply", "metrics.json", "checksums.json"):
        (tmp_path / "run" / name).unlink()
    clsplat.resume(tmp_path / "run")  # by the pipeline that the folder has, without choices to be made
    assert digest(tmp_path / "run") == digest(tmp_path / "plain")


def test_an_override_wins_for_one_key_alone():
    """Where the row's values go together with it; elsewhere the file's stay beside it."""
    asked = load("smoke", [f"choices=[{KEEP}]", "optimize.patience=3"])
    repeated = load("smoke", ["optimize.patience=3", f"choices=[{KEEP}]"])
    assert repeated.resolved() == asked.resolved()
    chosen = choose(asked.settings, {"photographs": 8})
    assert (chosen.scene.validation, chosen.training.keep, chosen.training.patience) == ("auto", "best", 3)
    assert chosen.choices[0].reason == "8 training photographs; few are learnt by heart; optimize.patience as set"
    assert undone(chosen) == asked.settings
    with pytest.raises(ConfigError, match=r"at 9 photographs: .*'patience' is for 'keep: best'"):
        choose(asked.settings, {"photographs": 9})
    without = choose(load("smoke", [f"choices=[{KEEP}]", "scene.validation=0"]).settings, {"photographs": 8})
    assert (without.scene.validation, without.training.keep) == (0, "last")
    assert without.choices[0].reason.endswith("scene.validation as set, with which the rest does not go together")
    with pytest.raises(ConfigError, match=r"optimize\.patience: expected a whole number, got 'many'"):
        load("smoke", [f"choices=[{KEEP}]", "optimize.patience=many"])
    with pytest.raises(ConfigError, match="stepz"):
        load("smoke", [f"choices=[{KEEP}]", "optimize.patience=3", "optimize.stepz=3"])


def test_other_photographs_are_chosen_for_again(tmp_path):
    asked = load("smoke", [f"choices=[{DEGREE}, {KEEP}]", "scene.path=one"])
    made = replace(asked, settings=choose(asked.settings, {"photographs": 8}))
    (tmp_path / "run.yaml").write_text(made.text())
    again = load(str(tmp_path / "run.yaml"))
    assert again.settings.training.keep == "best"
    changed = load(str(tmp_path / "run.yaml"), ["optimize.patience=5"]).settings
    assert (changed.training.keep, changed.training.patience) == ("best", 5)
    assert choose(undone(changed), {"photographs": 8}).training == changed.training
    other = load(str(tmp_path / "run.yaml"), ["scene.path=two"])
    assert other.resolved() == load("smoke", [f"choices=[{DEGREE}, {KEEP}]", "scene.path=two"]).resolved()
    (tmp_path / "auto.yaml").write_text(load("smoke", [AUTO]).text())
    assert load(str(tmp_path / "auto.yaml"), ["scene.path=two"]).settings.model.background.chosen is None
    assert load(str(tmp_path / "auto.yaml"), ["seed=2"]).settings.model.background.chosen == "on"


def test_each_row_may_have_its_reason():
    reasons = DEGREE.replace("since: few say little", "since: [none, few, many]")
    settings = load("smoke", [f"choices=[{reasons}]"]).settings
    assert choose(settings, {"photographs": 9}).choices[0].reason == "9 training photographs; few"
    with pytest.raises(ConfigError, match="words for each of 3 rows"):
        load("smoke", [f"choices=[{reasons.replace('[none, few, many]', '[none, few]')}]"])


def test_a_choice_with_a_refit_says_what_to_set_for_a_time():
    keys = "scene.validation, optimize.keep, optimize.patience, optimize.refit"
    values = "[[0, auto, best, 4, true], [40, 0, last, null, false]]"
    few = f"choices=[{{keys: [{keys}], by: photographs, values: {values}, since: few}}]"
    chosen = choose(load("splat_7k", [few]).settings, {"photographs": 20})
    with pytest.raises(ConfigError, match=r"chosen by 20 training photographs; .*add --set optimize\.refit=false"):
        time_budget.rehearsals_of(replace(load("splat_7k"), settings=chosen), None, 1.0)
    once = choose(load("splat_7k", [few, "optimize.refit=false"]).settings, {"photographs": 20}).training
    assert (once.refit, once.keep, once.patience) == (False, "best", 4)


@pytest.mark.parametrize(
    ("photographs", "sky", "dropout", "most"),
    [
        (4, None, 0.2, 0.6),
        (11, 0.24, 0.2, 0.6),
        (11, 0.25, 0.2, 0.3),
        (25, 0.5, 0.2, 0.1),
        (39, 1, 0.2, 0.1),
        (40, None, 0, None),
        (43, 1, 0, None),
    ],
)
def test_photos_recipe_chooses_by_their_number_and_the_sky(photographs, sky, dropout, most):
    settings = load("photos").settings
    chosen = choose(settings, {"photographs": photographs, **({} if sky is None else {"sky": sky})})
    training = chosen.training
    probabilities = [at_step(one.probability, training.steps) for one in training.modules if one.type == "dropout"]
    assert probabilities == ([dropout] if dropout else [])
    assert (training.keep, chosen.scene.validation) == ("last", 0)
    assert (chosen.model.background is not None) == (12 <= photographs < 40), "what is far away"
    growing = [stage for stage in training.during if isinstance(stage, Densify)]
    assert [one.per_pixel for one in growing] == [most, None]
    assert settings.training.modules[0].above == 0.2, "of a dataset that does not tell how good its cameras are"


def test_photos_recipe_of_many_photographs_is_fast():
    settings = load("photos").settings
    many, fast = choose(settings, {"photographs": 200, "sky": 1, "reprojection_error": 0.3}), load("fast").settings
    assert [getattr(one, "above", None) for one in many.training.modules] == [0.2]
    init, training, *others = many.stages
    alike = [init, training.model_copy(update={"modules": []}), *others]
    assert (alike, many.model) == (fast.stages, fast.model), "nothing is lost where there are many"


def test_photos_recipe_learns_poses_where_cameras_miss_points():
    training = choose(load("photos").settings, {"photographs": 20, "reprojection_error": 1}).training
    cameras, exposure = (one for one in training.modules if one.type in ("camera_optimizer", "exposure"))
    assert (cameras.start, exposure.above) == (500, 0.03)


SKY = "{keys: [model.sh_degree], by: [photographs, sky], values: [[[0, 0], 0], [[0, 0.5], 1], [[20, 0], 2]], since: x}"


def test_all_rows_of_the_recipe_for_photographs_go_together():
    """Whatever one measure is, where the others are."""
    settings, bounds = load("photos").settings, dict[str, set[float]]()
    for one in settings.choices:
        for row in one.values:
            for measure, bound in zip(one.measures, one.bounds(row), strict=True):
                bounds.setdefault(measure, set()).add(bound)
    found = [choose(settings, dict(zip(bounds, each, strict=True))) for each in product(*bounds.values())]
    assert len(found) == 18
    assert all(choice.reason for one in found for choice in one.choices)


def test_last_row_whose_bounds_are_all_reached_decides():
    settings = load("smoke", [f"choices=[{SKY}]"]).settings
    for measures, degree in (
        ({"photographs": 4}, 0),
        ({"photographs": 4, "sky": 0.4}, 0),
        ({"photographs": 4, "sky": 0.5}, 1),
        ({"sky": 1}, 1),
        ({"photographs": 20}, 2),
        ({"photographs": 90, "sky": 1}, 2),
    ):
        assert choose(settings, dict(measures)).model.sh_degree == degree
    (told,) = choose(settings, {"photographs": 4, "sky": 0.5}).choices
    assert told.reason == "4 training photographs, 50% of the training photographs show a sky; x"
    (told,) = choose(settings, {"points": 4}).choices
    assert (told.reason, told.chosen) == ("the dataset does not tell photographs, sky", [settings.model.sh_degree])


@pytest.mark.parametrize(
    ("known", "text"),
    [
        ({}, "=0; 1 if at least 50% of the training photographs show a sky; 2 if at least 20 training photographs"),
        ({"photographs": 19}, "=0; 1 if at least 50% of the training photographs show a sky"),
        ({"photographs": 20}, ""),
        ({"sky": 0.5}, "=1; 2 if at least 20 training photographs"),
    ],
)
def test_before_all_is_measured_it_says_what_can_be_chosen(known, text):
    (one,) = load("smoke", [f"choices=[{SKY}]"]).settings.choices
    assert one.is_settled(known) != bool(text)
    if text:
        assert one.possible(known) == f"model.sh_degree{text}"
    assert one.of({"photographs": 4, "sky": 1}, [3]).is_settled(known), "what a run chose stays"


def test_a_measure_is_asked_for_where_a_row_depends_on_it():
    (one,) = load("smoke", [f"choices=[{SKY}]"]).settings.choices
    assert one.depends("sky", {"photographs": 19})
    assert not one.depends("sky", {"photographs": 20})
    assert not one.depends("points", {"photographs": 19})


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("[[0, 0], 0]", "[0, 0]", "as 'by' is"),
        ("[photographs, sky]", "sky", "as 'by' is"),
        ("[[0, 0.5], 1]", "[[0], 1]", "a bound of each of photographs, sky, got 1"),
        ("[[0, 0.5], 1]", "[[0, .nan], 1]", "finite numbers"),
        ("[[0, 0.5], 1]", "[[0, 0], 1]", "growing finite numbers"),
        ("[[0, 0.5], 1]", "[[0, null], 1]", "growing finite numbers"),
        ("[[20, 0], 2]", "[[0, 0.4], 2]", "growing finite numbers"),
        ("[photographs, sky]", "[sky]", "got \\['sky'\\]"),
        ("[photographs, sky]", "[sky, sky]", "each once"),
    ],
)
def test_rows_of_several_measures_have_a_bound_of_each(old, new, complaint):
    with pytest.raises(ConfigError, match=complaint):
        load("smoke", [f"choices=[{SKY.replace(old, new)}]"])


@pytest.mark.parametrize(
    ("clear", "told"), [(True, "10 training photographs, 100%"), (False, "10 training photographs, 0%")]
)
def test_a_run_looks_for_a_sky_where_a_choice_asks(tmp_path, rng, clear, told):
    """Also at the photographs that are kept out to choose by."""
    asked = load("smoke", [f"scene.path='{Yard(rng, clear=clear).write(tmp_path / 'yard')}'", f"choices=[{SKY}]"])
    assert f"{told} of the training photographs show a sky" in describe(asked, tmp_path / "run", None, "new")
    kept_out = load("smoke", [f"scene.path='{tmp_path / 'yard'}'", f"choices=[{SKY}]", "scene.validation=auto"])
    assert f"{told} of the training photographs show a sky" in describe(kept_out, tmp_path / "run", None, "new")


def test_a_run_does_not_look_for_a_sky_in_vain(tmp_path, rng, monkeypatch):
    monkeypatch.setattr("clsplat.training.modules.sky.SkyModule.measured", lambda run: pytest.fail("looked for a sky"))
    many = SKY.replace("[20, 0]", "[9, 0]")
    asked = load("smoke", [f"scene.path='{Yard(rng).write(tmp_path / 'yard')}'", f"choices=[{many}]"])
    assert "since 10 training photographs; x" in describe(asked, tmp_path / "run", None, "new")


def test_transparent_photographs_do_not_tell_of_a_sky(tiny_scene, tmp_path):
    asked = load("smoke", [f"scene.path='{tiny_scene}'", f"choices=[{SKY}]"])
    assert "since 8 training photographs, the dataset does not tell sky; x" in describe(
        asked, tmp_path / "run", None, "new"
    )


def test_a_limit_of_growth_is_beside_rules_that_grow(tmp_path):
    """A choice for the first densify of a copy that has lost an earlier part would reach the wrong one."""
    copied = load("photos").path.read_text()
    edited = "\n".join(line for line in copied.splitlines() if "raise_sh" not in line)
    (tmp_path / "own.yaml").write_text(edited)
    with pytest.raises(ConfigError, match="no rule here grows"):
        load(str(tmp_path / "own.yaml"))


@pytest.mark.parametrize(
    "written", ["reason: so", "reason: so, chosen: [2], instead_of: [3, 3]", "chosen: [2], instead_of: [3]"]
)
def test_what_a_run_wrote_of_a_choice_goes_together(written):
    with pytest.raises(ConfigError, match="chosen and instead_of with a value of each of 1 keys, and reason"):
        load("smoke", [f"choices=[{DEGREE[:-1]}, {written}}}]"])


@pytest.mark.parametrize(
    ("choice", "complaint"),
    [
        (f"{DEGREE[:-1]}, reason: so, chosen: [1], instead_of: [q]}}", r"choices, instead_of: model.sh_degree: .*'q'"),
        (DEGREE.replace("model.sh_degree", "optimise.steps"), "choices: optimise.steps: no 'optimise'"),
        (DEGREE.replace("by: photographs", "by: photos"), r"choices\[0\].by: expected 'photographs'"),
        (DEGREE.replace("since: few say little", "since: 3"), r"choices\[0\].since: expected text, got 3"),
        (f"{DEGREE[:-1]}, given: abc}}", r"choices\[0\].given: expected keys and values, got 'abc'"),
    ],
)
def test_what_is_wrong_with_a_choice_is_told_with_its_place(choice, complaint):
    with pytest.raises(ConfigError, match=complaint):
        load("smoke", [f"choices=[{choice}]"])


def test_a_choice_given_no_mapping_is_told_beside_an_override(tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text(load("smoke").path.read_text() + f"choices:\n  - {DEGREE[:-1]}, given: null}}\n")
    with pytest.raises(ConfigError, match=r"given: expected keys and values"):
        load(str(file), ["optimize.steps=9"])


def test_an_override_inside_of_one_that_was_given_wins(tmp_path):
    chosen = choose(load("photos", ["optimize.modules.camera_optimizer={start: 3}"]).settings, {"photographs": 20})
    file = tmp_path / "pipeline.yaml"
    file.write_text(yaml_text(replace(load("photos"), settings=chosen).resolved()))
    settings = load(str(file), ["optimize.modules.camera_optimizer.start=10"]).settings
    assert [one.start for one in settings.training.modules if one.type == "camera_optimizer"] == [10]
    assert [one.given for one in settings.choices] == [{}] * 5


def test_of_several_measures_those_that_are_missing_are_told():
    reason = choose(load("photos").settings, {"photographs": 20}).choices[2].reason
    assert reason.startswith("20 training photographs, the dataset does not tell sky; few do not hold up")


def test_a_number_of_photographs_agrees_with_its_noun():
    assert [text_of("photographs", count) for count in (1, 2.0, 1200)] == [
        "1 training photograph",
        "2 training photographs",
        "1,200 training photographs",
    ]
