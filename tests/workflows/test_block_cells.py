"""Cells, views of blocks, and joined models, for arbitrary Gaussians."""

from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.density.control import Box
from clsplat.formats import ply
from clsplat.formats.ply import join_plys, read_ply, write_ply
from clsplat.workflows.partition import Membership, assign_cells, quantile, split_space


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_gaussians_are_partitioned_into_equal_cells(rng, count):
    means = (rng.standard_normal((4000, 3)) * [20, 5, 1]).astype(np.float32)
    weights = rng.random(4000) * np.exp(means[:, 0] / 20)
    result = split_space(means, weights, count)
    held = np.stack([cell.box.contains(means) for cell in result])
    assert (held.sum(axis=0) == 1).all()
    np.testing.assert_array_equal(assign_cells(means, result), held.argmax(axis=0))
    np.testing.assert_allclose([weights[item].sum() for item in held], weights.sum() / count, rtol=0.03)
    far = np.array([[-1e9, 0, 0], [1e9, 1e9, 1e9], [0, -1e9, 1e9]])
    assert (np.stack([cell.box.contains(far) for cell in result]).sum(axis=0) == 1).all()


def test_only_long_sides_are_cut(rng):
    means = rng.standard_normal((2000, 3)) * [20, 5, 0.1]
    for cell in split_space(means, np.ones(2000), 4):
        assert (cell.box.low[2], cell.box.high[2]) == (None, None)


def test_cell_margin_is_half_the_share_per_bounded_side():
    left, right = split_space(np.array([[0.0, 0, 0], [1, 0, 0], [10, 0, 0], [12, 0, 0]]), np.ones(4), 2)
    assert 0 < left.box.high[0] == right.box.low[0] <= 10
    assert left.extended(0.2).high[0] == pytest.approx(left.box.high[0] + 0.1 * left.size[0])
    assert right.extended(0.2).low[0] == pytest.approx(right.box.low[0] - 0.1 * right.size[0])
    assert right.extended(0.2).high == [None] * 3


def test_empty_model_is_not_cut():
    with pytest.raises(DataError, match="has no Gaussians"):
        split_space(np.zeros((0, 3)), np.zeros(0), 2)


def test_coincident_positions_are_not_cut():
    with pytest.raises(DataError, match="5 Gaussians cannot be split into 2 blocks; use fewer --blocks"):
        split_space(np.ones((5, 3)), np.ones(5), 2)


def test_nonfinite_position_is_reported():
    means = np.array([[0.0, 0, 0], [np.nan, 0, 0]])
    with pytest.raises(DataError, match="1 of 2 Gaussians of the coarse model have positions that are not finite"):
        assign_cells(means, split_space(means[:1], np.ones(1), 1))


def test_quantile_follows_the_weights():
    assert quantile(np.array([3.0, 1, 2]), np.array([1.0, 8, 1]), 0.5) == 1
    assert quantile(np.array([3.0, 1, 2]), np.array([1.0, 1, 8]), 0.5) == 2


def test_views_belong_by_camera_by_coverage_or_to_the_best_block():
    share = np.array([[0.9, 0.2, 0.0], [0.04, 0.03, 0.0], [0.0, 0.0, 0.0]])
    inside = np.array([[False, False, False], [False, True, False], [False, False, False]])
    members = Membership(share, inside, min_coverage=0.05)
    chosen = [[True, True, True], [True, True, False], [True, False, False]]  # the last block has but a best view
    assert members.assignment.tolist() == chosen
    reasons = [members.reason(view, block) for view, block in ((0, 0), (1, 0), (1, 1), (0, 2))]
    assert reasons == ["coverage", "best", "inside", "best"]


def written(path: Path, rng: np.random.Generator, count: int, near: float = 0.2) -> dict[str, np.ndarray]:
    widths = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3, "sh_rest": 9}
    parameters = {name: rng.standard_normal((count, width)).astype(np.float32) for name, width in widths.items()}
    write_ply(path, parameters, {"near": near})
    return parameters


def test_joined_models_keep_row_order(rng, tmp_path, monkeypatch):
    monkeypatch.setattr(ply, "ROWS", 7)  # several pieces
    files = [tmp_path / f"{i}.ply" for i in range(3)]
    parts = [written(file, rng, count) for file, count in zip(files, (20, 1, 14), strict=True)]
    seen = []
    assert join_plys(tmp_path / "all.ply", files, lambda part, means: seen.append((part, means))) == 35
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    write_ply(tmp_path / "at_once.ply", whole, {"near": 0.2})
    assert (tmp_path / "all.ply").read_bytes() == (tmp_path / "at_once.ply").read_bytes()
    np.testing.assert_array_equal(np.concatenate([means for _, means in seen]), whole["means"])
    assert read_ply(tmp_path / "all.ply").rendering["near"] == 0.2


def test_incompatible_models_are_not_joined(rng, tmp_path):
    written(tmp_path / "a.ply", rng, 5)
    written(tmp_path / "b.ply", rng, 5, near=0.1)
    with pytest.raises(DataError, match=r"b\.ply: differs from .*a\.ply in properties or comments"):
        join_plys(tmp_path / "all.ply", [tmp_path / "a.ply", tmp_path / "b.ply"], lambda *_: None)
    (tmp_path / "b.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-3])
    with pytest.raises(DataError, match=r"b\.ply: is truncated; train that block again"):
        join_plys(tmp_path / "all.ply", [tmp_path / "a.ply", tmp_path / "b.ply"], lambda *_: None)
    assert not (tmp_path / "all.ply").exists()


def test_box_of_all_space_is_the_cell_of_one_block():
    (cell,) = split_space(np.zeros((3, 3)), np.zeros(3), 1)
    assert cell.box == cell.extended(0.2) == Box()
