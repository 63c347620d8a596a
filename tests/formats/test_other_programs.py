"""Points, tables, and pages for programs without Gaussians, opened by other programs' readers."""

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError
from clsplat.formats.splats import SH_C0, normalize_quats
from clsplat.gaussians.model import Model
from clsplat.pipeline.loading import load
from tests.support.html_page import Page
from tests.support.models import splats

ENDS = "expected a path inside the run folder: it does not end in .ply"
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
    with pytest.raises(ConfigError, match=rf"'{name}' is not a model, only points; use a name that ends in|{ENDS}"):
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
    for options in ({"quality": "small"}, {"frames": 3}):
        with pytest.raises(ConfigError, match=r"c\.html: no format has the name 'c\.html'; use a name that ends in"):
            clsplat.convert(tmp_path / "a.ply", tmp_path / "c.html", **options)
