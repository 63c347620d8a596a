"""Color corrections per photograph: parameters, table, and whole runs."""

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.core.errors import ConfigError
from clsplat.core.schedule import at_step
from clsplat.photos.appearance import IDENTITY, ViewTable
from clsplat.pipeline.loading import load
from clsplat.training.modules.exposure import Affine, Exposure, ExposureState, Gain

MODELS = pytest.mark.parametrize("model", [Gain(), Affine()], ids=lambda model: model.type)


@MODELS
def test_parameter_derivatives_match_those_of_the_matrix(rng, model):
    row, grad_matrix, step = rng.normal(0, 0.2, len(model.columns)), rng.normal(size=(3, 4)), 1e-5
    values = [
        ((grad_matrix * (model.matrix(row + change) - model.matrix(row - change))).sum() / (2 * step))
        for change in step * np.eye(len(row))
    ]
    assert model.gradient(row, grad_matrix) == pytest.approx(np.array(values), rel=1e-6, abs=1e-9)
    penalties = [
        (model.penalty(row + change)[0] - model.penalty(row - change)[0]) / (2 * step)
        for change in step * np.eye(len(row))
    ]
    assert model.penalty(row)[1] == pytest.approx(np.array(penalties), rel=1e-6, abs=1e-9)


def test_gain_matches_the_reference(rng):
    row = rng.normal(0, 0.3, 3)
    assert Gain().matrix(row) == pytest.approx(ref.gain_matrix(*row))


@MODELS
def test_gain_parameters_round_trip_and_zeros_are_identity(rng, model):
    gains = rng.normal(0, 0.3, 3)
    assert np.diag(model.matrix(model.from_gains(gains))) == pytest.approx(np.exp(gains))
    assert (model.matrix(np.zeros(len(model.columns))) == IDENTITY).all()
    assert model.penalty(np.zeros(len(model.columns)))[0] == 0


@MODELS
def test_fit_recovers_the_matrix_of_an_image(rng, model):
    image, made = rng.uniform(0, 0.6, (500, 3)), model.from_gains(np.array([0.2, -0.1, 0.3]))
    matrix = model.matrix(made)
    photograph = image @ matrix[:, :3].T + matrix[:, 3]
    assert model.fit_matrix(image, photograph) == pytest.approx(matrix)
    assert np.isfinite(model.fit_matrix(image[:0], photograph[:0])).all()
    assert model.fit_matrix(np.zeros((9, 3)), np.zeros((9, 3))).shape == (3, 4)


def test_table_changes_its_views_row_and_keeps_means_at_zero(rng):
    table, scalars = ViewTable("t", ("a", "b/c", "d"), ("x", "y")), {"other": 1.0}
    assert not table.is_in(scalars)
    table.begin(scalars, {"a": np.array([0.3, 0.0]), "d": np.array([0.0, 0.6])})
    assert table.is_in(scalars)
    assert table.row(scalars, "a") == pytest.approx([0.2, -0.2])
    before = {view: table.row(scalars, view) for view in table.views}
    table.update(scalars, "b/c", np.array([2.0, -5.0]), rate=0.03)
    after = {view: table.row(scalars, view) for view in table.views}
    assert sum(after.values()) == pytest.approx([0, 0], abs=1e-15)
    moved = {view: after[view] - before[view] for view in table.views}
    assert moved["b/c"] == pytest.approx([-0.02, 0.02]), "by the rate, less the mean"
    assert moved["a"] == pytest.approx([0.01, -0.01])
    assert {key for key in scalars if key.endswith("updates")} == {"t/b/c/x/updates", "t/b/c/y/updates"}
    assert scalars["other"] == 1


def test_view_has_one_row_at_all_its_sizes():
    colors = ExposureState(Exposure(), ("a", "b", "a"))
    colors.rate = 0.01
    colors.start_from({})
    colors.learn(2, -IDENTITY, step=1)
    assert colors.matrix(0)[0, 0] == colors.matrix(2)[0, 0] > 1 > colors.matrix(1)[0, 0]


def test_rates_follow_how_often_a_photograph_is_visited():
    few, many = Exposure().rate_schedule(7000, 50), Exposure().rate_schedule(30_000, 50)
    assert [at_step(few, step) for step in (0, 7000)] == pytest.approx([1e-2, 1e-3])
    assert [at_step(many, step) for step in (0, 30_000)] == pytest.approx([2e-3, 2e-5])
    unknown = [Exposure().rate_schedule(steps, 50, is_warm_start=False) for steps in (500, 7000, 30_000)]
    assert [at_step(rate, 0) for rate in unknown] == pytest.approx([0.05, 0.0183, 0.00426], rel=0.01)
    reach = [
        sum(at_step(rate, step) for step in range(1, steps, 50))
        for steps, rate in zip((7000, 30_000), unknown[1:], strict=True)
    ]
    assert reach == pytest.approx([1, 1], rel=0.05), "as far as a gain of e"
    assert Exposure(rate=0.5).rate_schedule(7000, 50) == 0.5


@pytest.mark.parametrize("rate", ["1000", "{initial: 0.1, final: 2, over: 9}", "-1"])
def test_rate_out_of_range_is_refused(rate):
    with pytest.raises(ConfigError, match=r"expected values (of at most 0\.5|at least 0)"):
        load("smoke", [f"optimize.modules.exposure={{rate: {rate}}}"])


def test_key_accepts_names_and_mappings():
    def modules(setting: str):
        return load("smoke", [f"optimize.modules.exposure={setting}"]).settings.training.modules

    assert load("smoke").settings.training.modules == []
    assert modules("{}") == [Exposure()] == [Exposure(model=Gain())]
    assert modules("{model: {type: affine, weight: 0.1}}") == [Exposure(model=Affine(weight=0.1))]
    assert modules("{when: auto, model: affine}") == [Exposure(when="auto", model=Affine())]
