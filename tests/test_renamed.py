"""Old names of keys: read for one more release, with a warning that shows the new name."""

import logging
import re
from pathlib import Path

import pytest

from clsplat import resource_dir
from clsplat.pipeline.loading import load

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
"""
WARNINGS = [
    ("scene.sampling", "optimize.views.order: code"),
    ("optimize.rates.means: {start, stop}", "{initial, final}"),
    ("prune_large.after", "start"),
    ("prune_faint.after", "start"),
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
    set_old = load(write(NEW), ["scene.sampling=paper", "optimize.rates.quats={start: 0.1, stop: 0.01, over: 9}"])
    assert [record.levelname for record in caplog.records] == ["WARNING"] * 2
    quats = "optimize.rates.quats={initial: 0.1, final: 0.01, over: 9}"
    new = load(write(NEW), [quats])
    assert set_old.resolved() == new.resolved(), "the new key, where both are given"


def test_every_loop_takes_the_old_order_of_views(write):
    second = "  - optimize: {steps: 5, losses: [l2]}\n"
    resolved = load(write(OLD + second)).resolved()
    loops = [stage["optimize"] for stage in resolved["stages"] if "optimize" in stage]
    assert [loop["views"]["order"] for loop in loops] == [{"type": "code"}] * 2


def test_shipped_pipelines_have_no_old_names(caplog):
    for path in sorted(resource_dir("pipelines").glob("*.yaml")):
        load(path.stem)
    assert not [record.message for record in caplog.records if "new name" in record.message]
