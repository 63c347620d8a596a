"""Inspection of datasets: constructed ones with one fault each, and real ones without faults."""

import json
import os
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clsplat.core.errors import DataError
from clsplat.formats.table import write as write_splats
from clsplat.pipeline.file import SceneSettings
from clsplat.prepare.inspect.facts import measure_distortion
from clsplat.prepare.inspect.findings import Inspection
from clsplat.prepare.inspect.page import MAX_NAMES, inspection_page
from clsplat.runs.opening import RunScene
from clsplat.scene.camera import Lens
from clsplat.scene.detect import read_scene
from clsplat.scene.images import CameraExposure, write_exposures
from clsplat.scene.reprojection import require_points_in_front
from clsplat.scene.view import load_image, load_mask
from tests.support.colmap_writer import (
    ImageEntry,
    PointEntry,
    tiny_model,
    write_model,
    write_scene,
)
from tests.support.commands import clsplat
from tests.support.data_sets import data_set
from tests.support.html_page import HOSTILE, Page
from tests.support.models import splats
from tests.support.orbit_scene import COUNT, SIZE, finding_text, orbit, photograph, write
from tests.support.pictures import with_exif
from tests.support.runs import train


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write(tmp_path / "scene", orbit())


def changed(images: list[ImageEntry], index: int, **changes: object) -> list[ImageEntry]:
    return [replace(image, **changes) if i == index else image for i, image in enumerate(images)]


# ---- healthy


def test_healthy_scene_is_ready(scene):
    inspection = Inspection.from_folder(scene)
    facts = inspection.facts
    assert (inspection.verdict, inspection.findings) == ("ready to train", [])
    assert (facts.kind, facts.registered, facts.on_disk, facts.train, facts.test) == ("COLMAP", 24, 24, 21, 3)
    assert facts.extent == pytest.approx(read_scene(scene).extent)
    assert (facts.points.count, facts.points.in_two, facts.points.behind) == (200, 1.0, 0.0)
    (camera,) = facts.cameras
    assert (camera.views, camera.model, camera.width, camera.height, camera.focal) == (24, "PINHOLE", 64, 48, (60, 60))
    assert (camera.distortion, camera.kept) == (0, 1)


@pytest.mark.parametrize("name", ["fox_opencv", "fox_nerfstudio", "lego_200", "lund"])
def test_real_sets_are_ready(name):
    inspection = Inspection.from_folder(data_set(name))
    assert inspection.verdict == "ready to train", [finding.text for finding in inspection.findings]
    scene = read_scene(data_set(name))
    assert (inspection.facts.train, inspection.facts.test) == (len(scene.train), len(scene.test))
    assert inspection.facts.on_disk == inspection.facts.registered


def test_real_model_has_observations_and_errors():
    pycolmap = pytest.importorskip("pycolmap")
    facts = Inspection.from_folder(data_set("kitchen")).facts
    theirs = pycolmap.Reconstruction(data_set("kitchen") / "sparse" / "0")
    assert facts.points_per_view == {image.name: image.num_points3D for image in theirs.images.values()}
    errors = [point.error for point in theirs.points3D.values()]
    assert facts.points.error_mean == pytest.approx(np.mean(errors), rel=0.005)  # cameras were rounded afterwards
    assert facts.points.error_90 == pytest.approx(np.quantile(errors, 0.9), rel=0.005)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_text_and_binary_models_see_the_same_points(kind):
    folder = data_set("colmap_models/statue_OPENCV")
    seen = Inspection.from_folder(folder / "text" if kind == "txt" else folder).facts.points_per_view
    assert len(seen) == 9
    assert seen == Inspection.from_folder(folder).facts.points_per_view


def test_views_and_points_of_a_blender_scene_are_counted(tiny_scene):
    facts = Inspection.from_folder(tiny_scene).facts
    assert (facts.kind, facts.registered, facts.train, facts.test) == ("Blender", 10, 8, 2)
    assert facts.points.count > 0


def test_blurred_or_differently_exposed_photographs_are_named(scene, tmp_path):
    images = sorted((scene / "images").iterdir())
    cv2.imwrite(str(images[3]), cv2.GaussianBlur(cv2.imread(str(images[3])), (0, 0), 2))
    cv2.imwrite(str(images[9]), cv2.imread(str(images[5])) ^ 1)
    seconds = {image.name: 0.01 * (4 if i > 11 else 1) for i, image in enumerate(images)}
    write_exposures(scene / "images", {name: CameraExposure(one, 2.0, 100.0) for name, one in seconds.items()})
    inspection = Inspection.from_folder(scene)
    assert finding_text(inspection, "warning").startswith(
        f"1 photo is blurred ({images[3].name}): remove or retake them"
    )
    notes = [finding.text for finding in inspection.findings if finding.level == "note"]
    assert notes[0].startswith(f"{images[5].name}, {images[9].name} look the same")
    assert f"jumps by more than a stop 1 time ({images[11].name} to {images[12].name}: 2.0)" in notes[1]
    assert len(notes) == 2


def test_distortion_is_the_displacement_at_the_corner():
    assert measure_distortion(Lens(200, 100, "SIMPLE_RADIAL", (100.0, 100.0, 50.0, 0.1))) == pytest.approx(
        100 * 0.1 * np.hypot(1, 0.5) ** 3
    )
    assert measure_distortion(Lens(200, 100, "SIMPLE_RADIAL", (1e-300, 100.0, 50.0, 0.1))) is None


# ---- errors: what the reader refuses too


def test_missing_image_prevents_training(scene):
    (scene / "images" / "03.png").unlink()
    inspection = Inspection.from_folder(scene)
    assert inspection.facts.missing == ["images/03.png"]
    assert "1 of 24 registered images are missing on disk (images/03.png) (searched: images): restore" in finding_text(
        inspection, "error"
    )
    assert inspection.verdict.startswith("cannot train: 1 of 24 registered images")
    assert inspection.facts.train is None
    assert inspection.facts.points.in_two == 1.0  # the rest is inspected all the same


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes")
def test_pipe_named_as_an_image_is_not_reported_as_missing(scene):
    (scene / "images" / "03.png").unlink()
    os.mkfifo(scene / "images" / "03.png")
    inspection = Inspection.from_folder(scene)
    assert inspection.facts.missing == []
    assert "decoded (03.png): cannot be read (it is a pipe); export" in finding_text(inspection, "error")


@pytest.mark.parametrize(
    ("size", "word"), [((32, 20), "not the size of the camera"), ((48, 64), "width and height are swapped")]
)
def test_images_of_another_size(scene, size, word):
    photograph(scene / "images" / "05.png", size)
    inspection = Inspection.from_folder(scene)
    assert word in finding_text(inspection, "error")
    assert f"05.png is {size[0]}x{size[1]}, its camera 64x48" in finding_text(inspection, "error")
    with pytest.raises(DataError):  # as training would
        load_image(read_scene(scene).views[5])


def test_larger_images_of_the_same_shape_are_allowed(tmp_path):
    inspection = Inspection.from_folder(write(tmp_path, orbit(), size=(128, 96)))
    assert inspection.verdict == "ready to train"


def test_unreadable_image_is_an_error(scene):
    (scene / "images" / "05.png").write_bytes(b"\x89PNG\r\n\x1a\nnot really")
    assert "1 image file cannot be decoded (05.png)" in finding_text(Inspection.from_folder(scene), "error")


def test_test_view_with_damaged_pixels(scene):
    file = scene / "images" / "08.png"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 255  # headers and end stay as they are
    file.write_bytes(content)
    inspection = Inspection.from_folder(scene)
    assert "08.png" in {view.name for view in read_scene(scene).split("test")}
    assert inspection.verdict == "cannot train: 1 image file cannot be decoded (08.png)"
    done = clsplat("inspect", scene, expect=3)
    printed = " ".join(done.stdout.split())
    assert "1 image file cannot be decoded (08.png): not an image, or a damaged one" in printed
    assert "is wrong); export them again" in printed


def test_nonfinite_pose_in_a_text_model(tmp_path):
    model = orbit()
    model = replace(model, images=changed(model.images, 2, translation=(0.0, float("nan"), 4.0)))
    inspection = Inspection.from_folder(write(tmp_path, model, "txt"))
    assert "the pose of '02.png' is quaternion" in finding_text(inspection, "error")
    assert (len(inspection.parts.views), inspection.facts.registered) == (23, 24)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_truncated_file_is_one_error_among_others(scene, stem):
    file = scene / "sparse" / "0" / f"{stem}.bin"
    file.write_bytes(file.read_bytes()[:-5])
    inspection = Inspection.from_folder(scene)
    assert f"{stem}.bin: byte " in finding_text(inspection, "error")
    assert len(inspection.parts.views) == (24 if stem == "points3D" else 0)
    assert inspection.facts.on_disk == 24
    assert (inspection.facts.points is None) == (stem == "points3D")
    assert "cannot train" in inspection_page(inspection).lower()


def test_photographs_without_poses_are_an_error(tmp_path):
    photograph(tmp_path / "a.png")
    inspection = Inspection.from_folder(tmp_path)
    assert "contains 1 photo but no camera poses" in finding_text(inspection, "error")


def test_folder_without_a_dataset_is_an_error(tmp_path):
    assert "no dataset found" in finding_text(Inspection.from_folder(tmp_path), "error")
    with pytest.raises(DataError, match="no such folder"):
        Inspection.from_folder(tmp_path / "nowhere")


def test_damaged_frames_are_named_one_by_one(tiny_scene, tmp_path):
    folder = shutil.copytree(tiny_scene, tmp_path / "scene")
    table = json.loads((folder / "transforms_train.json").read_text())
    table["frames"][1]["transform_matrix"][0][3] = float("nan")
    del table["frames"][2]["file_path"]
    (folder / "transforms_train.json").write_text(json.dumps(table))
    inspection = Inspection.from_folder(folder)
    faults = [finding.text for finding in inspection.findings if finding.level == "error"]
    assert len(faults) == 2
    assert "frames[1]: transform_matrix" in "".join(faults)
    assert "frames[2]: has no `file_path`" in "".join(faults)
    assert len(inspection.parts.views) == 8


@pytest.mark.parametrize("kind", ["bin", "txt"])
@given(data=st.data())
@settings(max_examples=100, deadline=None)
def test_trainable_means_readable_by_a_reader(tmp_path_factory, kind: str, data: st.DataObject) -> None:
    path = write(tmp_path_factory.mktemp("scene"), tiny_model(), kind)
    files = [file for file in sorted(path.rglob("*")) if file.is_file()]
    file = data.draw(st.sampled_from(files))
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, min(len(content) - 1, 400)))] = data.draw(st.integers(0, 255))
    file.write_bytes(content)
    inspection = Inspection.from_folder(path)
    json.dumps(inspection.data(), allow_nan=False)
    inspection_page(inspection)
    try:
        scene = read_scene(path)
        for view in scene.views:
            load_image(view)
        if scene.points is not None:
            require_points_in_front(scene.points, scene)
    except DataError:
        assert not inspection.is_trainable
    else:
        assert inspection.is_trainable, inspection.verdict


# ---- warnings and notes


def test_images_without_a_pose_are_reported(scene):
    photograph(scene / "images" / "other.png")
    inspection = Inspection.from_folder(scene)
    assert inspection.facts.unregistered == ["images/other.png"]
    assert inspection.verdict == "ready to train"
    assert "1 of 25 images on disk have no pose" in finding_text(inspection, "note")
    for i in range(5):
        photograph(scene / "images" / f"other{i}.png")
    assert Inspection.from_folder(scene).verdict.startswith("trains, but 6 of 30 images on disk have no pose")


def test_outlier_camera_is_a_warning(tmp_path):
    model = orbit()
    model = replace(model, images=changed(model.images, 4, translation=(0.0, 0.0, 4000.0)))
    inspection = Inspection.from_folder(write(tmp_path, model))
    assert inspection.facts.outlier_cameras == ["04.png"]
    assert "1 camera is far away from all others (04.png)" in finding_text(inspection, "warning")
    assert inspection.verdict.startswith("trains, but 1 camera is far away")
    assert "far away from all others" in inspection_page(inspection)


def test_unused_colmap_models_are_a_warning(scene):
    model = orbit()
    write_model(scene / "sparse" / "1", replace(model, images=model.images[:6]))
    write_model(scene / "sparse" / "2", replace(model, images=model.images[:1]))
    inspection = Inspection.from_folder(scene)
    assert inspection.facts.submodels == {"sparse/0": 24, "sparse/1": 6, "sparse/2": 1}
    assert "COLMAP made 3 models and only sparse/0 (24 images) is used" in finding_text(inspection, "warning")


def test_names_that_differ_only_in_case(tmp_path):
    model = orbit()
    images = changed(model.images, 1, name="A.png")
    images = changed(changed(changed(images, 2, name="a.png"), 3, name="left/x.png"), 4, name="right/x.png")
    inspection = Inspection.from_folder(write(tmp_path, replace(model, images=images)))
    assert "A.png and a.png differ only in upper and lower case" in finding_text(inspection, "warning")
    assert inspection.facts.folders == 3


def test_photographs_with_equal_poses_are_noted(tmp_path):
    model = orbit()
    images = changed(model.images, 1, quaternion=model.images[0].quaternion)
    inspection = Inspection.from_folder(write(tmp_path, replace(model, images=images)))
    assert inspection.facts.same_pose == [["00.png", "01.png"]]
    assert "00.png, 01.png have exactly the same pose" in finding_text(inspection, "note")


def test_coincident_cameras_are_a_warning(tmp_path):
    model = orbit()
    images = [replace(model.images[0], name=image.name) for image in model.images]
    assert "all cameras are at the same position" in finding_text(
        Inspection.from_folder(write(tmp_path, replace(model, images=images))), "warning"
    )


def test_points_behind_all_cameras(tmp_path):
    model = orbit()
    flipped = [replace(image, translation=(0.0, 0.0, -4.0)) for image in model.images]  # all look outwards
    inspection = Inspection.from_folder(write(tmp_path, replace(model, images=flipped)))
    assert inspection.facts.points.behind == 1.0
    assert "all 200 points are behind all training cameras" in finding_text(inspection, "error")
    moved = replace(flipped[4], translation=(0.0, 0.0, 0.0))  # stands in the middle and sees some
    inspection = Inspection.from_folder(write(tmp_path, replace(model, images=[*flipped[:4], moved, *flipped[5:]])))
    assert 0.1 < inspection.facts.points.behind < 0.9
    assert "% of the points are behind all cameras" in finding_text(inspection, "warning")


def test_points_outside_all_images(tmp_path):
    model = orbit()
    above = [replace(point, position=(0, 0, 4 + i % 7)) for i, point in enumerate(model.points)]
    inspection = Inspection.from_folder(write(tmp_path, replace(model, points=above)))
    assert "only 0 % of the points project into two or more views" in finding_text(inspection, "warning")


def test_nonfinite_or_very_far_points(tmp_path):
    model = orbit()
    points = [*model.points, PointEntry((float("nan"), 0, 0)), PointEntry((1e5, 0, 0)), PointEntry((0, 1e300, 0))]
    inspection = Inspection.from_folder(write(tmp_path, replace(model, points=points)))
    assert (inspection.facts.points.not_finite, inspection.facts.points.distant) == (2, 1)
    assert "2 points are not finite" in finding_text(inspection, "warning")
    assert "1 point is more than 100 times" in finding_text(inspection, "note")


def test_views_with_few_points(scene):
    """The writer leaves 2D points unconnected; here those of all images but one are connected, at no known place."""
    lines = ["# images"]
    for i, image in enumerate(orbit().images):
        pose = " ".join(map(str, [*image.quaternion, *image.translation]))
        lines += [f"{i + 1} {pose} 1 {image.name}", " ".join(["nan nan 7"] * (5 if i == 3 else 50) + ["3 4 -1"] * 90)]
    for file in (scene / "sparse" / "0").iterdir():
        file.unlink()
    write_model(scene / "sparse" / "0", orbit(), "txt")
    (scene / "sparse" / "0" / "images.txt").write_text("\n".join(lines) + "\n")
    inspection = Inspection.from_folder(scene)
    assert inspection.facts.points_per_view == {f"{i:02}.png": 5 if i == 3 else 50 for i in range(COUNT)}
    assert "1 view shows fewer than 30 points (03.png: 5)" in finding_text(inspection, "warning")


def test_large_reprojection_error_is_a_warning(scene):
    rows = [struct.pack("<Q3d3BdQ", i, 0.1, 0.1, i / 200, 9, 9, 9, 2 + i / 100, 0) for i in range(200)]
    (scene / "sparse" / "0" / "points3D.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
    assert "the mean reprojection error of the points is 3.00 px" in finding_text(
        Inspection.from_folder(scene), "warning"
    )


def test_truncated_and_rotated_images(tmp_path):
    model = orbit()
    path = write(tmp_path, replace(model, images=[replace(i, name=i.name[:2] + ".jpg") for i in model.images]))
    whole = (path / "images" / "05.jpg").read_bytes()
    (path / "images" / "05.jpg").write_bytes(whole[: len(whole) // 2])
    (path / "images" / "06.jpg").write_bytes(with_exif(whole, ">", 6))
    inspection = Inspection.from_folder(path)
    assert "the end is missing from 1 image file (05.jpg): copy" in finding_text(inspection, "error")
    assert "1 photo is rotated by EXIF" in finding_text(inspection, "note")


def test_rotated_images_that_the_reader_turns(tmp_path):
    model = orbit()
    path = write(tmp_path, replace(model, images=[replace(i, name=i.name[:2] + ".jpg") for i in model.images]))
    photograph(path / "images" / "06.jpg", SIZE[::-1])
    file = path / "images" / "06.jpg"
    assert "width and height are swapped" in finding_text(Inspection.from_folder(path), "error")
    file.write_bytes(with_exif(file.read_bytes(), "<", 6))
    assert Inspection.from_folder(path).findings == []
    assert load_image(read_scene(path).views[6]).shape == (48, 64, 3)


def make_blank(files: list[Path], kind: str) -> None:
    for file in files:
        pixels = cv2.imread(str(file))
        if kind == "mask":
            (file.parents[1] / "masks").mkdir(exist_ok=True)
            file = file.parents[1] / "masks" / file.name
            pixels = np.ones_like(pixels)
        elif kind == "transparent":
            pixels = np.dstack([pixels, np.zeros_like(pixels[:, :, :1])])
        else:
            pixels = np.full_like(pixels, {"black": 3, "one color": 130}[kind])
        cv2.imwrite(str(file), pixels)


@pytest.mark.parametrize("kind", ["black", "one color", "transparent", "mask"])
def test_photographs_that_show_nothing_stop_inspection_and_run(scene, kind, caplog):
    files = sorted((scene / "images").iterdir())
    make_blank([files[1]], kind)
    inspection = Inspection.from_folder(scene)
    if kind != "mask":
        assert any("1 photo is black, a single color, or transparent (01.png)" in f.text for f in inspection.findings)
        RunScene.from_scene(SceneSettings(path=str(scene)), read_scene(scene))
        assert "1 photo is blank (black, a single color, or transparent): 01.png" in caplog.text
        make_blank(files, kind)
        inspection = Inspection.from_folder(scene)
    with pytest.raises(DataError) as error:
        RunScene.from_scene(SceneSettings(path=str(scene)), read_scene(scene))
    words = "masks exclude every pixel of 1 photo" if kind == "mask" else "all photos are blank"
    assert words in str(error.value)
    assert inspection.verdict.startswith(f"cannot train: {words}")


def test_masks_of_wrong_size_or_content_are_errors(scene):
    (scene / "masks").mkdir()
    photograph(scene / "masks" / "00.png")
    assert (Inspection.from_folder(scene).facts.photos.mask_count, Inspection.from_folder(scene).findings) == (1, [])
    photograph(scene / "masks" / "01.png", (32, 20))
    assert "mask of 01.png is 32x20, its camera 64x48" in finding_text(Inspection.from_folder(scene), "error")
    with pytest.raises(DataError):
        load_mask(read_scene(scene).views[1])
    (scene / "masks" / "01.png").write_bytes(b"no image")
    assert "1 image file cannot be decoded (mask of 01.png)" in finding_text(Inspection.from_folder(scene), "error")


def test_few_training_views_are_reported(tmp_path):
    model = orbit()
    inspection = Inspection.from_folder(write(tmp_path, replace(model, images=model.images[:5])))
    assert inspection.verdict == "trains, but there are only 4 training views"


# ---- what is shown


def test_inspect_writes_a_self_contained_page(scene, tmp_path):
    done = clsplat("inspect", scene, "--html", tmp_path / "page.html")
    assert done.stdout.splitlines()[-1].strip() == "ready to train"
    assert "reprojection" not in done.stdout  # the writer's errors are all the same: a placeholder
    page = (tmp_path / "page.html").read_text()
    assert "Ready to train" in page
    assert page.count("<title>") == 1 + 2 * 24, "each camera with its name, from above and from the side"
    assert all(f">{count} {kind}</text>" in page for count, kind in ((21, "training"), (3, "test")))
    assert "://" not in page  # nothing from outside


def test_json_and_the_exit_code(scene):
    data = json.loads(clsplat("inspect", scene, "--json").stdout)
    assert (data["trainable"], data["verdict"], data["facts"]["registered"]) == (True, "ready to train", 24)
    (scene / "images" / "03.png").unlink()
    done = clsplat("inspect", scene, "--json", expect=3)
    data = json.loads(done.stdout)
    assert not data["trainable"]
    assert [finding["level"] for finding in data["findings"]] == ["error"]
    assert done.stderr.startswith("error: cannot train: 1 of 24")


def test_markup_in_names_is_shown_as_text(tmp_path):
    """In the names of the folder, of views, and of files on disk: in findings, lists and data."""
    model = orbit()
    name = f"</script>{HOSTILE}.png"
    path = write_scene(tmp_path / HOSTILE, replace(model, images=changed(model.images, 3, name=name)))
    photograph(path / "images" / f"{HOSTILE}.png")
    inspection = Inspection.from_folder(path)
    page = Page(inspection_page(inspection))
    assert page.elements["script"] == 0
    assert f"images/{HOSTILE}.png" in page.text, "in the list of images without a pose"
    assert name in page.text, "in a finding: the file is empty"
    assert f"{HOSTILE}: inspection of the dataset" in page.text
    assert page.text.count(name) > 2, "at its camera, too"


def test_long_lists_of_names_are_cut(tmp_path):
    path = write(tmp_path, orbit())
    for i in range(MAX_NAMES + 5):
        photograph(path / "images" / f"more{i:03}.png", (4, 4))
    text = Page(inspection_page(Inspection.from_folder(path))).text
    assert f"on disk but without a pose ({MAX_NAMES + 5})" in text
    assert f"more{MAX_NAMES - 1:03}.png" in text
    assert f"more{MAX_NAMES:03}.png" not in text
    assert "… and 5 more" in text


def test_model_is_refused_as_a_dataset(tmp_path, rng):
    write_splats(tmp_path / "a.ply", splats(rng, 3))
    done = clsplat("inspect", tmp_path / "a.ply", expect=3)
    assert "a.ply: is a model (PLY), which `clsplat check` reads; expected the folder of a dataset" in done.stderr
    (tmp_path / "b.txt").write_text("text")
    done = clsplat("inspect", tmp_path / "b.txt", expect=3)
    assert "b.txt: is a file; expected the folder of a dataset" in done.stderr


def test_run_and_inspect_warn_of_few_views(tiny_scene, tmp_path, caplog):
    warned = [
        finding.text for finding in Inspection.from_folder(tiny_scene).findings if "training views" in finding.fault
    ]
    caplog.clear()
    train(tiny_scene, tmp_path / "run", "optimize.steps=2", "optimize.during=[]")
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == warned
    assert warned[0].startswith("there are only 8 training views: expect floaters")
