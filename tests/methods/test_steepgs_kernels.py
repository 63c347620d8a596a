"""The splitting matrix and the rule that reads it (saddle.cl, steepgs.py), against float64 and finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Tol, relative_error
from clsplat.conformance.scenes import Case, random_case, safe_case
from clsplat.density.control import densify
from clsplat.density.edit import Edit, Rule
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.density.thresholds import SceneScale
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.mixture import covariance_matrices
from clsplat.losses.base import Comparison, ViewGradients
from clsplat.methods.adc import Clone, PruneFaint
from clsplat.methods.steepgs import MATRIX_COLUMNS, SplitSteepest, divide_logits, smallest_eigenvectors
from clsplat.opencl.device import Array, Device
from clsplat.render.rasterizer import Frame, Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.training.adam import Adam
from tests.support.devices import on_devices, on_one_setting

BACKGROUND = np.array([0.3, 0.6, 0.1], np.float32)
EXTENT = 2.0


def alphas(splats: ref.Splats, width: int, height: int, move=(0.0, 0.0)) -> np.ndarray:
    """Alpha of each splat, moved on the screen, at each pixel, [N,H,W]; nothing is skipped or capped."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    dx, dy = (splats.mean2d[:, k, None, None] + move[k] - pixel for k, pixel in ((0, x), (1, y)))
    a, b, c = (column[:, None, None] for column in splats.conic.T)
    return splats.opacity[:, None, None] * np.exp(-0.5 * (a * dx**2 + c * dy**2) - b * dx * dy)


def loss_of(alpha: np.ndarray, splats: ref.Splats, weights: np.ndarray) -> float:
    """Σ weights · image, blended from planes of alpha, [N,H,W]."""
    image, left = np.zeros(weights.shape), np.ones(weights.shape[1:])
    for i in np.argsort(splats.depth):
        image += splats.color[i][:, None, None] * alpha[i] * left
        left = left * (1 - alpha[i])
    return float(((image + BACKGROUND[:, None, None] * left) * weights).sum())


def split_planes(alpha: np.ndarray, n: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The planes with that of one splat replaced by two, one in front of the other."""
    result = alpha.copy()
    result[n] = 1 - (1 - one[n]) * (1 - other[n])
    return result


def uncapped_case(rng, opacity=(0.1, 0.7)) -> tuple[Case, ref.Splats, np.ndarray, np.ndarray]:
    """Six Gaussians that no pixel caps, weights of the loss, and their splitting matrices on the screen."""
    case = random_case(rng, 6, 24, 20)
    drawn = rng.uniform(*opacity, (6, 1))
    case.parameters["logit_opacity"][:] = np.log(drawn / (1 - drawn))
    splats, weights = case.project(ref.SMOOTH_THRESHOLDS), rng.normal(size=(3, 20, 24))
    return case, splats, weights, ref.splitting_matrices(splats, 24, 20, BACKGROUND, weights, ref.SMOOTH_THRESHOLDS)


def test_mean_of_two_shifts_changes_the_loss_by_the_matrix(rng):
    """ε²/2 vᵀ S v, and the error is of the fourth order."""
    _, splats, weights, matrices = uncapped_case(rng)
    alpha = alphas(splats, 24, 20)
    before = loss_of(alpha, splats, weights)
    for n in range(6):
        v = rng.normal(size=2)
        expected, scale = v @ matrices[n] @ v / 2, np.abs(matrices[n]).max() * (v @ v)
        errors = []
        for step in (0.1, 0.05):
            mean = alpha.copy()
            mean[n] = (alphas(splats, 24, 20, step * v)[n] + alphas(splats, 24, 20, -step * v)[n]) / 2
            errors.append(abs((loss_of(mean, splats, weights) - before) / step**2 - expected))
        assert errors[0] < 0.02 * scale
        assert errors[1] == pytest.approx(errors[0] / 4, rel=0.1, abs=1e-9 * scale)


def test_two_half_opacities_equal_the_mean_to_second_order(rng):
    """Against the two in one place; the relative error falls with the opacity."""
    errors = []
    for opacity in (0.02, 0.01):
        again = np.random.default_rng(7)
        _, splats, weights, matrices = uncapped_case(again, (opacity, opacity))
        v, step, worst = again.normal(size=2), 0.02, 0.0
        first = replace(splats, opacity=splats.opacity / 2)
        alpha, both = alphas(splats, 24, 20), alphas(first, 24, 20)
        moved = [alphas(first, 24, 20, sign * step * v) for sign in (1, -1)]
        for n in range(6):
            change = loss_of(split_planes(alpha, n, *moved), splats, weights)
            change -= loss_of(split_planes(alpha, n, both, both), splats, weights)
            expected = v @ matrices[n] @ v / 2
            worst = max(worst, abs(change / step**2 - expected) / (np.abs(matrices[n]).max() * (v @ v)))
        errors.append(worst)
    assert errors[0] < 0.05
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.2)


@pytest.mark.parametrize(("far", "bound"), [(100.0, 0.05), (1000.0, 0.005)])
def test_scene_matrix_holds_where_perspective_is_constant(rng, far, bound):
    """Means moved in the scene, with splats that change their form: ten times as far with such a lens, as exact."""
    case, _, weights, _ = uncapped_case(rng)
    scene, eye = case.gaussians(), case.camera()
    away = eye.world_to_camera.copy()
    away[2, 3] += 4 * (far - 1)
    camera = replace(eye, world_to_camera=away, fx=far * eye.fx, fy=far * eye.fy)

    def projected(moved: np.ndarray) -> ref.Splats:
        own = ref.RawGaussians(scene.means + moved, scene.quats, scene.log_scales, scene.logit_opacity, scene.sh)
        return ref.project(own, camera, 0, thresholds=ref.SMOOTH_THRESHOLDS)

    still = projected(np.zeros(3))
    on_screen = ref.splitting_matrices(still, 24, 20, BACKGROUND, weights, ref.SMOOTH_THRESHOLDS)
    matrices, alpha = ref.scene_splitting_matrices(scene, camera, on_screen), alphas(still, 24, 20)
    before, step = loss_of(alpha, still, weights), 2e-3
    for n in range(6):
        v = rng.normal(size=3)
        mean = alpha.copy()
        mean[n] = sum(alphas(projected(sign * step * v), 24, 20)[n] for sign in (1, -1)) / 2
        actual = (loss_of(mean, still, weights) - before) / step**2
        error = abs(actual - v @ matrices[n] @ v / 2)
        assert error < bound * np.abs(matrices[n]).max() * (v @ v)


def make_view(frame: Frame, pixel_sums: Array) -> ViewGradients:
    """A view for statistics that read no photograph."""
    workspace = Workspace(pixel_sums.device)
    return ViewGradients(frame, Comparison(workspace, frame.camera, *[frame.image] * 3), [], pixel_sums)


def added_up(device: Device, case: Case, weights: np.ndarray, views: int = 1) -> tuple[np.ndarray, SplatStats]:
    """The column of a view that is seen several times, as the backward pass of the device gives it, [N,6]."""
    rasterizer, model, camera = Rasterizer(device, "radix"), case.model(device), case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.upload(BACKGROUND))
    planes = np.zeros((3, camera.rows, camera.stride), np.float32)
    planes[:, : camera.height, : camera.width] = weights
    pixel_sums = rasterizer.pixel_sums(model, frame, device.upload(planes))
    gradients = rasterizer.gradients(model, frame, pixel_sums)
    stats = SplatStats(model.gaussians, ["splitting", "screen_grad"])
    for _ in range(views):
        stats.add(make_view(frame, pixel_sums), gradients.mean2d)
    return model.gaussians.get("stats/splitting"), stats


@on_devices("count", [0, 16, 63, 64])
def test_column_matches_the_reference_matrix(device, rng, count):
    """Some Gaussians lie behind the camera and some beside the picture: nothing is added to them."""
    case = safe_case(rng, count, 33, 31, change=lambda p: p["means"].__setitem__(slice(2, None, 7), [0, 0, -9]))
    weights = rng.normal(size=(3, 31, 33)).astype(np.float32)
    actual, stats = added_up(device, case, weights, views=2)
    on_screen = ref.splitting_matrices(case.project(), 33, 31, BACKGROUND.astype(np.float64), weights)
    expected = ref.scene_splitting_matrices(case.gaussians(), case.camera(), on_screen)
    assert relative_error(actual, 2 * expected[:, *np.triu_indices(3)]) < Tol.GRADIENT
    assert (actual[2::7] == 0).all()
    np.testing.assert_allclose(stats.means("splitting"), np.where(stats.means("screen_grad") > 0, actual / 2, 0))
    stats.clear()
    assert not stats.means("splitting").any()


def test_nonfinite_gaussian_adds_nothing(device, rng):
    case = random_case(rng, 20)
    for name, row, value in (("means", 3, np.nan), ("quats", 5, np.nan), ("log_scales", 7, np.inf)):
        case.parameters[name][row] = value
    actual, _ = added_up(device, case, rng.normal(size=(3, 30, 40)).astype(np.float32))
    assert (actual[[3, 5]] == 0).all()
    assert np.isfinite(np.delete(actual, 7, axis=0)).all()


@on_one_setting
def test_schedules_agree(device, rng):
    case, weights = random_case(rng, 200, 60, 50), rng.normal(size=(3, 50, 60)).astype(np.float32)
    other = Device(device.info, "simt" if device.schedule == "wide" else "wide")
    actual, again = (added_up(item, case, weights)[0] for item in (device, other))
    assert relative_error(actual, again) < 1e-4


def test_smallest_axes_belong_to_each_matrix(rng):
    columns = rng.normal(size=(200, 6)) * 10.0 ** rng.integers(-9, 9, (200, 1))
    columns[0], columns[1], columns[2, 4], columns[3, 0] = 0, [1, 0, 0, 1, 0, 1], np.nan, -np.inf
    values, axes = smallest_eigenvectors(columns)
    for n in (0, 2, 3):
        assert values[n] == 0
    assert (axes[np.arange(200), np.abs(axes).argmax(axis=1)] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1)
    for n in range(4, 200):
        matrix = columns[n][MATRIX_COLUMNS]
        size = np.abs(matrix).max()
        np.testing.assert_allclose(matrix @ axes[n], values[n] * axes[n], atol=1e-12 * size)
        for v in rng.normal(size=(20, 3)):
            assert v @ matrix @ v / (v @ v) >= values[n] - 1e-12 * size


def test_opacities_of_two_children_follow_from_the_parents():
    logits = np.array([[-200.0], [-30.0], [-2.0], [0.0], [3.0], [40.0], [300.0]])
    opacity = 1 / (1 + np.exp(-logits[1:5]))
    halves, shared = (divide_logits(logits, kind) for kind in ("halved", "shared"))
    np.testing.assert_allclose(1 / (1 + np.exp(-halves[1:5])), opacity / 2, rtol=1e-12)
    np.testing.assert_allclose(1 / (1 + np.exp(-shared[1:5])), -np.expm1(np.log1p(-opacity) / 2), rtol=1e-9)
    for found in (halves, shared):
        np.testing.assert_allclose(found[0], -200 - np.log(2))
        assert np.isfinite(found).all()
    np.testing.assert_allclose(halves[5:], 0, atol=1e-12)


class Edited:
    """Gaussians with chosen splitting matrices, per view and in extents⁻², before and after an edit."""

    def __init__(self, device: Device, rng, columns: np.ndarray, screen_grad=1e-3) -> None:
        count = len(columns)
        self.gaussians = random_case(rng, count).model(device).gaussians
        self.tiler = Rasterizer(device, "radix").tiler
        Adam(self.gaussians)
        for table in [name for name in self.gaussians.tables if "moment" in name]:
            self.gaussians.set(table, np.ones((count, self.gaussians.tables[table].components)))
        self.stats = SplatStats(self.gaussians, {"screen_grad", "splitting"})
        self.gaussians.set(SEEN, np.full((count, 1), 4.0))
        self.gaussians.set("stats/splitting", 4 * columns / EXTENT**2)
        self.gaussians.set("stats/screen_grad", 4 * np.broadcast_to(screen_grad, count)[:, None])

    def apply(self, *rules, limit: int | None = None):
        self.before = {name: self.gaussians.get(name) for name in self.gaussians.tables}
        edit = Edit(self.gaussians, self.stats, SceneScale(EXTENT), step=700, seed=4)
        return densify(edit, rules, self.tiler, limit)

    def rows_of(self, source: int) -> np.ndarray:
        """Rows that carry the colors of an old row."""
        return np.flatnonzero((self.gaussians.get("sh_rest") == self.before["sh_rest"][source]).all(axis=1))


def diagonal(values) -> np.ndarray:
    """Columns of diagonal matrices, [N,3] to [N,6]."""
    columns = np.zeros((len(values), 6))
    columns[:, [0, 3, 5]] = values
    return columns


@on_one_setting
def test_children_are_along_the_axis_and_share_opacity(device, rng):
    least = np.array([-2e-6, -5e-7, 3e-6, -1.0, -2e-6] * 13)
    matrices = rng.permuted(np.stack([least, np.full(65, 4e-6), np.full(65, 5e-6)], axis=1), axis=1)
    axis = np.eye(3)[(matrices == least[:, None]).argmax(axis=1)]
    case = Edited(device, rng, diagonal(matrices))
    change = case.apply(SplitSteepest(distance=0.7, shrink=1.5, eigenvalue_below=-1e-6))
    chosen = least < -1e-6
    assert (change.before, change.after, change.grown) == (65, 65 + chosen.sum(), {"split_steepest": chosen.sum()})
    own = covariance_matrices(*(case.before[name].astype(np.float64) for name in ("quats", "log_scales")))
    way = 0.7 * np.sqrt(np.einsum("ni,nij,nj->n", axis, own, axis))[:, None] * axis
    opacity = 1 / (1 + np.exp(-case.before["logit_opacity"].astype(np.float64)))
    for source in range(65):
        rows = case.rows_of(source)
        after = {name: case.gaussians.get(name)[rows] for name in case.gaussians.tables}
        if not chosen[source]:
            for name in ("means", "log_scales", "logit_opacity", "adam/means/moment1"):
                np.testing.assert_array_equal(after[name], case.before[name][[source]])
            continue
        expected = case.before["means"][source] + np.stack([way[source], -way[source]])
        np.testing.assert_allclose(after["means"], expected, atol=1e-6)
        np.testing.assert_allclose(
            1 / (1 + np.exp(-after["logit_opacity"])), np.full((2, 1), opacity[source] / 2), 1e-5
        )
        np.testing.assert_allclose(
            after["log_scales"], case.before["log_scales"][[source] * 2] - np.log(1.5), atol=1e-5
        )
        for table in case.gaussians.tables:
            if "moment" in table or table.startswith("stats/"):
                assert (after[table] == 0).all(), table


@on_one_setting
def test_empty_model_does_not_change(device, rng):
    assert Edited(device, rng, np.zeros((0, 6))).apply(SplitSteepest()).after == 0


@on_one_setting
def test_candidates_exceed_the_gradient_and_are_unselected(device, rng):
    case = Edited(device, rng, diagonal(np.full((40, 3), -1.0)), screen_grad=np.tile([1e-4, 3e-4], 20))
    case.apply(SplitSteepest(gradient_above=2e-4))
    assert [len(case.rows_of(n)) for n in range(40)] == [1, 2] * 20
    case = Edited(device, rng, diagonal(np.full((40, 3), -1.0)))
    change = case.apply(Clone(size_below=1e9), SplitSteepest())
    assert change.grown == {"clone": 40, "split_steepest": 0}
    np.testing.assert_array_equal(case.gaussians.get("logit_opacity")[::2], case.before["logit_opacity"])


@on_one_setting
def test_lowest_eigenvalues_split_first_under_a_limit(device, rng):
    least = -rng.permutation(np.linspace(1e-3, 1, 50))
    case = Edited(device, rng, diagonal(least[:, None] * [1, 0.1, 0]))
    assert case.apply(SplitSteepest(), limit=57).after == 57
    assert {n for n in range(50) if len(case.rows_of(n)) == 2} == set(np.argsort(least)[:7])
    for limit in (50, 10):
        case = Edited(device, rng, diagonal(least[:, None] * [1, 0.1, 0]))
        assert case.apply(SplitSteepest(), limit=limit).after == 50
        np.testing.assert_array_equal(case.gaussians.get("logit_opacity"), case.before["logit_opacity"])


@on_one_setting
def test_undone_or_pruned_split_leaves_other_gaussians(device, rng):
    """A later rule grows too, beyond the limit: what is undone keeps opacity and place."""
    count = 40
    columns = diagonal((np.where(np.arange(count) % 2, -1.0, 1.0) * (1 + np.arange(count)))[:, None] * np.ones(3))
    case = Edited(device, rng, columns, screen_grad=np.linspace(1e-3, 1, count))
    logits = np.where(np.arange(count) < 5, -7.0, 1.0)[:, None]
    case.gaussians.set("logit_opacity", logits)
    change = case.apply(SplitSteepest(), Clone(size_below=1e9), PruneFaint(), limit=50)
    assert change.after == 50
    for n in range(count):
        rows = case.rows_of(n)
        assert len(rows) == (0 if n < 5 else 2 if n >= 25 else 1)
        if len(rows) == 1:
            np.testing.assert_array_equal(case.gaussians.get("means")[rows], case.before["means"][[n]])
        halved = n % 2 == 1 and len(rows) == 2
        actual = 1 / (1 + np.exp(-case.gaussians.get("logit_opacity")[rows, 0]))
        np.testing.assert_allclose(actual, (0.5 if halved else 1) / (1 + np.exp(-1)), rtol=1e-5)


class Double(Rule):
    """Copies every Gaussian."""

    def mark(self, edit: Edit) -> None:
        edit.choose(np.ones(edit.gaussians.count, bool), copies=2, old_rows=1)


@on_one_setting
def test_growth_is_undone_without_a_scalar_column(device, rng):
    case = Edited(device, rng, diagonal(np.zeros((50, 3))))
    case.stats = SplatStats(case.gaussians, {"splitting"})
    assert case.apply(Double(), limit=57).after == 57


@on_one_setting
def test_child_settings_are_validated(device, rng):
    case = Edited(device, rng, diagonal(np.zeros((9, 3))))
    edit = Edit(case.gaussians, case.stats, SceneScale(EXTENT), step=700, seed=4)
    for rows, values, words in (
        ([1, 2], np.zeros((2, 3)), r"means: expected \[2, copies, 3\], got \[2, 3\]"),
        ([1, 2], np.zeros((1, 2, 3)), r"means: expected \[2, copies, 3\], got \[1, 2, 3\]"),
        ([1, 2], np.zeros((2, 2, 1)), r"means: expected \[2, copies, 3\], got \[2, 2, 1\]"),
        ([1, 1], np.zeros((2, 2, 3)), "expected each row once"),
        ([9], np.zeros((1, 2, 3)), r"expected integers in \[0, 9\), got 9"),
    ):
        with pytest.raises(ValueError, match=words):
            edit.set_children("means", np.array(rows), values)


def test_scalar_rules_refuse_the_matrix_statistic():
    with pytest.raises(ValueError, match="screen_grad_abs"):
        Clone(statistic="splitting")


@on_one_setting
def test_gaussian_between_two_blobs_escapes_its_saddle(device):
    """Its gradient is zero by symmetry, so that no gradient splits it; the matrix does, and the loss falls."""
    case = random_case(np.random.default_rng(0), 1, 48, 32)
    camera = case.camera()
    ahead = np.array([(24 - camera.cx) / camera.fx, (16 - camera.cy) / camera.fy, 1]) * 4
    p = case.parameters
    p["means"][:] = camera.rotation.T @ (ahead - camera.translation)
    p["log_scales"][:] = np.log(0.35)
    p["quats"][:] = [1, 0, 0, 0]
    p["logit_opacity"][:], p["sh_base"][:], p["sh_rest"][:] = 0.0, 1.0, 0.0
    x, y = np.meshgrid(np.arange(48) + 0.5 - 24, np.arange(32) + 0.5 - 16)
    blobs = sum(np.exp(-((x - side) ** 2 + y**2) / 8) for side in (-5, 5))
    background = np.zeros(3)

    def loss(gaussians: Gaussians) -> tuple[float, np.ndarray]:
        q = {name: gaussians.get(name).astype(np.float64) for name in p}
        own = Case({name: table.astype(np.float32) for name, table in q.items()}, case.view)
        image, *_ = ref.blend(own.project(), 48, 32, background)
        return ref.l2(image, np.broadcast_to(blobs * 0.5, image.shape))

    model = case.model(device)
    before, gradient = loss(model.gaussians)
    rasterizer, view = Rasterizer(device, "radix"), case.device_camera(device)
    frame = rasterizer.forward(model, view, device.zeros(3))
    planes = np.zeros((3, view.rows, view.stride), np.float32)
    planes[:, :32, :48] = gradient
    pixel_sums = rasterizer.pixel_sums(model, frame, device.upload(planes))
    mean2d = rasterizer.gradients(model, frame, pixel_sums).mean2d
    stats = SplatStats(model.gaussians, {"splitting", "screen_grad"})
    stats.add(make_view(frame, pixel_sums), mean2d)
    assert stats.mean("screen_grad")[0] < 2e-5
    scale = SceneScale(1.0)
    assert densify(Edit(model.gaussians, stats, scale, 700, 4), [Clone(size_below=9.0)], rasterizer.tiler).after == 1
    stats.add(make_view(frame, pixel_sums), mean2d)
    edit = Edit(model.gaussians, stats, scale, 700, 4)
    assert densify(edit, [SplitSteepest(gradient_above=0.0)], rasterizer.tiler).after == 2
    apart = camera.rotation @ np.diff(model.gaussians.get("means"), axis=0)[0]
    assert abs(apart[0]) > 20 * abs(apart[1])
    assert loss(model.gaussians)[0] < before
