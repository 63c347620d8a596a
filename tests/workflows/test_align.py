"""`clsplat align`: control points, GPS, scale bars, and level scenes with known answers; bad input is refused."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import clsplat
from clsplat.core.errors import ClsplatError
from clsplat.scene.control import to_utm
from clsplat.scene.detect import read_scene
from clsplat.scene.images import read_exif_position
from clsplat.scene.reprojection import project_points
from clsplat.scene.similarity import UP, Similarity
from clsplat.scene.viewpoint import up_direction
from tests.support.colmap_writer import PointEntry
from tests.support.commands import clsplat as command
from tests.support.orbit_scene import orbit, write

KNOWN = Similarity(2.5, Rotation.from_euler("xyz", [20, -35, 70], degrees=True).as_matrix(), np.array([5e5, 4.5e6, 30]))
HEADER = "point,x,y,z,photo,u,v\n"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("align") / "scene", orbit())


def marks(scene: Path, position: np.ndarray, photos: list[int], noise: float = 0.0) -> list[str]:
    """The photos that show a position, as PHOTO,u,v."""
    rng, views = np.random.default_rng(len(photos)), read_scene(scene).views
    pixels = {views[i].name: project_points(views[i], position[None])[0] + rng.normal(0, noise, 2) for i in photos}
    return [f"{name},{u:.6f},{v:.6f}" for name, (u, v) in pixels.items()]


def write_control(file: Path, scene: Path, positions: np.ndarray, noise: float = 0.0) -> list[str]:
    """Write control points p0, p1, … that four photos show; return the rows."""
    rows = []
    for i, position in enumerate(positions):
        x, y, z = KNOWN.apply(position).tolist()
        rows += [f"p{i},{x!r},{y!r},{z!r},{mark}" for mark in marks(scene, position, [i, i + 5, i + 9, i + 14], noise)]
    file.write_text(HEADER + "\n".join(rows) + "\n")
    return rows


def test_control_points_place_a_scene_on_the_map(scene, tmp_path):
    positions = np.random.default_rng(4).uniform(-0.5, 0.5, (8, 3))
    rows = write_control(tmp_path / "points.csv", scene, positions, noise=0.05)
    rows[0] = ",".join([*rows[0].split(",")[:-1], "5"])  # a mark at the wrong place
    height = float(KNOWN.apply(positions[3])[2])
    wrong = [row.replace(repr(height), repr(height + 9)) for row in rows]
    (tmp_path / "points.csv").write_text(HEADER + "\n".join(wrong) + "\n")
    result = clsplat.align(scene, tmp_path / "out", control=tmp_path / "points.csv")
    assert result["outliers"] == ["p3"]
    assert result["points"][3]["error"][2] == pytest.approx(-9, abs=0.05)
    assert [mark["is_outlier"] for mark in result["points"][0]["marks"]] == [True, False, False, False]
    assert result["scale"] == pytest.approx(2.5, rel=3e-3)
    assert result["rms"] < 0.02
    json.dumps(result)
    aligned, original = read_scene(tmp_path / "out"), read_scene(scene)
    assert aligned.origin.any()
    for old, new in zip(original.views, aligned.views, strict=True):
        np.testing.assert_allclose(new.position + aligned.origin, KNOWN.apply(old.position), atol=0.1)
    world = aligned.points.positions + aligned.origin
    np.testing.assert_allclose(world, KNOWN.apply(original.points.positions), atol=0.02)
    assert aligned.views[0].image_path.is_file()


def test_exact_control_points_are_exact_in_map_coordinates(scene, tmp_path):
    write_control(tmp_path / "points.csv", scene, np.random.default_rng(5).uniform(-0.5, 0.5, (5, 3)))
    result = clsplat.align(scene, tmp_path / "out", control=tmp_path / "points.csv", images="none")
    np.testing.assert_allclose(np.array(result["matrix"]), KNOWN.matrix, rtol=1e-6, atol=1e-5)
    assert result["rms"] < 1e-5


def gps_jpeg(latitude: float, longitude: float, altitude: float) -> bytes:
    """A JPEG with an EXIF position in degrees, minutes, and seconds."""

    def rationals(degrees: float) -> bytes:
        minutes = abs(degrees) % 1 * 60
        return struct.pack("<6I", int(abs(degrees)), 1, int(minutes), 1, round(minutes % 1 * 60 * 1e6), 1_000_000)

    first, second = (b"S" if latitude < 0 else b"N"), (b"W" if longitude < 0 else b"E")
    data = 26 + 2 + 6 * 12 + 4
    entries = [
        struct.pack("<HHI", 1, 2, 2) + first.ljust(4, b"\0"),
        struct.pack("<HHII", 2, 5, 3, data),
        struct.pack("<HHI", 3, 2, 2) + second.ljust(4, b"\0"),
        struct.pack("<HHII", 4, 5, 3, data + 24),
        struct.pack("<HHI", 5, 1, 1) + bytes([int(altitude < 0), 0, 0, 0]),
        struct.pack("<HHII", 6, 5, 1, data + 48),
    ]
    tail = rationals(latitude) + rationals(longitude) + struct.pack("<2I", round(abs(altitude) * 1000), 1000)
    block = struct.pack("<2sHIHHHIII", b"II", 42, 8, 1, 0x8825, 4, 1, 26, 0)
    body = b"Exif\0\0" + block + struct.pack("<H", 6) + b"".join(entries) + bytes(4) + tail
    jpeg = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


@pytest.mark.parametrize("position", [(48.1, 11.5, 512.25), (-33.9, -70.6, -3.5)])
def test_gps_positions_are_read(tmp_path, position):
    (tmp_path / "a.jpg").write_bytes(gps_jpeg(*position))
    np.testing.assert_allclose(read_exif_position(tmp_path / "a.jpg"), position, atol=1e-9)
    data = gps_jpeg(*position)
    for at in range(20, 190, 5):
        (tmp_path / "a.jpg").write_bytes(data[:at] + b"\xff" + data[at + 1 :])
        actual = read_exif_position(tmp_path / "a.jpg")
        assert actual is None or np.isfinite(actual).all()


def test_gps_places_a_scene_and_names_wrong_positions(tmp_path):
    model = orbit()
    for image in model.images:
        image.name = image.name.replace(".png", ".jpg")
    scene = write(tmp_path / "scene", model)
    views, rng = read_scene(scene).views, np.random.default_rng(0)
    turn, start = Rotation.from_euler("z", 40, degrees=True).as_matrix(), np.array([48.1, 11.5, 500.0])
    degrees = np.array([1 / 111_200, 1 / 74_400, 1])[[1, 0, 2]]  # about a meter, east, north, up
    for i, view in enumerate(views):
        east, north, up = (10 * turn @ view.position + rng.normal(0, 0.3, 3)) * degrees
        place = start + [north, east, up] + ([0, 3e-3, 0] if i == 7 else 0)
        (scene / "images" / view.name).write_bytes(gps_jpeg(*place))
    result = clsplat.align(scene, tmp_path / "out", gps=True)
    assert result["outliers"] == [views[7].name]
    assert result["epsg"] == 32632
    assert result["scale"] == pytest.approx(10, rel=0.02)
    center = to_utm(start[None])[0][0]
    aligned = read_scene(tmp_path / "out")
    centers = np.stack([view.position for view in aligned.views]) + aligned.origin
    np.testing.assert_allclose(centers.mean(axis=0), center, atol=1)
    np.testing.assert_allclose(up_direction(aligned.views), [0, 0, 1], atol=0.02)


def test_distances_scale_a_level_scene(scene, tmp_path):
    first, second = np.array([0.3, 0.1, 0.2]), np.array([-0.4, 0.2, -0.1])
    ends = ["+".join(row.replace(",", ":", 1) for row in marks(scene, end, [0, 4])) for end in (first, second)]
    length = float(np.linalg.norm(first - second))
    (tmp_path / "bar.csv").write_text(
        HEADER
        + "".join(
            f"{name},,,,{row}\n" for name, end in (("A", first), ("B", second)) for row in marks(scene, end, [1, 7])
        )
    )
    distances = [f"{ends[0]};{ends[1]}={2 * length}", f"A,B={2 * length}", f"0,0,0;{length},0,0={2 * length}"]
    result = clsplat.align(scene, tmp_path / "out", level="cameras", distances=distances, control=tmp_path / "bar.csv")
    assert result["scale"] == pytest.approx(2, rel=1e-5)
    for row in result["distances"]:
        assert row["measured"] == pytest.approx(row["length"], rel=1e-5)
    aligned, original = read_scene(tmp_path / "out"), read_scene(scene)
    np.testing.assert_allclose(up_direction(aligned.views), UP, atol=1e-6)
    spread = [np.linalg.norm(s.views[0].position - s.views[9].position) for s in (original, aligned)]
    assert spread[1] == pytest.approx(2 * spread[0])


def test_aligned_model_and_scene_render_the_same(scene, tmp_path, device):
    """The check of the whole: positions, shapes, colors that depend on the view, and the near plane."""
    views = read_scene(scene).views
    model = splats_near_zero()
    model.save(tmp_path / "model.ply")
    write_control(tmp_path / "points.csv", scene, np.random.default_rng(5).uniform(-0.5, 0.5, (5, 3)))
    options = {"control": tmp_path / "points.csv"}
    clsplat.align(tmp_path / "model.ply", tmp_path / "moved.ply", scene, **options)
    clsplat.align(scene, tmp_path / "moved", **options)
    aligned_scene = read_scene(tmp_path / "moved")
    aligned_model = clsplat.load(tmp_path / "moved.ply")
    assert aligned_model.origin.any()
    renderer, other = clsplat.Renderer(model, device), clsplat.Renderer(aligned_model.in_scene(aligned_scene), device)
    for i in (0, 9):
        before = renderer.render(views[i]).image
        assert before.std() > 0.05
        np.testing.assert_allclose(other.render(aligned_scene.views[i]).image, before, atol=2e-3)


def splats_near_zero() -> clsplat.Model:
    rng = np.random.default_rng(1)
    return clsplat.Model(
        rng.normal(0, 0.3, (300, 3)),
        rng.normal(size=(300, 4)),
        rng.uniform(-3.5, -2, (300, 3)),
        rng.normal(1, 1, (300, 1)),
        rng.normal(0, 1, (300, 3)),
        rng.normal(0, 0.2, (300, 45)),
        rendering=clsplat.Rendering(near=0.1),
    )


def test_bare_model_is_leveled_by_its_ground(tmp_path):
    rng, model = np.random.default_rng(2), splats_near_zero()
    floor = splats_near_zero()
    means = np.column_stack([rng.uniform(-1, 1, 300), np.full(300, 0.6), rng.uniform(-1, 1, 300)])
    turn = Rotation.from_euler("xz", [12, 20], degrees=True).as_matrix()
    tables = {name: np.concatenate([model.tables()[name], floor.tables()[name]]) for name in model.tables()}
    tables["means"][300:], tables["logit_opacity"][:] = means, 2
    clsplat.Model(**tables).transformed(rotation=turn).save(tmp_path / "tilted.ply")
    said = command("align", tmp_path / "tilted.ply", tmp_path / "level.ply", "--level", "ground")
    assert "rotated by 23.2 degrees, scaled by 1" in said.stdout + said.stderr
    np.testing.assert_allclose(clsplat.load(tmp_path / "level.ply").means[300:, 1], 0, atol=0.01)


def test_model_and_its_scene_are_leveled_by_the_same_ground(tmp_path):
    """The points of the scene; the model's Gaussians are no plane."""
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2)).tolist()
    floor = replace(orbit(), points=[PointEntry((x, y, 0.1 * x - 0.4)) for x, y in places])
    scene = write(tmp_path / "scene", floor)
    splats_near_zero().save(tmp_path / "model.ply")
    of_model = clsplat.align(tmp_path / "model.ply", tmp_path / "level.ply", scene, level="ground")
    of_scene = clsplat.align(scene, tmp_path / "level", level="ground")
    assert of_model["matrix"] == of_scene["matrix"]
    np.testing.assert_allclose(read_scene(tmp_path / "level").points.positions[:, 1], 0, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "options", "expected"),
    [
        ("", {}, "expected --level, --distance, --gps, or --control"),
        ("", {"level": "cameras", "distances": ["A;B"]}, "expected A;B=LENGTH with a LENGTH above 0"),
        ("", {"distances": ["1,2,3;1,2,3=4"]}, "both ends are the same point"),
        ("", {"distances": ["99.png:1,2;1,2,3=4"]}, "no photo is named '99.png'"),
        ("", {"distances": ["00.png:1,2+00.png:1,3;1,2,3=4"]}, "almost the same direction"),
        ("", {"gps": True}, "no photo has a GPS position"),
        ("point,x\n", {"control": "c"}, "has no column y"),
        (HEADER + "a,1,2,x,00.png,1,2\n", {"control": "c"}, "c.csv:2: z is 'x'; expected a number"),
        (HEADER + "a,1,2,3,00.png,,2\n", {"control": "c"}, "c.csv:2: u is ''"),
        (HEADER + "a,1,2,3,00.png,1,2\na,1,2,4,01.png,1,2\n", {"control": "c"}, "different coordinates"),
        (HEADER + "a,1,2,3,00.png,-1,2\na,,,,01.png,1,2\n", {"control": "c"}, "mark in 00.png is outside the photo"),
        (HEADER + "a,,,,00.png,1,2\n", {"control": "c"}, "no point has x, y, and z"),
        (
            HEADER + "a,1,2,3,00.png,30,20\na,,,,05.png,30,20\n",
            {"control": "c"},
            "1 point with known coordinates; expected at least 3 points",
        ),
    ],
)
def test_bad_input_is_refused(scene, tmp_path, text, options, expected):
    (tmp_path / "c.csv").write_text(text)
    options = {**options, **({"control": tmp_path / "c.csv"} if "control" in options else {})}
    with pytest.raises(ClsplatError) as caught:
        clsplat.align(scene, tmp_path / "out", **options)
    assert expected in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_scene_is_not_written_into_itself(scene, tmp_path):
    files = sorted(scene.rglob("*"))
    (tmp_path / "link").symlink_to(scene)
    for out in (scene, tmp_path / "link"):
        with pytest.raises(ClsplatError, match="is the input"):
            clsplat.align(scene, out, level="cameras", format="nerfstudio")
    assert sorted(scene.rglob("*")) == files
