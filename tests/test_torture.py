"""The long form of the tests begins: a few kills of it."""

import os

import pytest

from data_tools.synthetic import Options, write_dataset

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(os, "fork"), reason="attempts are forked")]


def test_a_few_kills(tmp_path):
    from tests.torture.kills import kills

    write_dataset(tmp_path / "scene", Options(size=40, train=8, test=2, seed=0), workers=1)
    *_, tally = kills(tmp_path / "scene", tmp_path / "runs", 2)
    assert tally["killed"] >= 2
    assert tally["equal"] == tally["finished"] > 0
