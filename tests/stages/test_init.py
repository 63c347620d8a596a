"""A second `init` between two training stages starts over."""

import pytest

from tests.support.runs import train

PIPELINE = """\
name: again
model: {sh_degree: 1}
stages:
  - init: {source: random, count: 500, opacity: 0.3}
  - optimize: {steps: 4, losses: [l1], during: [{raise_sh: {every: 2}}, {average: {every: 1}}]}
  - init: {source: random, count: 700}
  - optimize: {steps: 4, losses: [l1]}
  - export
"""


@pytest.mark.slow
def test_second_init_discards_the_first_training(tiny_scene, tmp_path):
    (tmp_path / "x.yaml").write_text(PIPELINE)
    run = train(tiny_scene, tmp_path / "run", pipeline=str(tmp_path / "x.yaml"))
    assert run.model.gaussians.count == 700
    assert set(run.adam.updates.values()) == {4}
