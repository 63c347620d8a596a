"""Videos of a model by command and by function: colors, depth, coverage, and photos or models next to them."""

import json
import shutil
import zipfile

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError, NumericError
from clsplat.scene.camera import Camera
from clsplat.scene.images import read_image
from clsplat.scene.view import NO_FILE, View
from clsplat.viewer.video.frames import Canvas, depth_image, depth_normals, letterbox
from clsplat.viewer.video.plan import VideoRequest, plan_video
from tests.support.camera_paths import write_camera_path
from tests.support.commands import clsplat as command
from tests.support.pictures import decoded

pytestmark = pytest.mark.slow


def pictures(folder):
    return {path.relative_to(folder).as_posix(): read_image(path) for path in sorted(folder.rglob("*.png"))}


def test_video_has_the_renders_of_its_path(few_steps, tiny_scene, tmp_path):
    options = {"path": "orbit", "frames": 6, "size": (64, 48), "fps": 5}
    result = clsplat.render_path(few_steps, video=tmp_path / "a.webm", **options)
    assert (result["frames"], result["seconds"], result["size"]) == (6, 1.2, [64, 48])
    assert clsplat.render_path(few_steps, video=None, out=tmp_path / "out", **options)["frames"] == 6
    actual, fps = decoded(tmp_path / "a.webm")
    single = pictures(tmp_path / "out")
    assert fps == 5
    assert list(single) == [f"frame_{i:05d}.png" for i in range(1, 7)]
    for frame, picture in zip(actual, single.values(), strict=True):
        assert clsplat.metrics.psnr(frame, picture) > 25
    model = clsplat.load(few_steps)
    views = clsplat.camera_path(clsplat.read_scene(tiny_scene), "orbit", 6, "64x48")
    renderer = clsplat.Renderer(model)
    images = [renderer.render(view).image for view in views]
    assert np.mean([clsplat.metrics.psnr(a, b) for a, b in zip(images, single.values(), strict=True)]) > 30

    made = plan_video(VideoRequest.parse("orbit", 6, 5, "64x48"), clsplat.read_scene(tiny_scene), model.means)
    write_camera_path(tmp_path / "p.json", made.views, 5)
    again = clsplat.render_path(few_steps, video=tmp_path / "b.webm", path=str(tmp_path / "p.json"))
    assert (again["frames"], again["fps"]) == (6, 5)
    assert (tmp_path / "a.webm").read_bytes() == (tmp_path / "b.webm").read_bytes()


def test_path_file_needs_no_scene(few_steps, tiny_scene, tmp_path):
    write_camera_path(tmp_path / "p.json", clsplat.camera_path(clsplat.read_scene(tiny_scene), frames=2), 30)
    model = shutil.copy(few_steps / "point_cloud.ply", tmp_path)
    result = clsplat.render_path(
        model, video=tmp_path / "a.webm", path=str(tmp_path / "p.json"), frames=5, size="32x32"
    )
    assert (result["frames"], result["size"]) == (5, [32, 32])
    with pytest.raises(ConfigError, match="does not name its scene"):
        clsplat.render_path(model, video=tmp_path / "a.webm", path="through")
    with pytest.raises(ConfigError, match="--scale is for the images of a scene; use --path and --size WxH"):
        clsplat.render_views(model, out=tmp_path, downscale=4)
    with pytest.raises(ConfigError, match="is the position of the camera; use another point"):
        clsplat.render_path(model, None, None, path="fixed", position=(0, 0, 1), look_at=(0, 0, 1))


def test_path_file_needs_no_photographs_of_the_run(few_steps, tiny_scene, tmp_path, caplog):
    write_camera_path(tmp_path / "p.json", clsplat.camera_path(clsplat.read_scene(tiny_scene), frames=2), 30)
    shutil.copytree(few_steps, tmp_path / "run")
    pipeline = tmp_path / "run" / "pipeline.yaml"
    pipeline.write_text(pipeline.read_text().replace(str(tiny_scene), str(tmp_path / "gone")))
    result = clsplat.render_path(
        tmp_path / "run", video=None, out=tmp_path / "a", path=str(tmp_path / "p.json"), size="32x32"
    )
    assert result["frames"] == 2
    assert f"the folder of its photos, {tmp_path / 'gone'}, is missing" in caplog.text
    with pytest.raises(DataError, match="is missing; pass the folder of the scene"):
        clsplat.render_path(tmp_path / "run", video=None, out=tmp_path / "b")


def test_frames_can_be_written_as_images(few_steps, tiny_scene, tmp_path):
    out, options = tmp_path / "out", {"video": None, "out": tmp_path / "out", "size": (16, 16)}
    clsplat.render_path(few_steps, **options, frames=5, depth=True)
    clsplat.render_views(few_steps, out=out)
    clsplat.render_path(few_steps, **options, frames=1, format="npy")
    (out / "frame_00007.png").write_bytes(b"a drawing")
    renders = [path.relative_to(tiny_scene).as_posix() for path in sorted((tiny_scene / "test").glob("*.png"))]
    clsplat.render_path(few_steps, **options, frames=2)
    actual = sorted(path.relative_to(out).as_posix() for path in out.rglob("*.*") if path.is_file())
    frames = ["frame_00001.npy", "frame_00001.png", "frame_00002.png", "frame_00007.png"]
    assert actual == [".renders.json", *frames, *renders]
    with pytest.raises(ConfigError, match=r"frame_00007\.png: exists, and is not from an earlier render"):
        clsplat.render_path(few_steps, **options, frames=7)
    (out / "frame_00003.png").write_bytes(b"a drawing")
    with pytest.raises(ConfigError, match=r"frame_00003\.png: exists, and is not from an earlier render"):
        clsplat.render_path(few_steps, **options, frames=3)


def test_failed_video_leaves_the_earlier_one(few_steps, tmp_path, monkeypatch):
    clsplat.render_path(few_steps, video=None, out=tmp_path / "out", frames=3, size=(16, 16))
    before = pictures(tmp_path / "out")
    monkeypatch.setattr(Canvas, "render_layers", lambda *_: (_ for _ in ()).throw(NumericError("no picture")))
    with pytest.raises(NumericError, match="no picture"):
        clsplat.render_path(few_steps, video=None, out=tmp_path / "out", frames=1, size=(16, 16))
    assert pictures(tmp_path / "out").keys() == before.keys()
    monkeypatch.undo()
    clsplat.render_path(few_steps, video=None, out=tmp_path / "out", frames=1, size=(16, 16))
    assert list(pictures(tmp_path / "out")) == ["frame_00001.png"]


@pytest.mark.parametrize("record", [{"../a.png": True, "sub/b.png": True, "\0.png": True}, "x", [["a.png"]]])
def test_foreign_record_removes_no_files(record, few_steps, tmp_path):
    (tmp_path / "out" / "sub").mkdir(parents=True)
    for name in ("a.png", "out/sub/b.png"):
        (tmp_path / name).write_bytes(b"a drawing")
    (tmp_path / "out" / ".renders.json").write_text(json.dumps(record))
    clsplat.render_path(few_steps, video=None, out=tmp_path / "out", frames=2, size=(16, 16))
    assert (tmp_path / "a.png").is_file()
    assert (tmp_path / "out" / "sub" / "b.png").is_file()


def test_sog_folder_with_a_path_file_needs_no_scene(few_steps, tiny_scene, tmp_path):
    write_camera_path(tmp_path / "p.json", clsplat.camera_path(clsplat.read_scene(tiny_scene), frames=2), 30)
    clsplat.load(few_steps).save(tmp_path / "m.sog")
    with zipfile.ZipFile(tmp_path / "m.sog") as archive:
        archive.extractall(tmp_path / "m")
    options = {"path": str(tmp_path / "p.json"), "size": "32x32"}
    result = clsplat.render_path(tmp_path / "m", video=tmp_path / "a.webm", **options)
    assert result["frames"] == 2
    clsplat.render_path(tmp_path / "m" / "meta.json", video=tmp_path / "b.webm", **options)
    assert (tmp_path / "a.webm").read_bytes() == (tmp_path / "b.webm").read_bytes()
    with pytest.raises(ConfigError, match="does not name its scene"):
        clsplat.render_path(tmp_path / "m", video=tmp_path / "a.webm", path="views")


def test_command_and_function_write_the_same_bytes(few_steps, tmp_path):
    output = command(
        *("render", few_steps, "--path", "views", "--frames", "3", "--video", tmp_path / "a.webm"),
        *("--side", "photograph", "--depth", "--alpha", "--size", "40x40", "--fps", "2"),
    ).stdout
    assert "3 frames of 80 x 40 px" in output
    assert "a.webm, a_depth.webm, a_alpha.webm" in output
    clsplat.render_path(
        few_steps, None, tmp_path / "b.webm", path="views", frames=3, fps=2, size="40x40", side="photograph", depth=True
    )
    assert (tmp_path / "a.webm").read_bytes() == (tmp_path / "b.webm").read_bytes()
    assert (tmp_path / "a_depth.webm").read_bytes() == (tmp_path / "b_depth.webm").read_bytes()
    assert not (tmp_path / "b_alpha.webm").exists()


def test_photo_of_the_nearest_camera_is_shown_next_to_it(few_steps, tiny_scene, tmp_path):
    clsplat.render_path(few_steps, video=tmp_path / "a.webm", path="views", frames=10, side="photograph")
    actual, _ = decoded(tmp_path / "a.webm")
    scene = clsplat.read_scene(tiny_scene)
    assert len(actual) == len(scene.views)
    for frame, view in zip(actual, scene.views, strict=True):
        assert frame.shape == (40, 80, 3)
        assert clsplat.metrics.psnr(frame[:, 40:], view.photograph(1.0)) > 24


def test_another_model_is_shown_next_to_it(few_steps, tmp_path):
    clsplat.render_path(few_steps, video=tmp_path / "a.webm", frames=2, side=few_steps / "point_cloud.ply")
    for frame in decoded(tmp_path / "a.webm")[0]:
        assert np.abs(frame[:, :40].astype(int) - frame[:, 40:]).mean() < 3


def test_depth_and_coverage_are_images_and_arrays(few_steps, tmp_path):
    count = clsplat.render_views(few_steps, out=tmp_path / "png", depth=True, alpha=True)
    assert count == 6 == len(pictures(tmp_path / "png"))
    clsplat.render_views(few_steps, out=tmp_path / "npy", format="npy", depth=True, alpha=True)
    depth, alpha = (np.load(tmp_path / "npy" / "test" / f"r_000_{name}.npy") for name in ("depth", "alpha"))
    assert depth.shape == alpha.shape == (40, 40)
    assert 0 <= alpha.min() < 0.1
    assert 0.9 < alpha.max() <= 1
    seen = depth[alpha > 0.5]
    assert 1 < seen.min() < seen.max() < 8
    gray = read_image(tmp_path / "png" / "test" / "r_000_alpha.png")
    np.testing.assert_allclose(gray[:, :, 1] / 255, alpha, atol=0.5 / 255)


def test_median_depth_and_normals_are_images_and_arrays(few_steps, tmp_path):
    clsplat.render_views(few_steps, out=tmp_path / "png", depth="median", normals=True)
    command("render", few_steps, "--depth", "median", "--normals", "--format", "npy", "--out", tmp_path / "npy")
    files = [tmp_path / "npy" / "test" / f"r_000_{name}.npy" for name in ("median_depth", "normals")]
    median_depth, normals = map(np.load, files)
    image = read_image(tmp_path / "png" / "test" / "r_000_normals.png")
    is_known = (normals != 0).any(axis=2)
    assert is_known.any()
    np.testing.assert_allclose(np.linalg.norm(normals[is_known], axis=1), 1, rtol=1e-5)
    np.testing.assert_allclose(image[is_known], (normals[is_known] + 1) / 2 * 255, atol=1)
    assert median_depth[is_known].max() > 1


def test_normals_of_a_plane_are_exact_in_scene_axes():
    """The plane z = 4 + x / 2 in the axes of a camera that is turned by 90 degrees; beside it, nothing."""
    camera = Camera(20, 10, 15.0, 15.0, 10.0, 5.0)
    x = (np.arange(20) + 0.5 - 10) / 15
    depth = np.tile(4 / (1 - x / 2), (10, 1)).astype(np.float32)
    depth[:, 15:] = 0
    turned = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 2]], np.float32)
    normals = depth_normals(depth, View("a", camera, turned, NO_FILE))
    is_inside = np.zeros((10, 20), bool)
    is_inside[1:-1, 1:14] = True
    np.testing.assert_array_equal((normals != 0).any(axis=2), is_inside)
    expected = np.array([0.5, 0, -1]) / np.hypot(1, 0.5) @ turned[:, :3]
    np.testing.assert_allclose(normals[is_inside], np.tile(expected, (is_inside.sum(), 1)), atol=1e-5)


def test_depth_colors_range_from_red_to_blue():
    depth = np.array([[1.0, 2.0, 4.0, 0.0]], np.float32)
    ((near, middle, far, nothing),) = depth_image(depth, np.ones((1, 4), np.float32), (1.0, 4.0)).astype(int)
    assert near[0] > 80 + near[2]
    assert far[2] > far[0]
    assert middle[1] > max(middle[0], middle[2]) - 60
    assert nothing.tolist() == [0, 0, 0]


def test_image_is_centered_in_its_box():
    box = letterbox(np.full((10, 20, 3), 7, np.uint8), (40, 40))
    assert box.shape == (40, 40, 3)
    assert (box[10:30] == 7).all()
    assert (box[:10] == 0).all()


@pytest.mark.parametrize(
    ("options", "message"),
    {
        ("--frames", "5"): "--frames is for videos; add --path or --video",
        ("--path", "orbit", "--split", "all"): "--split is for images of views",
        ("--video", "x.avi"): "ends in .webm or .mp4",
    }.items(),
)
def test_invalid_command_ends_in_one_line(options, message, few_steps, tmp_path):
    given = [tmp_path / word if word.startswith("x.") else word for word in options]
    output = command("render", few_steps, "--out", tmp_path / "out", *given, expect=2).stderr
    assert message in output
    assert output.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"path": "elipse"}, "path 'elipse': expected one of ellipse"),
        ({"frames": 0}, "expected a whole number from 1 to 100000"),
        ({"size": "33x32"}, "expected WIDTHxHEIGHT in even numbers"),
        ({"size": "8192x32", "side": "photograph"}, "size \\(16384, 32\\)"),
        ({"fps": float("nan")}, "expected frames per second"),
        ({"video": None, "side": "photograph"}, "--side needs --video"),
        ({"format": "gif", "video": None}, "expected png or npy, got 'gif'"),
        ({"format": "npy"}, "--format npy applies only to images"),
        ({"side": "no.ply"}, "no.ply"),
    ],
)
def test_invalid_video_is_refused_before_any_work(options, message, few_steps, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ConfigError, DataError), match=message):
        clsplat.render_path(few_steps, **options)
    assert not list(tmp_path.iterdir())


def test_model_without_a_scene_is_rendered_from_outside(few_steps, tmp_path):
    """A still, a turntable whose first frame is the still, and a camera at a given position."""
    model = shutil.copy(few_steps / "point_cloud.ply", tmp_path / "scan.ply")
    assert clsplat.render_views(model, out=tmp_path / "still") == 1
    still = read_image(tmp_path / "still" / "view.png")
    assert still.shape == (900, 1200, 3)
    options = {"video": None, "size": (64, 48)}
    clsplat.render_path(model, out=tmp_path / "a", path="fixed", frames=1, **options)
    clsplat.render_path(model, out=tmp_path / "b", path="orbit", frames=4, **options)
    first = read_image(tmp_path / "b" / "frame_00001.png").astype(int)
    assert np.abs(first - read_image(tmp_path / "a" / "view.png")).mean() < 2
    assert np.abs(first - read_image(tmp_path / "b" / "frame_00003.png")).mean() > 2
    with pytest.raises(ConfigError, match="add --from"):
        clsplat.render_path(model, out=tmp_path / "c", path="fixed", look_at=(0, 0, 0), **options)
    with pytest.raises(ConfigError, match="expected x, y, and z"):
        clsplat.render_path(model, out=tmp_path / "c", path="fixed", position=(0, 0), **options)


@pytest.mark.parametrize("target", [(0.5, 0.0, 0.0), (1.0, 0.0, 3.0), (1.0, 2.0, -1.0)])
def test_camera_is_where_it_was_requested(few_steps, tiny_scene, target):
    """Also straight down or up."""
    scene, points = clsplat.read_scene(tiny_scene), clsplat.load(few_steps).means
    options = {"position": (1.0, 2.0, 3.0), "target": target}
    for used_scene in (scene, None):
        plan = plan_video(VideoRequest.parse("fixed", 2, None, "64x48", **options), used_scene, points)
        assert len(plan.views) == 2
        for view in plan.views:
            np.testing.assert_allclose(view.position, (1, 2, 3), atol=1e-9)
            x, y, z = view.world_to_camera @ (*target, 1)
            np.testing.assert_allclose([x, y], 0, atol=1e-9)
            assert z > 0
