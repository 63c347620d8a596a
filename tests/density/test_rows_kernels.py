"""gather.cl and density.cl: rows that the host sets or zeroes, and Gaussians that it selects."""

import numpy as np
import pytest

from clsplat.conformance.scenes import random_case
from clsplat.core.errors import MemoryLimitError
from clsplat.density.control import apply_edit, densify
from clsplat.density.edit import Edit, Rule
from clsplat.density.statistics import SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.structs import moment_tables
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.tiles import Tiler
from clsplat.render.workspace import Workspace
from clsplat.training.adam import Adam
from tests.support.devices import each_once, on_devices, on_one_setting

COUNT = 150
ROWS = (0, 1, 15, 16, 17, 63, 64, 65, COUNT)


def gaussians_of(device, rng, count: int = COUNT) -> Gaussians:
    """Gaussians with moments and statistics that are not zero."""
    gaussians = random_case(rng, count).model(device).gaussians
    Adam(gaussians)
    SplatStats(gaussians)
    for name, table in gaussians.tables.items():
        if "/" in name:
            gaussians.set(name, rng.uniform(1, 2, (count, table.components)))
    return gaussians


def edit_of(gaussians: Gaussians, step: int = 600, seed: int = 3) -> Edit:
    return Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), step, seed)


@on_devices("count, name", each_once(ROWS, ["means", "logit_opacity", "sh_rest"]))
def test_setting_rows_leaves_other_rows(device, rng, count, name):
    gaussians = gaussians_of(device, rng)
    rows = rng.permutation(COUNT)[:count]
    values = rng.normal(size=(count, gaussians.tables[name].components))
    before = {table: gaussians[table].get() for table in gaussians.tables}
    edit_of(gaussians).set_rows(name, rows, values)
    before[name][:, rows] = values.T.astype(np.float32)
    for table, planes in before.items():
        np.testing.assert_array_equal(gaussians[table].get(), planes, err_msg=table)


@on_one_setting
def test_rows_of_another_shape_are_refused(device, rng):
    gaussians = gaussians_of(device, rng)
    with pytest.raises(ValueError, match=r"means: expected the shape \(2, 3\), got \(2, 4\)"):
        gaussians.set_rows("means", np.arange(2), np.zeros((2, 4)))


WRONG_ROWS = {
    "a mask": (np.arange(COUNT) % 2 == 0, r"rows: expected integers \[n\], got bool \[150\]; np.flatnonzero gives"),
    "numbers with a fraction": (np.array([1.0]), r"rows: expected integers \[n\], got float64 \[1\]"),
    "two dimensions": (np.array([[1]]), r"rows: expected integers \[n\], got int64 \[1, 1\]"),
    "a negative row": (np.array([3, -1]), r"rows: expected integers in \[0, 150\), got -1"),
    "a row that is too large": (np.array([149, 150], np.uint32), r"rows: expected integers in \[0, 150\), got 150"),
    "a row twice": (np.array([7, 2, 7]), "rows: expected each row once, got row 7 2 times"),
}


@on_devices("case, verb", each_once(WRONG_ROWS, ["set_rows", "zero_moments", "zero_rows"]))
def test_wrong_rows_are_refused_and_change_nothing(device, rng, verb, case):
    rows, message = WRONG_ROWS[case]
    gaussians = gaussians_of(device, rng)
    before = {table: gaussians[table].get() for table in gaussians.tables}
    verbs = {
        "set_rows": lambda: edit_of(gaussians).set_rows("means", rows, np.zeros((len(rows), 3))),
        "zero_moments": lambda: edit_of(gaussians).zero_moments(rows),
        "zero_rows": lambda: gaussians.zero_rows(["means"], rows),
    }
    with pytest.raises(ValueError, match=message):
        verbs[verb]()
    for table, planes in before.items():
        np.testing.assert_array_equal(gaussians[table].get(), planes, err_msg=table)


WRONG_CHOICES = {
    "indices": ((np.arange(3), 0, 0), r"mask: expected bool \[150\], got int64 \[3\]"),
    "a short mask": ((np.ones(149, bool), 0, 0), r"mask: expected bool \[150\], got bool \[149\]"),
    "negative copies": ((np.ones(COUNT, bool), -1, 0), "copies: expected a row count of 0 or more, got -1"),
    "one negative number": (
        (np.ones(COUNT, bool), np.arange(COUNT) - 2, 0),
        "copies: expected a row count of 0 or more, got -2",
    ),
    "short copies": (
        (np.ones(COUNT, bool), np.ones(3, int), 0),
        r"copies: expected an integer, or integers of shape \[150\], got int64 \[3\]",
    ),
    "copies with a fraction": ((np.ones(COUNT, bool), 1.5, 0), r"copies: expected an integer, or .*, got float64"),
    "copies beyond 32 bits": (
        (np.arange(COUNT) == 7, np.full(COUNT, 2**32), 0),
        "copies: expected a row count of at most 4294967294, got 4294967296",
    ),
    "negative number of old rows": (
        (np.ones(COUNT, bool), 2, -1),
        "old_rows: expected a row count of 0 or more, got -1",
    ),
}


@on_devices("case", WRONG_CHOICES)
def test_invalid_selection_is_refused(device, rng, case):
    arguments, message = WRONG_CHOICES[case]
    edit = edit_of(gaussians_of(device, rng))
    with pytest.raises(ValueError, match=message):
        edit.choose(*arguments)
    assert (edit.row_counts() == 1).all()


@on_one_setting
@pytest.mark.parametrize("numbers", [{"copies": -1, "old_rows": 0}, {"copies": 2, "old_rows": -1}])
def test_negative_row_counts_are_refused(device, rng, numbers):
    edit = edit_of(gaussians_of(device, rng))
    with pytest.raises(ValueError, match="expected a row count of 0 or more, got -1"):
        edit.mark(**numbers)


@on_one_setting
def test_edit_with_more_rows_than_32_bits_changes_nothing(device, rng):
    gaussians = gaussians_of(device, rng)
    before = {table: gaussians[table].get() for table in gaussians.tables}
    edit = edit_of(gaussians)
    edit.choose(np.ones(COUNT, bool), 2**32 // COUNT + 1, 1)
    with pytest.raises(
        MemoryLimitError, match="step 600: the rules would create more than 4,294,967,294 Gaussians; set"
    ):
        apply_edit(edit, Tiler(device, Workspace(device)))
    assert gaussians.count == COUNT
    for table, planes in before.items():
        np.testing.assert_array_equal(gaussians[table].get(), planes, err_msg=table)


@on_devices("count", ROWS)
def test_zeroing_moments_leaves_other_rows(device, rng, count):
    gaussians = gaussians_of(device, rng)
    rows = rng.permutation(COUNT)[:count]
    before = {table: gaussians[table].get() for table in gaussians.tables}
    edit_of(gaussians).zero_moments(rows, ("quats", "sh_rest"))
    for table in (*moment_tables("quats"), *moment_tables("sh_rest")):
        assert before[table][:, :COUNT].all()
        before[table][:, rows] = 0
    for table, planes in before.items():
        np.testing.assert_array_equal(gaussians[table].get(), planes, err_msg=table)


@on_one_setting
def test_moments_without_an_optimizer_need_no_zeroing(device, rng):
    gaussians = random_case(rng, 5).model(device).gaussians
    edit_of(gaussians).zero_moments(np.arange(5))
    assert not [name for name in gaussians.tables if name.startswith("adam/")]


@on_devices("count, old_rows", each_once([1, 15, 16, 17, 63, 64, 65, 150], [0, 1, 3]))
def test_each_selected_gaussian_gets_its_row_count(device, rng, count, old_rows):
    """`old_rows` of them are the old one, if there are as many; the first growth decides, and removal overrides."""
    edit = edit_of(gaussians_of(device, rng, count))
    expected = {"copies": np.ones(count), "old_rows": np.ones(count), "shrink": np.ones(count)}
    for shrink in (0.5, 0.25):
        chosen, copies = rng.random(count) < 0.7, rng.integers(0, 5, count)
        edit.choose(chosen, copies, old_rows, shrink)
        acts = chosen & ((copies == 0) | (expected["copies"] == 1))
        expected["copies"][acts] = copies[acts]
        expected["old_rows"][acts] = np.minimum(copies[acts], old_rows)
        expected["shrink"][acts & (copies > 0)] = shrink
    assert count < 60 or set(expected["copies"]) == {0, 1, 2, 3, 4}
    for name, values in expected.items():
        np.testing.assert_array_equal(getattr(edit, name).get(), values, err_msg=name)


class Multiply(Rule):
    """Give Gaussians the numbers of rows that a test has decided on."""

    copies: list[int]
    old_rows: int

    def mark(self, edit: Edit) -> None:
        edit.choose(np.ones(len(self.copies), bool), np.array(self.copies), self.old_rows)


@on_devices("old_rows", [1, 2])
def test_old_rows_keep_moments_and_new_rows_start_at_zero(device, rng, old_rows):
    gaussians = gaussians_of(device, rng, 65)
    copies = rng.integers(0, 5, 65)
    before = {name: gaussians.get(name) for name in gaussians.tables}
    rule = Multiply(copies=copies.tolist(), old_rows=old_rows)
    change = densify(edit_of(gaussians), [rule], Rasterizer(device, "radix").tiler)
    assert (change.before, change.after) == (65, copies.sum())
    source = np.repeat(np.arange(65), copies)
    fresh = np.concatenate([np.arange(number) for number in copies]) >= old_rows
    assert 0 < fresh.sum() < len(fresh)
    for name in PARAMETERS:
        np.testing.assert_array_equal(gaussians.get(name), before[name][source], err_msg=name)
        for moment in moment_tables(name):
            np.testing.assert_array_equal(gaussians.get(moment), np.where(fresh[:, None], 0, before[moment][source]))


class Relocate(Rule):
    """Put faint Gaussians where strong ones are: the number of Gaussians stays (a form of MCMC's relocation)."""

    def mark(self, edit: Edit) -> None:
        logits = edit.gaussians.get("logit_opacity")[:, 0]
        dead = np.flatnonzero(logits < np.quantile(logits, 0.3))
        weights = np.where(logits < np.quantile(logits, 0.3), 0, 1 / (1 + np.exp(-logits.astype(np.float64))))
        taken = edit.random().choice(len(logits), len(dead), p=weights / weights.sum())
        copies = 1 + np.bincount(taken, minlength=len(logits))
        copies[dead] = 0
        sources = np.flatnonzero(copies > 1)
        faded = logits[sources, None] - np.log(copies[sources, None])
        edit.set_rows("logit_opacity", sources, faded)
        edit.zero_moments(sources)
        edit.choose(copies != 1, copies, old_rows=1)


@on_one_setting
def test_relocation_keeps_the_number_of_gaussians(device, rng):
    """Copies have their source's place and its new opacity; sources forget their moments, bystanders do not."""
    gaussians = gaussians_of(device, rng)
    before = {name: gaussians.get(name) for name in gaussians.tables}
    change = densify(edit_of(gaussians), [Relocate()], Rasterizer(device, "radix").tiler)
    assert change.before == change.after == gaussians.count == COUNT
    after = {name: gaussians.get(name) for name in gaussians.tables}
    source = np.array([int(np.flatnonzero((before["sh_rest"] == row).all(axis=1))[0]) for row in after["sh_rest"]])
    copies = np.bincount(source, minlength=COUNT)
    assert (copies == 0).sum() == int(0.3 * COUNT)
    assert change.causes["rule"] == (copies != 1).sum()
    assert copies.max() > 2
    faded = before["logit_opacity"][:, 0] - np.log(np.maximum(copies, 1))
    np.testing.assert_allclose(after["logit_opacity"][:, 0], faded[source], rtol=1e-6)
    for moment in moment_tables("means"):
        alone = (copies[source] == 1)[:, None]
        np.testing.assert_array_equal(after[moment], np.where(alone, before[moment][source], 0))


@on_one_setting
def test_random_numbers_of_an_edit_depend_on_seed_step_and_rule(device, rng):
    gaussians = gaussians_of(device, rng)

    def drawn(step: int, seed: int, rule: int) -> list[float]:
        edit = edit_of(gaussians, step, seed)
        edit.rule = rule
        return edit.random().random(4).tolist()

    same = drawn(600, 3, 1)
    gaussians.set("means", gaussians.get("means") + 1)
    assert drawn(600, 3, 1) == same
    others = [drawn(601, 3, 1), drawn(600, 4, 1), drawn(600, 3, 2)]
    assert len({tuple(numbers) for numbers in (same, *others)}) == 4


@on_one_setting
def test_random_numbers_do_not_depend_on_earlier_rules(device, rng):
    """Its place in the list counts, not what came of the others."""
    seen = []

    class Watch(Rule):
        def mark(self, edit: Edit) -> None:
            seen.append((edit.rule, edit.random().random()))

    tiler = Rasterizer(device, "radix").tiler
    for start in (0, 1000):
        gaussians = gaussians_of(device, rng)
        densify(edit_of(gaussians), [Multiply(copies=[2] * COUNT, old_rows=1, start=start), Watch()], tiler)
    assert seen[0] == seen[1]
    assert seen[0][0] == 1
