"""Panoramas and fisheyes of about 180 degrees and more become the faces of a cube."""

from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.prepare.inspect.facts import read_parts
from clsplat.prepare.undistort import undistort_scene
from clsplat.scene.camera import FACES, WIDE, Lens, panorama_lens
from clsplat.scene.camera_files import write_cameras
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.scene.photographs import with_masks
from clsplat.scene.scene import Tracks
from clsplat.scene.view import View, load_image, load_mask, photograph_name
from clsplat.scene.view_selection import Split, ViewSelection
from tests.support.colmap_writer import CameraEntry, ColmapModel, ImageEntry, PointEntry, write_scene
from tests.support.transforms_scene import frames, write

PANORAMA = panorama_lens(128, 64)
FISHEYE = Lens(120, 120, "FISHEYE", (60 / np.radians(110), 60 / np.radians(110), 60.0, 60.0))  # 220 degrees
MODELS = {
    "OPENCV_FISHEYE": (105, 104, 201, 199, 0.02, -0.01, 0.002, 0.0),
    "SIMPLE_RADIAL_FISHEYE": (105, 200, 200, -0.01),
    "RADIAL_FISHEYE": (105, 200, 200, 0.01, -0.002),
    "THIN_PRISM_FISHEYE": (105, 104, 200, 200, 0.01, 0.002, 0.001, -0.001, 0.001, 0, 0.001, 0.002),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        *(105, 104, 200, 200, 0.01, 0.002, 0.001, -0.001),
        *(0.0001, 0, 0.001, 0.002, 0.001, -0.001, 0.002, 0.0005),
    ),
    "SIMPLE_FISHEYE": (105, 200, 200),
    "FISHEYE": (105, 104, 200, 200),
    "FOV": (150, 151, 200, 200, 0.95),
    "SIMPLE_DIVISION": (105, 200, 200, -0.27),
    "DIVISION": (105, 104, 200, 200, -0.27),
    "EUCM": (95, 94, 200, 200, 0.65, 1.1),
}


def face_rays(lens: Lens) -> np.ndarray:
    """Directions of the pixels of a face in the camera of the photograph, [H, W, 3]."""
    camera = lens.pinhole
    y, x = np.indices((camera.height, camera.width)) + 0.5
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ FACES[lens.face]


def picture_of_rays(lens: Lens) -> np.ndarray:
    """A photograph whose colors are the directions of its pixels, by inverse formulas."""
    y, x = np.indices((lens.height, lens.width)) + 0.5
    right, down = (x - lens.camera.cx) / lens.camera.fx, (y - lens.camera.cy) / lens.camera.fy
    if lens.model == "EQUIRECTANGULAR":
        rays = [np.cos(down) * np.sin(right), np.sin(down), np.cos(down) * np.cos(right)]
    else:
        angle = np.hypot(right, down)
        rays = [right * np.sinc(angle / np.pi), down * np.sinc(angle / np.pi), np.cos(angle)]
    return np.stack(rays, axis=-1).astype(np.float32)


@pytest.mark.parametrize("model", MODELS)
def test_directions_project_like_colmap(model: str, rng: np.random.Generator) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    params = tuple(map(float, MODELS[model]))
    lens = Lens(400, 400, model, params)
    camera = pycolmap.Camera(model=model, width=400, height=400, params=list(params))
    rays = rng.normal(size=(100, 3)) * [1, 1, 0.3]
    rays[:, 2] = np.abs(rays[:, 2]) + 0.02
    pixels = np.array([camera.img_from_cam(ray) for ray in rays])
    np.testing.assert_allclose(np.stack(lens.distort(*rays.T), axis=1), pixels, atol=1e-9)
    np.testing.assert_allclose(np.stack(lens.distort(*(rays[:, :2] / rays[:, 2:]).T), axis=1), pixels, atol=1e-9)
    beside = [(sign * np.sin(a), 0, np.cos(a)) for sign in (-1, 1) for a in np.radians((89.999, 90.001))]
    jumps = np.diff(np.stack(lens.distort(*np.array(beside).T), axis=1).reshape(2, 2, 2), axis=1)
    assert np.abs(jumps).max() < 0.02, "nothing happens at 90 degrees"


def test_panoramas_project_like_colmap(rng: np.random.Generator) -> None:
    assert {*MODELS, "EQUIRECTANGULAR"} == WIDE, "every model is compared"
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=128, height=64, params=[128.0, 64.0])
    pixels = rng.random((100, 2)) * [128, 64]
    rays = np.array([camera.cam_ray_from_img(pixel) for pixel in pixels])
    np.testing.assert_allclose(PANORAMA.project(rays), pixels, atol=1e-9)


@pytest.mark.parametrize("lens", [PANORAMA, FISHEYE])
def test_faces_show_their_own_rays(lens: Lens) -> None:
    """Colors are linear in the direction: a face shows the mean ray of each pixel, to the rounding of the source."""
    for face in lens.faces:
        shown = face.undistort_image(picture_of_rays(lens))
        error = np.abs(shown - face_rays(face)).max(axis=-1)
        assert error[face.visible_pixels].max() < 2.5 / lens.camera.fx**2 + 0.01, face.face
        assert face.pinhole.fx >= lens.camera.fx, "the center is not sampled below the photo"


def test_fisheye_faces_mask_what_the_lens_does_not_show() -> None:
    """The back shows nothing; the dark corners of the square photograph count as nothing, too."""
    assert [face.face for face in FISHEYE.faces] == ["front", "right", "left", "up", "down"]
    for face in FISHEYE.faces:
        angle = np.degrees(np.arccos(face_rays(face)[..., 2]))
        assert face.visible_pixels[angle < 107].all()
        assert not face.visible_pixels[angle > 110.2].any()
    front, right = FISHEYE.faces[:2]
    assert front.visible_pixels.all()
    assert front.pinhole.width > 1.3 * right.pinhole.width, "a face is cropped to what it shows"
    view = View("a.png", FISHEYE.pinhole, np.eye(3, 4), lens=FISHEYE)
    assert [face.name for face in view.faces()][:2] == ["a/cube_front.png", "a/cube_right.png"]


@pytest.mark.parametrize("degrees", [120, 150])
def test_narrower_fisheyes_stay_one_image(degrees: int) -> None:
    focal = 60 / np.radians(degrees / 2)
    assert not Lens(120, 120, "FISHEYE", (focal, focal, 60.0, 60.0)).is_wide


def test_folded_polynomials_end_where_they_fold() -> None:
    """The radius of this lens is largest at 100 degrees; directions beyond show nothing."""
    lens = Lens(400, 400, "SIMPLE_RADIAL_FISHEYE", (180.0, 200.0, 200.0, -1 / (3 * np.radians(100) ** 2)))
    assert lens.is_wide
    for face in lens.faces:
        assert not face.visible_pixels[np.degrees(np.arccos(face_rays(face)[..., 2])) > 100.2].any()


@pytest.fixture
def panoramas(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Nine panoramas in COLMAP's format, far from zero; one has a mask that hides what is below."""
    images = [ImageEntry(f"IMG_{i:04}.jpg", translation=(-4e5 - i, -5e6, -100.0)) for i in range(9)]
    points = [PointEntry((4e5 + 3 * np.cos(i), 5e6 + 3 * np.sin(i), 100.0)) for i in range(8)]
    camera = CameraEntry(1, "EQUIRECTANGULAR", 128, 64, (128, 64))
    folder = write_scene(tmp_path / "scene", ColmapModel([camera], images, points), "txt")
    for image in images:
        write_image(folder / "images" / image.name, rng.integers(0, 255, (64, 128, 3)).astype(np.uint8))
    mask = np.full((64, 128, 3), 255, np.uint8)
    mask[40:] = 0
    write_image(folder / "masks" / "IMG_0002.png", mask)
    return folder


def photographs(scene, split: str) -> list[str]:
    return sorted({photograph_name(view.name) for view in scene.split(split)})


def test_faces_of_a_photograph_share_its_place_and_split(panoramas: Path) -> None:
    scene = read_scene(panoramas, 8)
    assert len(scene.views) == 9 * 6 - 1, "the mask hides all of one face"
    assert scene.views[0].name == "IMG_0000/cube_front.jpg"
    assert photographs(scene, "test") == ["IMG_0000.jpg", "IMG_0008.jpg"]
    assert len(scene.test) == 12
    assert scene.origin.any()
    for view in scene.views:
        number = int(view.name[4:8])
        np.testing.assert_allclose(view.position + scene.origin, (4e5 + number, 5e6, 100), atol=1e-6)
        ahead = view.world_to_camera[2, :3]
        np.testing.assert_allclose(ahead, FACES[Path(view.name).stem.removeprefix("cube_")][2], atol=1e-12)
    chosen = Split(ViewSelection(names=["IMG_0003"]), validation="auto")
    scene = chosen.with_validation(read_scene(panoramas, chosen))
    assert photographs(scene, "test") == ["IMG_0003.jpg"]
    assert not set(photographs(scene, "validation")) & set(photographs(scene, "train"))
    assert len(photographs(scene, "validation")) == 2


def test_undistorted_faces_equal_those_read(panoramas: Path, tmp_path: Path) -> None:
    assert undistort_scene(panoramas, tmp_path / "a") == 53
    scene, cut = read_scene(panoramas, 8), read_scene(tmp_path / "a", 8)
    assert photographs(cut, "test") == ["IMG_0000.png", "IMG_0008.png"]
    by_name = {view.name: view for view in cut.views}
    for view in scene.views:
        same = by_name[Path(view.name).with_suffix(".png").as_posix()]
        assert same.camera == view.camera
        np.testing.assert_array_equal(load_image(same), load_image(view))
        np.testing.assert_allclose(same.world_to_camera, view.world_to_camera, atol=1e-8)
    before, after = load_mask(by_name["IMG_0002/cube_front.png"]), load_mask(by_name["IMG_0001/cube_front.png"])
    assert before is not None
    assert before[:30].all()
    assert not before[37:].any()
    assert after is None, "a panorama without a mask shows all of its faces"
    undistort_scene(panoramas, tmp_path / "b")
    files = sorted(path for path in (tmp_path / "a").rglob("*.png"))
    assert all((tmp_path / "b" / file.relative_to(tmp_path / "a")).read_bytes() == file.read_bytes() for file in files)
    with pytest.raises(DataError, match="data undistort"):
        write_cameras(scene, tmp_path / "copied", "colmap", images="copy")
    write_cameras(scene, tmp_path / "alone", "nerfstudio")


def test_points_belong_to_the_faces_that_show_them(panoramas: Path) -> None:
    scene = read_scene(panoramas, 8)
    positions = scene.views[0].position + np.array([[3.0, 0, 0], [0, 0, 3], [0, 0, -3], [0, 3, 0]])
    tracks = Tracks(positions, {"IMG_0000.jpg": np.arange(4)}).split_by_face(scene.views)
    shown = {Path(name).stem: rows.tolist() for name, rows in tracks.rows.items() if len(rows) and "/" in name}
    assert shown == {"cube_right": [0], "cube_front": [1], "cube_back": [2], "cube_down": [3]}


def test_inspection_counts_photographs(panoramas: Path) -> None:
    parts = read_parts(panoramas)
    assert [view.name for view in parts.views] == [f"IMG_{i:04}.jpg" for i in range(9)]
    np.testing.assert_allclose(parts.views[3].world_to_camera[:, :3], np.eye(3), atol=1e-12)


def test_nerfstudio_panoramas_face_forward(tmp_path: Path) -> None:
    """The middle of the image is forward, -z of the frame's matrix; a focal length in the file says nothing."""
    write(tmp_path, camera_model="EQUIRECTANGULAR", w=128, h=64, fl_x=64, fl_y=64, frames=frames("images/a.png"))
    image = np.zeros((64, 128, 3), np.uint8)
    image[30:34, 62:66] = 255
    write_image(tmp_path / "images" / "a.png", image)
    scene = read_scene(tmp_path, 0)
    bright = {view.name: load_image(view).max() for view in scene.views}
    assert [name for name, value in bright.items() if value] == ["images/a/cube_front.png"]
    assert scene.views[0].camera.width == 2 * np.ceil(1.1 * 128 / (2 * np.pi))


@pytest.mark.parametrize(
    ("model", "params", "message"),
    [
        ("EQUIRECTANGULAR", (100, 64), "expected the size of its images, 128, 64"),
        ("FISHEYE", (20, 1e9, 64, 32), "focal lengths up to 0.91 times the long side"),
        ("FOV", (50, 51, 30.5, 520, 0.1), "has no visible pixels"),
        ("EUCM", (20, 20, 64, 32, float("nan"), 1), "finite numbers"),
    ],
)
def test_impossible_wide_lenses_are_refused(tmp_path: Path, model: str, params: tuple, message: str) -> None:
    camera = CameraEntry(1, model, 128, 64, params)
    images = [ImageEntry("a.png"), ImageEntry("b.png")]
    with pytest.raises(DataError, match=message):
        read_scene(write_scene(tmp_path, ColmapModel([camera], images), "txt"), 0)


def test_masks_of_a_folder_hide_faces(panoramas: Path) -> None:
    folder = (panoramas / "masks").rename(panoramas / "my_masks")
    scene = with_masks(read_scene(panoramas, 8), folder)
    assert [len(scene.views), len(scene.train), len(scene.test)] == [53, 41, 12]
    assert photographs(scene, "test") == ["IMG_0000.jpg", "IMG_0008.jpg"]
    assert not any(view.name == "IMG_0002/cube_down.jpg" for view in scene.views)
    assert load_mask(next(view for view in scene.views if view.name == "IMG_0002/cube_left.jpg")) is not None


def test_mask_that_hides_all_faces_is_refused(panoramas: Path) -> None:
    write_image(panoramas / "masks" / "IMG_0002.png", np.zeros((64, 128, 3), np.uint8))
    with pytest.raises(DataError, match="excludes every pixel of 'IMG_0002"):
        read_scene(panoramas, 8)
