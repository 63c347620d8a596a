"""Old names of keys: read for one more release, with a warning that shows the new name."""

import logging
import re
from pathlib import Path

import pytest

from clsplat import resource_dir
from clsplat.errors import ConfigError
from clsplat.pipeline.loading import load
from clsplat.training.records import Records

OLD = """\
name: recipe
scene: {downscale: 2, sampling: code}
stages:
  - init
  - optimize:
      steps: 10
      rates:
        means: {start: 1.6e-3, stop: 1.6e-4, over: 50}
        quats: 1.0e-3
      losses: [l1]
      during:
        - densify:
            every: 5
            start: 2
            stop: 8
            rules:
              - {type: clone}
              - {type: prune_large, after: 3000}
  - densify:
      rules: [{type: prune_faint, after: 7}]
  - evaluate: {scales: [1, 2]}
"""
NEW = """\
name: recipe
scene: {downscale: 2}
stages:
  - init
  - optimize:
      steps: 10
      rates:
        means: {initial: 1.6e-3, final: 1.6e-4, over: 50}
        quats: 1.0e-3
      views: {order: code}
      losses: [l1]
      during:
        - densify:
            every: 5
            start: 2
            stop: 8
            rules:
              - {type: clone}
              - {type: prune_large, start: 3000}
  - densify:
      rules: [{type: prune_faint, start: 7}]
  - evaluate: {downscales: [1, 2]}
"""
WARNINGS = [
    ("scene.sampling", "optimize.views.order: code"),
    ("optimize.rates.means: {start, stop}", "{initial, final}"),
    ("prune_large.after", "start"),
    ("prune_faint.after", "start"),
    ("evaluate.scales", "downscales"),
]


@pytest.fixture
def write(tmp_path: Path):
    def write(text: str) -> str:
        (tmp_path / "recipe.yaml").write_text(text)
        return str(tmp_path / "recipe.yaml")

    return write


def test_old_keys_mean_what_the_new_ones_do_and_warn_once_each(write, caplog):
    with caplog.at_level(logging.WARNING, "clsplat"):
        old = load(write(OLD))
    shown = [re.findall(r"'([^']*)' has a new name, '([^']*)'", record.message) for record in caplog.records]
    assert shown == [[names] for names in WARNINGS]
    assert all("recipe.yaml" in record.message and "\n" not in record.message for record in caplog.records)
    caplog.clear()
    new = load(write(NEW))
    assert not caplog.records
    assert old.resolved() == new.resolved()
    assert old.text() == new.text()


def test_an_old_key_may_be_set_on_the_command_line(write, caplog):
    quats = "optimize.rates.quats={start: 0.1, stop: 0.01, over: 9}"
    set_old = load(write(NEW), ["scene.sampling=paper", quats, "evaluate.scales=[4]"])
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 3
    quats = "optimize.rates.quats={initial: 0.1, final: 0.01, over: 9}"
    new = load(write(NEW), [quats, "optimize.views.order=paper", "evaluate.downscales=[4]"])
    assert set_old.resolved() == new.resolved(), "the key of --set, where both are given"
    both = ["optimize.views.order=code", "scene.sampling=paper", "densify.rules.0.start=9", "densify.rules.0.after=8"]
    both = [text.replace("densify", "stages.2") for text in both]
    expected = load(write(NEW), ["optimize.views.order=paper", "stages.2.rules.0.start=8"])
    assert load(write(NEW), both).resolved() == expected.resolved(), "the later one"


@pytest.mark.parametrize(("new", "old", "words"), [
    ("scene: {downscale: 2}", "scene: {sampling: paper}", "'optimize.views.order' .* 'scene.sampling'"),
    ("{type: prune_faint,", "{type: prune_faint, after: 5,", "'prune_faint.start' .* 'prune_faint.after'"),
    ("{initial: 1.6e-3,", "{stop: 1, initial: 1.6e-3,", "'optimize.rates.means.final' .* 'optimize.rates.means.stop'"),
])  # fmt: skip
def test_the_old_and_the_new_key_in_one_file_are_refused(write, new, old, words):
    assert new in NEW
    with pytest.raises(ConfigError, match=rf"recipe.yaml: {words}, and both are given; remove"):
        load(write(NEW.replace(new, old)))


def test_every_loop_takes_the_old_order_of_views(write):
    second = "  - optimize: {steps: 5, losses: [l2]}\n"
    resolved = load(write(OLD + second)).resolved()
    loops = [stage["optimize"] for stage in resolved["stages"] if "optimize" in stage]
    assert [loop["views"]["order"] for loop in loops] == [{"type": "code"}] * 2


def test_shipped_pipelines_have_no_old_names(caplog):
    for path in sorted(resource_dir("pipelines").glob("*.yaml")):
        load(path.stem)
    assert not [record.message for record in caplog.records if "new name" in record.message]


def test_records_of_older_runs_have_the_new_name_of_the_divisor(tmp_path):
    (tmp_path / "metrics.jsonl").write_text(
        '{"step": 5, "kind": "evaluate", "split": "test", "scale": 2.0, "psnr": 30}\n'
    )
    assert Records(tmp_path).read("evaluate") == [
        {"step": 5, "kind": "evaluate", "split": "test", "downscale": 2.0, "psnr": 30}
    ]
