"""Settings that follow from the photographs: decisions, records, overrides, refusals, and plug-ins."""

from dataclasses import replace
from pathlib import Path

import pytest

import clsplat
from clsplat.core.errors import ConfigError
from clsplat.pipeline import plugins
from clsplat.pipeline.loading import apply_adaptation, load
from clsplat.pipeline.stretching import stretch_to_steps
from clsplat.runs.describe import describe
from clsplat.runs.state import RunState
from clsplat.scene.quality import Measures
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow
PLUGIN = """
from typing import Literal
from clsplat.plugin import Adaptation, Decision

class Counted(Adaptation):
    type: Literal["counted"] = "counted"
    key: str = "model.sh_degree"

    def decide(self, training, measures):
        degree = 1 if measures.photograph_count >= 8 else 0
        yield Decision(key=self.key, value=degree, reason=f"{measures.photograph_count} photos")
        yield Decision(key="optimize.modules.dropout", value={"probability": 0.1}, reason="so it is")
"""
ADAPT = "adapt=counted"


@pytest.fixture(autouse=True)
def plugin(tmp_path: Path, without_plugins: None) -> None:
    (tmp_path / "counted.py").write_text(PLUGIN)
    plugins.load_file(tmp_path / "counted.py")


def adapted_pipeline(name: str, *overrides: str, count: int = 9, error: float | None = None):
    return apply_adaptation(load(name, list(overrides)), Measures(count, error))


@pytest.mark.parametrize("photographs", [4, 11, 12, 39, 40])
def test_photos_recipe_adapts_to_the_number_of_photos(photographs):
    settings = adapted_pipeline("photos", count=photographs).settings
    few, training, init = photographs < 40, settings.optimize, settings.stages[0]
    modules = {module.type: module for module in training.modules}
    assert (init.transparent, init.count) == (("random", 100_000) if few else ("hull", 60_000))
    assert modules.keys() == {"exposure", *(("random_background",) if few else ())}
    if few:
        assert modules["random_background"].when == "transparent"
    assert modules["exposure"].min_spread == 0.2
    assert (settings.model.background is not None) == (photographs >= 12)
    if not few:
        fast = load("fast").settings
        alike = [init, training.model_copy(update={"modules": []}), *settings.stages[2:]]
        assert alike == fast.stages, "nothing is lost where there are many"


def test_photos_recipe_shortens_schedules_with_steps():
    pipeline = load("photos")
    short = replace(pipeline, settings=stretch_to_steps(pipeline.settings, 1700))
    modules = {module.type: module for module in apply_adaptation(short, Measures(9, 2.0)).settings.optimize.modules}
    assert (modules["camera_optimizer"].start, modules["exposure"].min_spread) == (250, 0.03)


@pytest.mark.parametrize(
    ("override", "kept"),
    [
        ("model.sh_degree=2", ["model.sh_degree"]),
        ("model={sh_degree: 2}", ["model.sh_degree"]),
        ("optimize.modules.dropout.probability=0.3", ["optimize.modules.dropout"]),
        ("optimize.steps=7", []),
    ],
)
def test_set_key_is_not_adapted(override, kept, tmp_path):
    """Around a key of a decision or inside of it; also where a run has decided."""
    result = adapted_pipeline("smoke", ADAPT, override)
    assert result.settings.adapt.keep == kept
    assert not {decision.key for decision in result.decisions} & {*kept}
    (tmp_path / "run.yaml").write_text(adapted_pipeline("smoke", ADAPT).text())
    again = load(str(tmp_path / "run.yaml"), [override])
    assert (again.settings.adapt.keep, again.undecided) == (kept, [])
    assert [decision.key for decision in again.decisions] == [decision.key for decision in result.decisions]
    assert again.settings.model == result.settings.model


@pytest.mark.parametrize("override", ["adapt.keep=[model.near]", "adapt.decisions=[{key: seed, value: 3, reason: x}]"])
def test_key_without_a_decision_is_refused(override):
    with pytest.raises(ConfigError, match=r"does not set '(model.near|seed)'; expected one of"):
        load("photos", [override])


def test_decisions_are_repeated_for_other_photographs(tmp_path):
    file = tmp_path / "run.yaml"
    file.write_text(adapted_pipeline("smoke", ADAPT, "model.background={type: auto, chosen: on, reason: blue}").text())
    assert apply_adaptation(load(str(file)), Measures(3)).settings.model.sh_degree == 1, "what a run decided stays"
    other = load(str(file), ["scene.path=two"])
    assert other.undecided == ["model.sh_degree", "optimize.modules.dropout"]
    assert other.settings.model.background.chosen is None
    assert apply_adaptation(other, Measures(3)).settings.model.sh_degree == 0


def test_run_writes_its_decisions_and_repeats_them(tiny_scene, tmp_path):
    asked = [f"scene.path='{tiny_scene}'", *FEW, ADAPT]
    text = describe(load("smoke", asked), RunState.read(tmp_path / "run"), None, "new")
    assert "adapt          8 photos\n" in text
    out = clsplat.run("smoke", tiny_scene, tmp_path / "run", set=[*FEW, ADAPT])
    assert "INFO 8 photos\n" in (out / "log.txt").read_text()
    written = load(str(out / "pipeline.yaml"))
    assert [decision.key for decision in written.decisions] == ["model.sh_degree", "optimize.modules.dropout"]
    assert written.settings.plugins.keys() == {"counted"}
    plain = train(tiny_scene, tmp_path / "plain", *FEW, "model.sh_degree=1", "optimize.modules.dropout.probability=0.1")
    assert digest(plain.out) == digest(out)
    again = clsplat.run(out / "pipeline.yaml", out=tmp_path / "again")
    assert digest(again) == digest(out)
    state = RunState.read(out)
    assert state.is_complete(load("smoke", asked)), "the same command finds it up to date"
    with pytest.raises(ConfigError, match=r"model\.sh_degree was 1, is 2"):
        state.require_same(load("smoke", [*asked, "model.sh_degree=2"]))
    assert state.is_complete(load("smoke", [*asked, "model.sh_degree=1"]))


def test_undecided_keys_are_listed_before_preparation():
    result = clsplat.check("photos")
    assert result["adapts"][:2] == ["init.transparent", "init.count"]
    assert clsplat.check("fast")["adapts"] == []
    assert load("photos", ["init.count=3"]).undecided == [key for key in result["adapts"] if key != "init.count"]
    assert load("photos", ["adapt=null"]).undecided == []


@pytest.mark.parametrize(
    ("adapt", "complaint"),
    [
        ("{type: counted, key: model.sh_degre}", "adapt: counted: "),
        ("{type: counted, key: optimze.steps}", "adapt: counted: optimze.steps: no 'optimze'"),
        ("{type: counted, key: scene.downscale}", "scene.downscale cannot be adapted, since it is used before"),
        (
            "{type: counted, key: optimize.steps}",
            r"optimize\.steps.* override one of its keys with --set: optimize\.steps, ",
        ),
        ("photo", "no adaptation named 'photo'; did you mean 'photos'"),
        ("{type: photos, decisions: [{key: a, value: 1}]}", "'reason' is missing"),
    ],
)
def test_impossible_decision_is_refused_in_one_sentence(adapt, complaint):
    with pytest.raises(ConfigError, match=complaint):
        adapted_pipeline("smoke", f"adapt={adapt}", count=2)


def test_transparent_photos_have_a_reason(tiny_scene, tmp_path):
    text = describe(load("photos", [f"scene.path='{tiny_scene}'"]), RunState.read(tmp_path / "run"), None, "new")
    assert "random colors behind transparent pixels" in text
    assert "8 training photos with transparency: dropout" in text
    assert "silhouettes" not in text, "the dataset has points"
