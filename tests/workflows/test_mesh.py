"""`clsplat mesh`: analytic surfaces from exact depths, the file formats, and invalid input."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import clsplat
from clsplat.api.renderer import default_device
from clsplat.cli import app
from clsplat.core.errors import ConfigError, DataError, MemoryLimitError
from clsplat.data_tools.casting import World
from clsplat.data_tools.shapes import Cuboid, Sphere, spiral
from clsplat.formats.gltf import _read_chunks, _to_srgb
from clsplat.formats.mesh import WRITERS, Mesh
from clsplat.render.fusion import DepthImage, count_free, find_blocks, fuse
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.workflows import mesh as workflow
from clsplat.workflows import surface

pytestmark = pytest.mark.slow

SIZE, VOXEL = 128, 0.02
FOCAL = 0.5 * SIZE / np.tan(0.4)


def gray(points):
    return np.full(points.shape, 0.5)


def exact_image(world: World, position: np.ndarray) -> DepthImage:
    """The exact depths of a view from a position toward the center."""
    view = View.looking_at(position, np.zeros(3), (0, 0, 1), Camera(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2))
    pose = view.world_to_camera.astype(np.float64)
    row, column = np.mgrid[:SIZE, :SIZE] + 0.5
    in_camera = np.stack([(column - SIZE / 2) / FOCAL, (row - SIZE / 2) / FOCAL, np.ones((SIZE, SIZE))]).reshape(3, -1)
    length = np.linalg.norm(in_camera, axis=0)
    distance, _ = world.trace(position[:, None], pose[:, :3].T @ in_camera / length)
    depth = np.where(np.isfinite(distance), distance / length, 0).reshape(SIZE, SIZE)
    return DepthImage(view, depth.astype(np.float32), np.full((SIZE, SIZE, 3), 0.5, np.float32))


def exact_mesh(shape: Sphere | Cuboid, lowest: float = -85) -> Mesh:
    """The mesh of a shape, from 40 exact depth images."""
    images = [exact_image(World((shape,), 0.8, 1), 3 * p) for p in spiral(40, lowest, 85)]
    blocks = find_blocks(images, VOXEL, 5 * VOXEL)
    field = fuse(default_device(), images, blocks, VOXEL, 5 * VOXEL)
    return surface.remove_small_parts(surface.extract(field))


@pytest.fixture(scope="module")
def sphere() -> Mesh:
    return exact_mesh(Sphere(center=(0.01, 0.02, 0.03), radius=0.7, paint=gray))


def test_sphere_is_closed_and_within_half_a_voxel(sphere):
    offset = sphere.vertices - [0.01, 0.02, 0.03]
    radius = np.linalg.norm(offset, axis=1)
    assert sphere.is_closed
    assert np.abs(radius - 0.7).max() < 0.5 * VOXEL
    assert np.abs(radius - 0.7).mean() < 0.1 * VOXEL
    assert ((sphere.normals() * offset).sum(axis=1) / radius).min() > 0.7, "outward"
    assert np.abs(sphere.colors.astype(int) - 128).max() <= 1
    smooth = surface.smooth(sphere)
    assert np.abs(np.linalg.norm(smooth.vertices - [0.01, 0.02, 0.03], axis=1) - 0.7).mean() < 0.1 * VOXEL


@pytest.mark.parametrize(("half", "yaw"), [((0.6, 0.5, 0.4), 30.0), ((3.0, 3.0, 0.2), 0.0)])
def test_faces_of_a_box_and_a_plane_are_within_a_voxel(half, yaw):
    shape = Cuboid(center=(0, 0, 0), half=half, paint=gray, yaw=yaw)
    mesh = exact_mesh(shape, lowest=-85 if half[0] < 1 else 30)
    beyond = np.abs(shape.local(mesh.vertices.T)) - np.array(half)[:, None]
    distance = np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(axis=0), 0)
    assert len(mesh.faces) > 1000
    assert (mesh.edge_counts() <= 2).all()
    assert np.abs(distance).mean() < (0.2 if half[0] < 1 else 0.05) * VOXEL
    assert np.quantile(np.abs(distance), 0.95) < VOXEL, "only edges, where views are grazing, are rounded"


def test_small_parts_are_removed(sphere):
    corner = np.array([[5.0, 5, 5], [6, 5, 5], [5, 6, 5]])
    vertices = np.concatenate([sphere.vertices, corner])
    faces = np.concatenate([sphere.faces, [np.arange(3) + len(sphere.vertices)]])
    mesh = surface.remove_small_parts(Mesh(vertices, faces, np.zeros((len(vertices), 3), np.uint8)))
    assert mesh.vertices.max() < 1
    assert len(mesh.faces) == len(sphere.faces)


def test_reduced_sphere_stays_closed(sphere):
    pytest.importorskip("fast_simplification")
    assert surface.reduce(sphere, 1e-300).is_closed
    small = surface.reduce(sphere, 200 / len(sphere.faces))
    assert len(surface.reduce(small, 0.5).faces) == pytest.approx(0.5 * len(small.faces), rel=0.1)
    reduced = surface.reduce(sphere, 0.1)
    assert reduced.is_closed
    assert len(reduced.faces) == pytest.approx(0.1 * len(sphere.faces), rel=0.02)
    assert np.abs(np.linalg.norm(reduced.vertices - [0.01, 0.02, 0.03], axis=1) - 0.7).mean() < 0.3 * VOXEL


def test_edges_of_more_than_two_faces_are_split():
    vertices = np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0]])
    fan = Mesh(vertices, np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]]), np.zeros((5, 3), np.uint8))
    assert fan.edge_counts().max() == 3
    split = surface.split_edges(fan)
    assert split.edge_counts().max() == 1
    np.testing.assert_array_equal(split.vertices[split.faces], fan.vertices[fan.faces])


def test_hull_is_closed_around_what_is_not_free():
    """A ball of radius 5 cells with an empty pocket inside that no view sees."""
    grid = np.indices((20, 24, 22))
    distance = np.linalg.norm(grid - np.array([9, 11, 12])[:, None, None, None], axis=0)
    hull = surface.hull(distance > 5, np.array([-4, 0, 3]), 0.5)
    offset = hull.vertices - 0.5 * np.array([5, 11, 15])
    radius = np.linalg.norm(offset, axis=1)
    assert hull.is_closed
    assert radius.min() > 0.5 * 5
    assert radius.max() < 0.5 * 7.5
    assert (hull.normals() * offset).sum(axis=1).min() > 0, "outward"


def test_free_points_are_counted_in_front_of_surfaces():
    image = exact_image(World((Sphere(center=(0, 0, 0), radius=0.7, paint=gray),), 0.8, 1), np.array([0, -3.0, 0]))
    views = count_free(default_device(), [image, image], np.zeros((1, 3), np.int32), 0.1)
    assert (views[0, 0, :, 0] == 0).all(), "inside and behind"
    views = count_free(default_device(), [image, image], np.array([[0, -1, 0]], np.int32), 0.1)
    np.testing.assert_array_equal(views[0, 0, :, 0], np.where(np.arange(-16, 0) * 0.1 <= -0.79, 2, 0))


@pytest.mark.parametrize("suffix", WRITERS)
def test_other_programs_read_the_files(sphere, tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    colored = replace(sphere, colors=np.tile(np.array([200, 100, 50], np.uint8), (len(sphere.vertices), 1)))
    origin = np.array([500000.5, 4000000.25, 100.0])
    for number, offset in enumerate((np.zeros(3), origin)):
        file = tmp_path / f"{number}{suffix}"
        WRITERS[suffix](file, colored, offset)
        actual = trimesh.load(file, process=False, force="scene").to_geometry()
        vertices = np.asarray(actual.vertices) * ((1, -1, -1) if suffix == ".glb" else 1)
        np.testing.assert_allclose(vertices, sphere.vertices + offset, atol=2e-6)
        np.testing.assert_array_equal(actual.faces, sphere.faces)
        assert actual.is_watertight
        assert actual.volume == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.03)
        if suffix == ".glb":  # trimesh drops vertex colors next to a material
            text, data = _read_chunks(file, file.read_bytes())
            tree = json.loads(text)
            accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
            start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
            color = np.frombuffer(data, "<u2", 4, start) / 65535
            np.testing.assert_allclose(255 * _to_srgb(color[:3]), [200, 100, 50], atol=0.01)
        else:
            np.testing.assert_array_equal(actual.visual.vertex_colors[:, :3], colored.colors)


def opaque_model(folder: Path) -> Path:
    """A ball of opaque, small Gaussians in front of the cameras of the tiny scene."""
    directions = spiral(4000, -90, 90).astype(np.float32)
    model = clsplat.Model(
        means=0.9 * directions,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (4000, 1)),
        log_scales=np.full((4000, 3), np.log(0.03), np.float32),
        logit_opacity=np.full((4000, 1), 5, np.float32),
        sh_base=directions,
        sh_rest=np.zeros((4000, 0), np.float32),
    )
    model.save(folder / "ball.ply")
    return folder / "ball.ply"


def test_command_writes_the_same_bytes_twice(tiny_scene, tmp_path):
    model = opaque_model(tmp_path)
    result = clsplat.write_mesh(model, tmp_path / "a.ply", tiny_scene, voxel=0.06)
    assert result["voxel"] == 0.06
    output = CliRunner().invoke(app, ["mesh", str(model), str(tmp_path / "b.ply"), *("--scene", str(tiny_scene))])
    assert output.exit_code == 0
    assert "open, voxel" in output.output
    clsplat.write_mesh(model, tmp_path / "c.ply", tiny_scene, voxel=0.06)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "c.ply").read_bytes()
    hull = clsplat.write_mesh(model, tmp_path / "hull.glb", tiny_scene, collision=True)
    assert hull["closed"]


def test_invalid_input_is_refused(few_steps, tiny_scene, tmp_path, monkeypatch):
    for options, words in (({"voxel": 0.0}, "--voxel 0: expected"), ({"keep": 1.5}, "--keep 1.5: expected")):
        with pytest.raises(ConfigError, match=words):
            clsplat.write_mesh(few_steps, tmp_path / "a.ply", **options)
    monkeypatch.setattr(workflow, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="--keep needs fast-simplification"):
        clsplat.write_mesh(few_steps, tmp_path / "a.ply", keep=0.5)
    with pytest.raises(ConfigError, match=r"expected a name that ends in .ply, .obj, .glb"):
        clsplat.write_mesh(few_steps, tmp_path / "a.stl")
    with pytest.raises(ConfigError, match="is one of the input files"):
        clsplat.write_mesh(few_steps, few_steps / "point_cloud.ply")
    with pytest.raises(ConfigError, match="is a file of a run"):
        clsplat.write_mesh(tmp_path / "other.ply", few_steps / "point_cloud.ply", tiny_scene)
    faint = clsplat.load(few_steps)
    faint.logit_opacity[:] = -10
    faint.save(tmp_path / "faint.ply")
    with pytest.raises(DataError, match="no view shows an opaque surface"):
        clsplat.write_mesh(tmp_path / "faint.ply", tmp_path / "a.ply", tiny_scene)
    model = opaque_model(tmp_path)
    monkeypatch.setattr(workflow, "available_memory", lambda: 1000)
    with pytest.raises(MemoryLimitError, match=r"--voxel 0.06: needs .* use a larger voxel, such as 0.12"):
        clsplat.write_mesh(model, tmp_path / "a.ply", tiny_scene, voxel=0.06)
    assert not (tmp_path / "a.ply").exists()
