"""Masks in a user's folder: `scene.masks`."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import ConfigError, DataError
from clsplat.pipeline.file import SceneSettings
from clsplat.pipeline.loading import load
from clsplat.runs.model_file import ModelFile
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Scene
from clsplat.scene.view import load_mask
from clsplat.sweeps.cell import Scenes
from tests.support.colmap_writer import tiny_model
from tests.support.commands import clsplat as command
from tests.support.orbit_scene import write
from tests.support.pictures import masked_scene, store
from tests.support.refusals import refusal
from tests.support.runs import digest, train
from tests.support.transforms_scene import several_cameras

pytestmark = pytest.mark.slow


def masks_of(scene: Path | Scene, out: Path, suffix: bool = False, value: int = 255) -> Path:
    """A mask for each photograph, black in a square."""
    views = scene.views if isinstance(scene, Scene) else read_scene(scene).views
    for view in views:
        pixels = np.full((view.camera.height, view.camera.width), value, np.uint8)
        pixels[5:20, 8:30] = 0
        store(out / f"{view.name}.png" if suffix else (out / view.name).with_suffix(".png"), pixels)
    return out


def applied(scene: Path, masks: Path) -> Scene:
    return SceneSettings(path=str(scene), masks=str(masks)).read(scene)[0]


# ---- they are found by name


@pytest.mark.parametrize("suffix", [True, False])
def test_masks_of_every_kind_of_dataset(tiny_scene, tmp_path, suffix):
    nerfstudio = shutil.copytree(tiny_scene, tmp_path / "nerfstudio")
    shutil.move(nerfstudio / "transforms_train.json", nerfstudio / "transforms.json")
    (nerfstudio / "transforms_test.json").unlink()
    scenes = {"blender": tiny_scene, "nerfstudio": nerfstudio, "colmap": write(tmp_path / "colmap", tiny_model())}
    for name, scene in scenes.items():
        masks = masks_of(scene, tmp_path / f"masks of {name}", suffix)
        views = applied(scene, masks).views
        assert all(view.mask_path is not None and view.mask_path.is_relative_to(masks) for view in views)
        assert not load_mask(views[0])[5:20, 8:30].any()
        assert load_mask(views[0])[:5].all()


def test_masks_of_frames_are_in_camera_folders(tmp_path):
    scene = several_cameras(tmp_path / "scene", {"a": 3, "b": 3})
    masks = masks_of(scene, tmp_path / "masks")
    views = applied(scene, masks).views
    assert {view.mask_path for view in views} == set(masks.glob("*/*.png"))
    assert len({view.mask_path for view in views}) == 6


def test_masks_do_not_replace_those_of_the_dataset(tmp_path):
    """Which may say what no photograph shows, as those of undistortion do."""
    scene = write(tmp_path / "scene", tiny_model())
    masks_of(scene, scene / "masks")
    message = refusal(applied, scene, masks_of(scene, tmp_path / "elsewhere"))
    assert message.startswith(f"{scene}: the dataset already has masks, such as {scene / 'masks'}")
    assert "remove scene.masks" in message


def test_mask_folder_does_not_depend_on_the_working_folder(tiny_scene, tmp_path, monkeypatch):
    masks_of(tiny_scene, tmp_path / "masks")
    monkeypatch.chdir(tmp_path)
    settings = SceneSettings(path=str(tiny_scene), masks="masks")
    monkeypatch.chdir("/")
    assert settings.read(tiny_scene)[0].views[0].mask_path.is_relative_to(tmp_path / "masks")


def test_masks_are_refused_for_photos_to_be_undistorted(tmp_path):
    pipeline = load("photos", [f"scene.path='{tmp_path}'", f"scene.masks='{tmp_path}'"])
    with pytest.raises(ConfigError, match=r"scene\.masks: the masks must fit the undistorted photos"):
        pipeline.preparation(tmp_path / "run")


def test_image_without_a_mask_counts_fully_and_is_named(tiny_scene, tmp_path, caplog):
    masks = masks_of(tiny_scene, tmp_path / "masks")
    first = read_scene(tiny_scene).views[0].name
    (masks / first).with_suffix(".png").unlink()
    assert load_mask(applied(tiny_scene, masks).views[0]) is None
    assert (
        f"{masks}: contains masks for 9 of 10 photos; all pixels of the other photos, such as {first}, are used"
        in caplog.text
    )


def test_folder_without_matching_masks_is_refused(tiny_scene, tmp_path):
    first = read_scene(tiny_scene).views[0].name
    message = refusal(applied, tiny_scene, tmp_path / "nowhere")
    assert message.startswith(f"{tmp_path / 'nowhere'}: no such folder; expected ")
    store(tmp_path / "others" / "x.png", np.zeros((40, 40), np.uint8))
    message = refusal(applied, tiny_scene, tmp_path / "others")
    assert f"contains no mask for the photos of {tiny_scene}; expected " in message
    assert str((tmp_path / "others" / first).with_suffix(".png")) in message
    assert "set scene.masks to another folder" in message


def test_mask_of_another_size_is_refused_before_the_first_step(tiny_scene, tmp_path):
    masks = masks_of(tiny_scene, tmp_path / "masks")
    file = next(masks.rglob("*.png"))
    cv2.imwrite(str(file), np.full((30, 40), 255, np.uint8))
    with pytest.raises(DataError, match="the image is 40x30 pixels, its camera 40x40") as error:
        train(tiny_scene, tmp_path / "run", f"scene.masks='{masks}'")
    assert f"1 of 20 image files cannot be used: {file}" in str(error.value)


# ---- they alone train, and are measured


def test_excluded_pixels_do_not_change_the_model(tiny_scene, tmp_path):
    masks = masks_of(tiny_scene, tmp_path / "masks")
    digests, figures = [], []
    for filling in (0, 77):
        scene = masked_scene(tiny_scene, tmp_path / f"scene{filling}", filling)
        for file in scene.rglob("*.png"):  # without their alpha
            cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[:, :, :3])
        out = tmp_path / f"run{filling}"
        train(scene, out, "optimize.steps=12", f"scene.masks='{masks}'")
        digests.append(digest(out))
        figures.append(json.loads((out / "metrics.json").read_text())["test"])
        views = ModelFile(out).scene.views
        assert all(view.mask_path is not None for view in views)
    assert digests[0] == digests[1]
    assert figures[0] == figures[1]


def test_run_does_not_resume_with_other_masks(tiny_scene, tmp_path):
    masks = masks_of(tiny_scene, tmp_path / "masks")
    out, place = tmp_path / "run", f"scene.masks='{masks}'"
    train(tiny_scene, out, "optimize.steps=12", place)
    moved = shutil.copytree(masks, tmp_path / "moved")
    name = read_scene(tiny_scene).views[0].name
    store((masks / name).with_suffix(".png"), np.full((40, 40), 255, np.uint8))
    again = ["run", "smoke", "--scene", tiny_scene, "--out", out, "--resume", "--set", "optimize.steps=12", "--set"]
    output = command(*again, place, expect=2).stderr
    assert f"{tiny_scene}: differs from the inputs of the run: the mask of 1 view ({name}); restore them" in output
    command(*again, f"scene.masks='{moved}'")  # the same content elsewhere


def test_cell_identity_includes_masks(tiny_scene, tmp_path):
    masks = masks_of(tiny_scene, tmp_path / "masks")

    def known(*settings: str) -> str:
        pipeline = load("smoke", [f"scene.path='{tiny_scene}'", *settings])
        return Scenes(tmp_path / "hashes").facts(pipeline).digest

    first, place = known(f"scene.masks='{masks}'"), f"scene.masks='{masks}'"
    assert first != known()
    store((masks / read_scene(tiny_scene).views[0].name).with_suffix(".png"), np.full((40, 40), 255, np.uint8))
    assert known(place) != first
