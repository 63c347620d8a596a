"""Edges of photographs that repeat the line beside them: each edge, plain ones, unreadable files, and what is said."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from clsplat.prepare.inspect.facts import EDGES, WIDEST, filled, padding
from clsplat.prepare.inspect.findings import Inspection, findings
from tests.support.data_sets import data_set

SIDES = dict(
    zip(EDGES, ((0, 0, 1, 0), (1, 0, 0, 0), (0, 0, 0, 1), (0, 1, 0, 0)), strict=True)
)  # top, bottom, left, right


def photograph(rng):
    return rng.integers(0, 256, (30, 60), np.uint8)


def bordered(grey, edge, px, kind=cv2.BORDER_REPLICATE):
    return cv2.copyMakeBorder(grey, *(px * side for side in SIDES[edge]), kind, value=0)


@pytest.mark.parametrize(("edge", "px"), list(zip(EDGES, (1, WIDEST, 3, WIDEST), strict=True)))
def test_the_lines_that_repeat_at_an_edge_are_counted(rng, edge, px):
    assert filled(bordered(photograph(rng), edge, px)) == [px if name == edge else 0 for name in EDGES]


@pytest.mark.parametrize("edge", EDGES)
def test_plain_borders_and_uniform_photographs_give_no_finding(rng, edge):
    assert filled(bordered(photograph(rng), edge, 3, cv2.BORDER_CONSTANT)) == [0] * 4
    stripes = bordered(photograph(rng)[:, :1], edge, 60)
    assert filled(stripes)[EDGES.index(edge)] == 0
    assert filled(np.zeros((1, 1), np.uint8)) == [0] * 4


def test_an_enlarged_a_soft_and_a_faint_photograph_say_nothing(rng):
    assert filled(photograph(rng).repeat(3, axis=0).repeat(3, axis=1)) == [0] * 4
    soft = np.linspace(0, 200, 60)[None] / 4 + np.linspace(0, 100, 30)[:, None]
    assert filled(bordered(soft.astype(np.uint8), "left", 3)) == [0] * 4
    faint = bordered((photograph(rng) / 12).astype(np.uint8), "left", 3)
    assert filled(faint) == [0] * 4


def test_all_of_the_first_photographs_have_what_is_found(rng, tmp_path):
    files = [tmp_path / f"{i}.png" for i in range(3)]
    for file, px in zip(files, (4, 2, 3), strict=True):
        cv2.imwrite(str(file), bordered(bordered(photograph(rng), "right", px), "top", px - 2))
    assert padding(files) == {"right": 2}
    assert padding([]) == {}
    files[1].write_bytes(b"nothing")
    assert padding(files) == {}


def said(inspection):
    return [one.text for one in inspection.findings if "repeat the pixels" in one.fault]


def test_an_inspection_names_them():
    inspection = Inspection.of(data_set("fox_peers"))
    assert ["(3 px right)" in one for one in said(inspection)] == [True]
    masked = replace(inspection.facts, photos=replace(inspection.facts.photos, masks=50))
    assert not any("repeat the pixels" in one.fault for one in findings(masked))
    assert not said(Inspection.of(data_set("fox")))
