"""Models on the host: files, properties, row selection, and transforms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.api.renderer import Renderer
from clsplat.conformance.reference import sh_basis
from clsplat.conformance.scenes import add_world_filter, random_case
from clsplat.core.errors import OutputError
from clsplat.core.harmonics import basis, rotate_sh
from clsplat.gaussians.model import Model, Rendering, load
from clsplat.scene.view import View
from tests.support.devices import on_one_setting
from tests.support.html_page import HOSTILE, Page
from tests.support.models import WIDTHS, model_of


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return Rotation.from_quat(rng.normal(size=4)).as_matrix()


@pytest.mark.parametrize(("degree", "filtered"), list(zip(WIDTHS, (False, True, True, False), strict=True)))
def test_round_trip_gives_the_same_bytes(tmp_path, rng, degree, filtered):
    case = random_case(rng, 7)
    model = model_of(add_world_filter(case, rng) if filtered else case, degree)
    model = replace(model, rendering=Rendering(0.3, 0.1, 1.0, "white", "mask", {"version": "0"}))
    model.save(tmp_path / "a.ply")
    read = load(tmp_path / "a.ply")
    read.save(tmp_path / "b.ply")
    if not filtered:  # a standard deviation is written for the variance
        assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    for name, table in model.tables().items():
        np.testing.assert_allclose(getattr(read, name), table, rtol=3e-7 if name == "filter_variance" else 0)
    assert replace(read.rendering, notes={}) == replace(model.rendering, notes={})
    assert read.rendering.notes["version"] == "0"


def test_run_folder_is_a_model(tmp_path, rng):
    model_of(random_case(rng, 3)).save(tmp_path / "point_cloud.ply")
    assert len(load(tmp_path)) == 3


def test_properties_are_activated_values(rng):
    case = random_case(rng, 9)
    model = model_of(case)
    exact = case.gaussians()
    np.testing.assert_allclose(model.scales, np.exp(exact.log_scales), rtol=1e-6)
    np.testing.assert_allclose(model.opacities, 1 / (1 + np.exp(-exact.logit_opacity)), rtol=1e-6)
    np.testing.assert_allclose(model.colors, 0.5 + exact.sh[:, 0] * sh_basis(np.array([[0, 0, 1.0]]), 0)[0], atol=1e-6)
    assert (len(model), model.sh_degree, model.opacities.shape) == (9, 3, (9,))
    assert all(table.dtype == np.float32 for table in (model.scales, model.opacities, model.colors))


def test_rows_are_selected_by_mask_slice_or_index(rng):
    model = model_of(add_world_filter(random_case(rng, 9), rng), 1)
    mask = model.opacities > np.median(model.opacities)
    for chosen, rows in ((mask, np.flatnonzero(mask)), (slice(1, 8, 3), [1, 4, 7]), (4, [4]), ([5, 5], [5, 5])):
        some = model[chosen]
        for name, table in model.tables().items():
            np.testing.assert_array_equal(getattr(some, name), table[rows])
    assert len(model[:0]) == 0
    assert model[:0].sh_degree == 1


def test_model_shares_no_memory(rng):
    given = add_world_filter(random_case(rng, 9), rng).parameters
    model = Model(**given)
    for other in (given, model[:4].tables(), model[:].tables(), model.transformed().tables(), model.baked().tables()):
        for name, table in other.items():
            assert not np.shares_memory(table, getattr(model, name)), name


@on_one_setting
@pytest.mark.parametrize("degree", WIDTHS)
def test_moved_model_looks_the_same_to_a_moved_camera(device, rng, degree):
    case = add_world_filter(random_case(rng, 40, compensate=1.0), rng)
    model, scale, turn, shift = model_of(case, degree), 2.5, random_rotation(rng), rng.normal(size=3)
    pose = case.view.world_to_camera
    rotation = pose[:, :3] @ turn.T
    moved = np.column_stack([rotation, scale * pose[:, 3] - rotation @ shift])
    renderer = Renderer(model, device)
    before = renderer.render(case.view, depth=True)
    renderer.update(model.transformed(scale, turn, shift))
    after = renderer.render(replace(case.view, world_to_camera=moved), depth=True)
    assert before.image.std() > 0.05
    np.testing.assert_allclose(after.image, before.image, atol=1e-4)
    np.testing.assert_allclose(after.alpha, before.alpha, atol=1e-4)
    np.testing.assert_allclose(after.depth, scale * before.depth, rtol=1e-3)


def test_identity_transform_changes_nothing(rng):
    model = model_of(random_case(rng, 5))
    for name, table in model.transformed().tables().items():
        np.testing.assert_allclose(getattr(model, name), table, atol=1e-6, err_msg=name)


def test_rotated_harmonics_match_rotated_directions(rng):
    turn = random_rotation(rng)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(basis(directions), sh_basis(directions, 3)[:, 1:], atol=1e-12)
    coefficients = rng.normal(size=(4, 45))
    turned = rotate_sh(coefficients, turn)
    seen = np.einsum("dk,nkc->ndc", sh_basis(directions @ turn.T, 3)[:, 1:], turned.reshape(4, 15, 3))
    expected = np.einsum("dk,nkc->ndc", sh_basis(directions, 3)[:, 1:], coefficients.reshape(4, 15, 3))
    np.testing.assert_allclose(seen, expected, atol=1e-10)


@pytest.mark.parametrize(
    ("movement", "message"),
    [
        ({"rotation": np.diag([1, 1, -1])}, "is a reflection"),
        ({"rotation": 2 * np.eye(3)}, "a rotation with a uniform, positive scale"),
        ({"rotation": np.eye(2)}, "a rotation with a uniform, positive scale"),
        ({"scale": 0}, "positive scale"),
        ({"scale": float("nan")}, "positive scale"),
        ({"translation": 1.0}, r"the translation has shape \(\)"),
    ],
)
def test_invalid_transform_is_refused(rng, movement, message):
    with pytest.raises(ValueError, match=message):
        model_of(random_case(rng, 2)).transformed(**movement)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        *(("means", (2, 3)), ("means", (3, 7)), ("quats", (3, 7)), ("log_scales", (2, 3)), ("logit_opacity", (3, 7))),
        *(("sh_base", (3,)), ("sh_rest", (3, 7))),
    ],
)
def test_table_of_a_wrong_shape_is_named(rng, name, shape):
    tables = {**random_case(rng, 3).parameters, name: np.zeros(shape)}
    wrong = "quats" if name == "means" and shape == (2, 3) else name  # the means say how many there are
    with pytest.raises(ValueError, match=rf"^{wrong} has shape .*; expected \([23], [\d or]+\)"):
        Model(**tables)


def test_tables_become_float32(rng):
    tables = {name: table.astype(np.float64).tolist() for name, table in random_case(rng, 3).parameters.items()}
    assert all(table.dtype == np.float32 for table in Model(**tables).tables().values())


def test_model_has_a_rich_display(rng):
    model = model_of(random_case(rng, 3))
    assert repr(model) == "Model(3 Gaussians, SH degree 3)"
    for item in (model, model[:0]):
        page = Page(item._repr_html_())
        assert page.elements["tr"] == 6
        assert f"Gaussians{len(item)}" in page.text.replace("\n", "")


def test_scene_display_has_four_images_and_escaped_names(tiny_scene):
    import clsplat

    scene = clsplat.read_scene(tiny_scene)
    page = Page(scene._repr_html_())
    assert (page.elements["img"], page.elements["table"]) == (4, 1)
    assert "8 for training, 2 for testing" in page.text
    views = (View(HOSTILE, scene.views[0].camera, scene.views[0].world_to_camera), *scene.views[1:])
    named = replace(scene, path=scene.path / HOSTILE, views=tuple(replace(v, name=HOSTILE + v.name) for v in views))
    page = Page(named._repr_html_())
    assert page.elements["script"] == 0
    assert page.text.count(HOSTILE) == 4, "the path, and the names of three photographs: the first has no file"
    assert repr(scene) == "Scene(tiny: 8 training and 2 test views)"


@pytest.mark.parametrize("path", ["", ".", "/"])
def test_path_without_a_name_is_refused(rng, path):
    with pytest.raises(OutputError, match=r"cannot be written \(it has no file name\); use the path of a file$"):
        model_of(random_case(rng, 3)).save(path)
