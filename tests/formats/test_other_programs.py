"""Points, tables, and pages for programs without Gaussians, opened by other programs' readers."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError
from clsplat.formats.mesh import WRITERS, Mesh
from clsplat.formats.splats import SH_C0, normalize_quats
from clsplat.gaussians.model import Model
from clsplat.pipeline.loading import load
from tests.support.html_page import Page
from tests.support.models import splats

ENDS = "cannot write to this path: it does not end in .ply"
UTM = np.array([5e5 + 0.25, -300.5, 4e6 + 0.125])


@pytest.fixture
def model(rng, tmp_path) -> Model:
    """A model in map coordinates, in a.ply."""
    result = Model(**splats(rng, 200, 1).parameters, origin=UTM)
    result.save(tmp_path / "a.ply")
    return result


def test_point_cloud_is_read_by_trimesh(model, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    result = clsplat.convert(tmp_path / "a.ply", tmp_path / "b.points.ply")
    assert (result["format"], result["gaussians"]) == ("point cloud", 200)
    cloud = trimesh.load(tmp_path / "b.points.ply")
    assert isinstance(cloud, trimesh.PointCloud)
    np.testing.assert_array_equal(cloud.vertices, model.means + UTM)
    expected = np.clip(model.sh_base * SH_C0 + 0.5, 0, 1)
    np.testing.assert_allclose(cloud.colors[:, :3] / 255, expected, atol=0.5 / 255 + 1e-6)


def test_table_has_plain_values(model, tmp_path, caplog):
    clsplat.convert(tmp_path / "a.ply", tmp_path / "b.csv")
    assert not caplog.text, "what a table does not keep is no surprise"
    table = np.genfromtxt(tmp_path / "b.csv", delimiter=",", names=True)
    columns = {
        ("x", "y", "z"): model.means + UTM,
        ("opacity",): model.opacities[:, None],
        ("scale_x", "scale_y", "scale_z"): model.scales,
        ("rotation_w", "rotation_x", "rotation_y", "rotation_z"): normalize_quats(model.quats),
    }
    for names, expected in columns.items():
        actual = np.stack([table[name] for name in names], axis=1)
        np.testing.assert_allclose(actual, expected, rtol=1e-5, atol=1e-3 if names[0] == "x" else 1e-6)
    for name in ("red", "green", "blue"):
        assert (table[name] == table[name].round()).all()
        assert 0 <= table[name].min() < table[name].max() <= 255


@pytest.mark.parametrize("name", ["b.points.ply", "b.csv"])
def test_points_are_no_model(name, model, tmp_path):
    clsplat.convert(tmp_path / "a.ply", tmp_path / name)
    with pytest.raises(DataError, match=f"{name}: "):
        clsplat.load(tmp_path / name)
    with pytest.raises(ConfigError, match=rf"'{name}' would store only points, not a model; .*|{ENDS}"):
        load("splat_7k", [f"export.file={name}"])


def test_page_is_that_of_view(model, tmp_path):
    result = clsplat.convert(
        tmp_path / "a.ply", tmp_path / "site" / "b.html", crop="499990,-310,3999990,500010,-290,4000010"
    )
    assert (result["format"], result["bytes"]) == ("HTML", (tmp_path / "site" / "b.html").stat().st_size)
    assert [path.name for path in (tmp_path / "site").iterdir()] == ["b.html"]
    page = Page((tmp_path / "site" / "b.html").read_text())
    assert page.elements["canvas"] == 2
    assert "origin" in page.text
    for options, message in (
        ({"quality": "small"}, "pages have no --quality and no --collider; omit them"),
        (
            {"frames": 3},
            "no format matches the name 'c.html'; use a name that ends in .*`clsplat convert` also writes one ",
        ),
    ):
        with pytest.raises(ConfigError, match=f"c.html: {message}"):
            clsplat.convert(tmp_path / "a.ply", tmp_path / "c.html", **options)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".splat"])
def test_model_is_read_by_splat_transform(suffix, model, tmp_path):
    """A program of PlayCanvas, `npm install --global @playcanvas/splat-transform`, reads the values that we read."""
    if not (program := shutil.which("splat-transform")):
        pytest.skip("needs the command splat-transform, of npm")
    file, out = tmp_path / f"b{suffix}", tmp_path / "c.csv"
    replace(model, origin=np.zeros(3)).save(file)
    subprocess.run([program, "--quiet", file, out], check=True, timeout=60)
    table, expected = np.genfromtxt(out, delimiter=",", names=True), clsplat.load(file)

    def columns(name: str, count: int) -> np.ndarray:
        return np.stack([table[f"{name}_{i}"] for i in range(count)], axis=1)

    np.testing.assert_allclose(np.stack([table[axis] for axis in "xyz"], axis=1), expected.means, atol=1e-6)
    np.testing.assert_allclose(np.exp(columns("scale", 3)), expected.scales, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-table["opacity"])), expected.opacities, atol=1e-6)
    np.testing.assert_allclose(columns("f_dc", 3), expected.sh_base, atol=1e-6)
    dots = (normalize_quats(columns("rot", 4)) * normalize_quats(expected.quats)).sum(axis=1)
    np.testing.assert_allclose(np.abs(dots), 1, atol=1e-4)
    if suffix != ".splat":  # has no harmonics
        rest = columns("f_rest", 9).reshape(-1, 3, 3).transpose(0, 2, 1)
        np.testing.assert_allclose(rest.reshape(-1, 9), expected.sh_rest, atol=1e-6)


CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))


def write_cube(path: Path, offset: np.ndarray) -> None:
    """A cube as PLY, by our writer, or as OBJ with faces of four corners, counted from the end."""
    if path.suffix == ".ply":
        faces = np.array([(a, b, c) for q in QUADS for a, b, c in (q[:3], (q[0], *q[2:]))])
        WRITERS[".ply"](path, Mesh(CUBE, faces, np.zeros((8, 3), np.uint8)), offset)
    else:
        lines = [f"v {x} {y} {z}" for x, y, z in (CUBE + offset).tolist()]
        path.write_text("\n".join([*lines, *("f " + " ".join(f"{i - 8}//1" for i in quad) for quad in QUADS)]))


@pytest.mark.parametrize("mesh", ["hull.ply", "hull.obj"])
def test_collider_is_read_by_usd(mesh, model, tmp_path):
    """The mesh and the Gaussians move together; axes, unit, schemas, and alignment are as a simulator needs them."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdPhysics

    write_cube(tmp_path / mesh, UTM)
    options = {"collider": tmp_path / mesh, "transform": "scale=2 rotate=90,0,0 translate=1,2,3"}
    clsplat.convert(tmp_path / "a.ply", tmp_path / "b.usdz", **options)
    stage = Usd.Stage.Open(str(tmp_path / "b.usdz"))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1)
    assert stage.GetDefaultPrim().GetPath() == "/Scene"
    prim, gaussians = (stage.GetPrimAtPath(f"/Scene/{name}") for name in ("Collider", "Gaussians"))
    assert prim.HasAPI(UsdPhysics.CollisionAPI)
    assert UsdGeom.Imageable(prim).ComputePurpose() == "guide"
    assert gaussians.GetTypeName() == "ParticleField3DGaussianSplat"
    to_world = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(prim))
    turn = 2 * np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    flip = np.diag([1.0, -1, -1])
    for attribute, points in ((prim.GetAttribute("points"), CUBE), (gaussians.GetAttribute("positions"), model.means)):
        expected = ((points + UTM) @ turn.T + [1, 2, 3]) @ flip
        world = np.array(attribute.Get()).astype(float) @ to_world[:3, :3] + to_world[3, :3]
        np.testing.assert_allclose(world, expected, atol=1e-5 if points is not CUBE else 1e-6)
    assert len(prim.GetAttribute("faceVertexCounts").Get()) == 12
    data = (tmp_path / "b.usdz").read_bytes()
    assert data.index(b"#usda") == 64, "aligned in the package"
    copy = clsplat.load(tmp_path / "b.usdz")
    moved = model.transformed(2.0, turn / 2, (1, 2, 3))
    np.testing.assert_allclose(copy.means + copy.origin, moved.means + moved.origin, atol=1e-5)
    np.testing.assert_allclose(copy.sh_rest, moved.sh_rest, atol=1e-6)


def test_stages_with_other_axes_units_and_transforms_are_read(model, tmp_path):
    plain = replace(model, origin=np.zeros(3))
    plain.save(tmp_path / "b.usda")
    text = (tmp_path / "b.usda").read_text()
    order = '    double3 xformOp:translate = (0, 0, 100)\n    uniform token[] xformOpOrder = ["xformOp:translate"]\n'
    text = text.replace("metersPerUnit = 1", "metersPerUnit = 0.01").replace('upAxis = "Y"', 'upAxis = "Z"')
    (tmp_path / "c.usda").write_text(text.replace('"Scene"\n{\n', '"Scene" (doc = """} { (""")\n{\n' + order))
    copy = clsplat.load(tmp_path / "c.usda")
    x, y, z = (plain.means * [1, -1, -1]).T  # in the stage, z up
    np.testing.assert_allclose(copy.means, 0.01 * np.stack([x, -(z + 100), y], axis=1), atol=1e-5)
    np.testing.assert_allclose(np.sort(copy.scales), 0.01 * np.sort(plain.scales), rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda data: data.replace(b"opacities", b"opaqueness"),
            "its Gaussians have no opacities; export the file again",
        ),
        (lambda data: data[:-2], "is damaged, or has values of unsupported types .*brace"),
        (lambda data: data.replace(b"scales = [(", b"scales = [(x"), "is damaged, or has values of unsupported types"),
        (
            lambda data: data.replace(b"scales = [(0", b"scales = [(1, 1, 1), (0"),
            "the attributes of its Gaussians have different counts",
        ),
        (lambda data: data.replace(b"Splat ", b"Splats "), "has no prim ParticleField3DGaussianSplat"),
        (lambda data: b"PXR-USDC" + data, "a binary OpenUSD file; .*usdcat"),
    ],
)
def test_damaged_stages_are_reported(change, message, model, tmp_path):
    model.save(tmp_path / "b.usda")
    (tmp_path / "b.usda").write_bytes(change((tmp_path / "b.usda").read_bytes()))
    with pytest.raises(DataError, match=f"b.usda: {message}"):
        clsplat.load(tmp_path / "b.usda")


def test_invalid_colliders_are_reported(model, tmp_path):
    write_cube(tmp_path / "hull.ply", UTM)
    (tmp_path / "flat.obj").write_text("v 0 0 0\nf 1 2 3\n")
    (tmp_path / "bad.obj").write_text("v 0 0 x\n")
    (tmp_path / "half.ply").write_bytes((tmp_path / "hull.ply").read_bytes()[:-5])
    for name, out, message in (
        ("hull.ply", "b.glb", "b.glb: --collider is only for OpenUSD; use a name that ends in .usdz or .usda"),
        ("hull.stl", "b.usdz", "hull.stl: expected a .ply or .obj mesh"),
        ("none.obj", "b.usdz", "none.obj: cannot be read"),
        ("flat.obj", "b.usdz", "flat.obj: has no faces, or faces without vertices"),
        ("bad.obj", "b.usdz", "bad.obj: could not convert string to float"),
        ("half.ply", "b.usdz", "half.ply: buffer is smaller than requested size"),
        ("a.ply", "b.usdz", "a.ply: expected a binary little-endian PLY with faces"),
    ):
        with pytest.raises((ConfigError, DataError), match=message):
            clsplat.convert(tmp_path / "a.ply", tmp_path / out, collider=tmp_path / name)
    with pytest.raises(ConfigError, match="--frames cannot be combined with --time or --collider"):
        clsplat.convert(tmp_path / "a.ply", tmp_path / "f", frames=3, collider=tmp_path / "hull.ply")
