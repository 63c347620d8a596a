"""Photographs, masks, and models with other paths or names than the dataset says."""

import json
import logging
import unicodedata
from dataclasses import replace
from pathlib import Path

import pytest

from clsplat.photos.depths import DepthMaps
from clsplat.prepare.inspect.findings import Inspection
from clsplat.scene.detect import is_scene, read_scene
from clsplat.scene.view import load_image
from tests.support.colmap_writer import ImageEntry, tiny_model, write_model
from tests.support.orbit_scene import orbit, photograph
from tests.support.refusals import refusal
from tests.support.transforms_scene import LENS, POSE, SIDE

NFC, NFD = (unicodedata.normalize(form, "Käse.jpg") for form in ("NFC", "NFD"))


def made(folder: Path, kind: str, names: list[str], files: list[str], size: tuple[int, int] = (64, 48)) -> Path:
    """A dataset with an image of each name, and image files that may be somewhere else."""
    if kind == "colmap":
        images = [ImageEntry(name, translation=(i, 0, 0)) for i, name in enumerate(names)]
        write_model(folder / "sparse" / "0", replace(tiny_model(), images=images))
    else:
        frames = [{"file_path": name, "transform_matrix": (POSE, SIDE)[i % 2]} for i, name in enumerate(names)]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{kind}.json").write_text(json.dumps(LENS | {"frames": frames}))
    for file in files:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        photograph(folder / file, size)
    return folder


def located(scene: Path) -> dict[str, str]:
    """The file of each view, by its name."""
    return {view.name: view.image_path.relative_to(scene).as_posix() for view in read_scene(scene, 0).views}


JSON, BLENDER = "transforms", "transforms_train"
MATCHES = {  # the kind of dataset, the names in it, and the files on disk in the same order
    "back slashes": ("colmap", ["left\\a.jpg", "right\\a.jpg"], ["images/left/a.jpg", "images/right/a.jpg"]),
    "a Windows drive": ("colmap", ["C:\\my scene\\images\\a.jpg"], ["images/a.jpg"]),
    "mixed slashes": (JSON, ["D:\\x/images\\a.jpg"], ["images/a.jpg"]),
    "a share": ("colmap", ["\\\\server\\share\\a.jpg"], ["images/a.jpg"]),
    "another machine": (JSON, ["/home/somebody/scene/images/a.jpg"], ["images/a.jpg"]),
    "up and down": (JSON, ["../scene/images/a.jpg"], ["images/a.jpg"]),
    "case of the suffix": ("colmap", ["a.jpg", "b.JPG"], ["images/a.JPG", "images/b.jpg"]),
    "case of names": ("colmap", ["IMG_1.jpg"], ["Images/img_1.JPG"]),
    "no suffix": (BLENDER, ["./train/r_0"], ["train/r_0.jpg"]),
    "dots and no suffix": (JSON, ["train.r.000", "train.r.001"], ["train.r.000.png", "train.r.001.png"]),
    "copies": ("colmap", ["a.jpg", "b.HEIC"], ["images/a.png", "images/b.jpg"]),
    "a second suffix": ("colmap", ["a.jpg"], ["images/a.jpg.png"]),
    "a second suffix in the model": ("colmap", ["a.png.png"], ["images/a.png"]),
    "the folder in the name": ("colmap", ["images/a.jpg"], ["images/a.jpg"]),
    "next to the JSON": (JSON, ["images/a.jpg"], ["a.jpg"]),
    "input": ("colmap", ["a.jpg"], ["input/a.jpg"]),
    "deep": ("colmap", ["a.jpg"], ["data/color/full/a.jpg"]),
    "escapes": (JSON, ["images/my%20photo.jpg"], ["images/my photo.jpg"]),
    "a space at the end": (JSON, ["images/a.jpg "], ["images/a.jpg"]),
    "composed letters": (JSON, [f"images/{NFC}"], [f"images/{NFD}"]),
    "decomposed letters": ("colmap", [NFD], [f"images/{NFC}"]),
    "a longer end decides": (JSON, ["/x/cam1/1.jpg", "/x/cam2/1.jpg"], ["images/cam1/1.png", "images/cam2/1.png"]),
    "the case decides": ("colmap", ["a.JPG"], ["images/a.jpg", "images/A.jpg"]),
    "other images": (JSON, ["rgb/a.jpg"], ["images/a.jpg", "masks/a.jpg", "depth/a.png", "renders/a.jpg"]),
    "the suffix decides": ("colmap", ["a.jpg"], ["images/a.JPG", "images/a.png"]),
    "the folder of a split": (JSON, ["r_0"], ["train/r_0.jpg"]),
    "full size first": (JSON, ["rgb/a.jpg"], ["input/a.jpg", "images_2/a.jpg"]),
}


@pytest.mark.parametrize("case", MATCHES)
def test_moved_photographs_are_matched_by_path(tmp_path: Path, caplog: pytest.LogCaptureFixture, case: str) -> None:
    kind, names, files = MATCHES[case]
    scene = made(tmp_path / "scene", kind, names, files)
    with caplog.at_level(logging.INFO, "clsplat"):
        views = located(scene)
    assert list(views.values()) == files[: len(names)]
    assert all(Path(file).name.startswith(Path(name).name) for name, file in views.items())
    lines = [line for line in caplog.messages if "matched" in line]
    assert len(lines) == 1
    assert f"{len(names)} of {len(names)} photo" in lines[0]
    assert files[0] in lines[0]
    notes = [finding.text for finding in Inspection.from_folder(scene).findings if finding.level == "note"]
    assert lines[0].removeprefix(f"{scene}: ") in notes


REFUSALS = {  # the kind of dataset, its names, the files on disk, and what is said
    "two fit": ("colmap", ["a.tif"], ["images/a.jpg", "images/a.png"], "images/a.jpg, images/a.png match 'a.tif'"),
    "only case differs": ("colmap", ["Aa.jpg"], ["images/aA.jpg", "images/aa.jpg"], "match 'Aa.jpg' equally well"),
    "two folders": (JSON, ["rgb/a.jpg"], ["x/a.jpg", "y/a.jpg"], "x/a.jpg, y/a.jpg match 'rgb/a.jpg' equally well"),
    "two names": (JSON, ["l/a.jpg", "r/a.jpg"], ["images/a.jpg"], "2 of 2 image files are missing"),
    "another camera": ("colmap", ["l/a.jpg", "r/a.jpg"], ["images/l/a.jpg", "x/a.jpg"], "1 of 2 image files are miss"),
    "a mask": (JSON, ["images/a.jpg"], ["masks/a.jpg"], "1 of 1 image files are missing"),
    "a letter less": (JSON, ["images/IMG_01.jpg"], ["images/IMG_1.jpg"], "nearest file is images/IMG_1.jpg, searched"),
    "another split": (BLENDER, ["./test/r_0"], ["val/r_0.png"], "1 of 1 image files are missing"),
    "nothing": (JSON, ["images/a.jpg"], [], "contains no images"),
    "outside": (JSON, ["../other/a.jpg"], ["../other/a.jpg"], "'../other/a.jpg' is not a path below"),
    "an absolute path": ("colmap", ["/x/a.jpg"], ["images/b.jpg"], "/x/a.jpg' is not a path below"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_ambiguous_or_missing_photographs_are_refused(tmp_path: Path, case: str) -> None:
    kind, names, files, text = REFUSALS[case]
    scene = made(tmp_path / "scene", kind, names, files)
    assert text in refusal(read_scene, scene)
    inspection = Inspection.from_folder(scene)
    (error,) = [finding.text for finding in inspection.findings if finding.level == "error"]
    assert "registered images are missing on disk" in error
    assert "skip" in error or len(names) == 1 or "2 of 2" in error
    assert not inspection.is_trainable


def test_links_out_of_the_scene_are_not_followed(tmp_path: Path) -> None:
    scene = made(tmp_path / "scene", "colmap", ["a.jpg"], ["../outside/a.JPG", "images/b.jpg"])
    (scene / "images" / "a.JPG").symlink_to(tmp_path / "outside" / "a.JPG")
    (scene / "linked").symlink_to(tmp_path / "outside")
    assert "1 of 1 image files are missing" in refusal(read_scene, scene)
    (scene / "images" / "a.JPG").unlink()
    (scene / "images" / "a.JPG").symlink_to("b.jpg")  # inside
    assert located(scene) == {"a.JPG": "images/a.JPG"}


def test_results_of_runs_are_no_photographs(tmp_path: Path) -> None:
    scene = made(tmp_path, JSON, ["images/a.jpg"], ["out/images/a.png"])
    (scene / "out" / "status.json").touch()
    assert "are missing" in refusal(read_scene, scene)


@pytest.mark.parametrize("kind", ["colmap", JSON])
def test_cameras_are_scaled_to_reduced_photographs(tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: str) -> None:
    scene = made(tmp_path, kind, ["a.jpg", "b.jpg"], ["images_4/a.jpg", "images_4/b.jpg"], (16, 12))
    made(tmp_path, kind, ["a.jpg", "b.jpg"], ["images_2/a.jpg", "images_2/b.jpg"], (32, 24))
    with caplog.at_level(logging.INFO, "clsplat"):
        view, _ = read_scene(scene, 0).views
    assert view.image_path == scene / "images_2" / "a.jpg"
    assert (view.camera.width, view.camera.height, view.camera.fx) == (32, 24, 25.0)
    assert load_image(view).shape == (24, 32, 3)
    assert "2 of 2 photos matched" in caplog.text
    assert "cameras scaled to these smaller photos" in caplog.text


@pytest.mark.parametrize("place", ["sparse/0", "sparse"])
def test_photographs_of_a_model_folder_are_next_to_it(tmp_path: Path, place: str) -> None:
    scene = made(tmp_path, "colmap", ["C:\\x\\a.jpg"], ["photos/a.jpg"])
    assert read_scene(scene / place, 0).views[0].image_path == scene / "photos" / "a.jpg"


def test_splits_name_photographs_as_frames_do(tmp_path: Path) -> None:
    scene = made(tmp_path, JSON, ["C:\\x\\images\\a.jpg", "C:\\x\\images\\b.jpg"], ["images/a.jpg", "images/b.jpg"])
    table = json.loads((scene / "transforms.json").read_text())
    names = {"train_filenames": ["C:/x/images/a.jpg"], "test_filenames": ["C:\\x\\images\\b.jpg"]}
    (scene / "transforms.json").write_text(json.dumps(table | names))
    assert [view.name for view in read_scene(scene).split("test")] == ["images/b.jpg"]


def test_photographs_of_two_files_are_searched_together(tmp_path: Path) -> None:
    """Those for testing are not taken from training where they are missing."""
    made(tmp_path, BLENDER, ["train/r_0"], ["train/r_0.png"])
    made(tmp_path, "transforms_test", ["test/r_0"], [])
    assert "1 of 2 image files are missing" in refusal(read_scene, tmp_path)


def test_masks_are_matched_by_name(tmp_path: Path) -> None:
    scene = made(tmp_path, "colmap", ["c\\a.jpg", "c\\b.jpg"], ["images/c/a.jpg", "images/c/b.jpg", "masks/c/A.PNG"])
    assert [view.mask_path for view in read_scene(scene).views] == [scene / "masks" / "c" / "A.PNG", None]
    scene = made(tmp_path / "json", JSON, ["images/a.jpg"], ["images/a.jpg"])
    table = json.loads((scene / "transforms.json").read_text())
    table["frames"][0]["mask_path"] = "/x/masks/a.png"
    (scene / "transforms.json").write_text(json.dumps(table))
    assert "'/x/masks/a.png' is not a path below" in refusal(read_scene, scene)
    (scene / "masks").mkdir()
    photograph(scene / "masks" / "a.PNG")
    assert read_scene(scene, 0).views[0].mask_path == scene / "masks" / "a.PNG"


# ---- models


@pytest.mark.parametrize(
    "place", ["colmap/sparse/0", "dense/0/sparse", "colmap_sparse/0", "colmap_text", "a/b/sparse/0", "output/model"]
)
def test_colmap_model_is_detected_in_known_folders(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, place: str
) -> None:
    for image in orbit().images:
        (tmp_path / "images").mkdir(exist_ok=True)
        photograph(tmp_path / "images" / image.name)
    assert not is_scene(tmp_path)
    write_model(tmp_path / place, orbit(), "txt" if "text" in place else "bin")
    with caplog.at_level(logging.INFO, "clsplat"):
        scene = read_scene(tmp_path)
    assert (len(scene.views), scene.path) == (24, tmp_path)
    assert len([line for line in caplog.messages if "the COLMAP dataset in" in line and "is used" in line]) == 1
    inspection = Inspection.from_folder(tmp_path)
    assert inspection.verdict == "ready to train"
    assert inspection.facts.kind == "COLMAP"
    assert not inspection.facts.unregistered


def test_largest_nested_model_of_equal_photographs_is_used(tmp_path: Path) -> None:
    small = replace(orbit(), images=orbit().images[:5])
    (tmp_path / "images").mkdir()
    for image in orbit().images:
        photograph(tmp_path / "images" / image.name)
    write_model(tmp_path / "colmap_a" / "0", small)
    write_model(tmp_path / "colmap_b", orbit(), "txt")
    write_model(tmp_path / "colmap_c" / "0", orbit())
    note = "the COLMAP dataset in colmap_b is used, out of 3 models of these photos"
    assert Inspection.from_folder(tmp_path).facts.notes == [note]
    write_model(tmp_path / "colmap_c" / "0", replace(small, images=[ImageEntry("other.png")]))
    message = refusal(read_scene, tmp_path)
    assert "has 3 datasets in its subfolders: colmap_a/0 (COLMAP), colmap_b (COLMAP), colmap_c/0 (COLMAP)" in message
    assert Inspection.from_folder(tmp_path).findings[0].text == message


def test_several_scenes_below_are_listed(tmp_path: Path) -> None:
    for name in ("fox", "horse"):
        made(tmp_path / name, "colmap", ["0.jpg", "1.jpg"], ["images/0.jpg", "images/1.jpg"])
    assert "fox (COLMAP), horse (COLMAP); use one of these" in refusal(read_scene, tmp_path)


def test_nested_transforms_file_is_read(tmp_path: Path) -> None:
    made(tmp_path / "nerf", JSON, ["images/a.jpg", "images/b.jpg"], ["../images/a.jpg", "../images/b.jpg"])
    assert located(tmp_path) == {"images/a.jpg": "images/a.jpg", "images/b.jpg": "images/b.jpg"}


def test_missing_photographs_without_sizes_give_one_error(tmp_path: Path) -> None:
    scene = made(tmp_path, JSON, [f"images/{i}.png" for i in range(100)], [])
    table = json.loads((scene / "transforms.json").read_text())
    (scene / "transforms.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": table["frames"]}))
    errors = [finding.text for finding in Inspection.from_folder(scene).findings if finding.level == "error"]
    assert len(errors) == 1
    assert "100 of 100 registered images are missing on disk" in errors[0]


def test_photographs_of_several_sizes_need_no_sizes(tmp_path: Path) -> None:
    scene = made(tmp_path, JSON, ["a.jpg", "b.jpg"], ["a.jpg"], (64, 48))
    photograph(scene / "b.jpg", (48, 64))
    table = json.loads((scene / "transforms.json").read_text())
    (scene / "transforms.json").write_text(json.dumps({"fl_x": 50, "frames": table["frames"]}))
    assert [(view.camera.width, view.camera.height) for view in read_scene(scene).views] == [(64, 48), (48, 64)]
    assert Inspection.from_folder(scene).is_trainable


def test_only_photograph_is_trained_on_without_holdout(tmp_path: Path) -> None:
    scene = made(tmp_path, JSON, ["a.jpg"], ["a.jpg"])
    assert "the only image is held out for testing; set scene.holdout=0 to train on it" in refusal(read_scene, scene)
    assert len(read_scene(scene, 0).train) == 1


def test_parent_folder_with_cameras_is_named(tmp_path: Path) -> None:
    scene = made(tmp_path, "colmap", ["a.jpg"], ["images/a.jpg"])
    assert f"the cameras are in {scene}: use that folder" in refusal(read_scene, scene / "images")


def test_depth_maps_are_matched_by_name(tmp_path: Path) -> None:
    photograph(made(tmp_path, JSON, [], []) / "A.PNG")
    (tmp_path / "x").mkdir()
    photograph(tmp_path / "x" / "b.tif")
    maps = DepthMaps(tmp_path)
    maps.require(["images/a.jpg", "x/b.jpg"])
    assert maps.read("x/b.jpg", 64, 48).shape == (48, 64)
    assert "the depth map of c.jpg is missing" in refusal(maps.require, ["c.jpg"])
