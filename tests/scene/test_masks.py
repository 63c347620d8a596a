"""Masks, alpha as a mask, and rotated or undistorted photographs: which pixels count."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.metrics.images import psnr
from clsplat.metrics.perceptual import ssim_map
from clsplat.scene.camera import Camera, Lens
from clsplat.scene.detect import read_scene
from clsplat.scene.photographs import load_photograph
from clsplat.scene.view import View, load_image, load_mask
from tests.support.data_sets import data_set
from tests.support.pictures import masked_scene, store, with_orientation
from tests.support.refusals import refusal
from tests.support.runs import digest, train

pytestmark = pytest.mark.slow

BLACK = (0.0, 0.0, 0.0)


def make_view(path: Path, width: int, height: int, **more: object) -> View:
    return View("v.png", Camera(width, height, 50, 50, width / 2, height / 2), np.eye(3, 4), path, **more)


# ---- which pixels count


def test_white_pixels_count(tmp_path, rng):
    photo = store(tmp_path / "a.png", np.full((4, 6, 3), 90, np.uint8))
    white = rng.random((4, 6)) < 0.5
    mask = store(tmp_path / "m.png", np.where(white, 255, 0).astype(np.uint8))
    np.testing.assert_array_equal(load_mask(make_view(photo, 6, 4, mask_path=mask)), white)
    assert load_mask(make_view(photo, 6, 4)) is None


def test_only_fully_unmasked_pixels_count(tmp_path):
    photo = store(tmp_path / "a.png", np.full((4, 8, 3), 90, np.uint8))
    white = np.full((4, 8), 255, np.uint8)
    white[0, 0] = 0
    view = make_view(photo, 4, 2, mask_path=store(tmp_path / "m.png", white))
    expected = np.ones((2, 4), bool)
    expected[0, 0] = False
    np.testing.assert_array_equal(load_mask(view), expected)


def test_alpha_is_a_mask_only_if_requested(tmp_path):
    pixels = np.full((3, 4, 4), 200, np.uint8)
    pixels[:, :, 3] = [0, 128, 254, 255]
    view = make_view(store(tmp_path / "a.png", pixels), 4, 3)
    assert load_mask(view) is None
    np.testing.assert_array_equal(load_mask(replace(view, alpha="mask")), [[False, False, True, True]] * 3)


def test_mask_of_another_size_is_refused(tmp_path):
    photo = store(tmp_path / "a.png", np.zeros((4, 6, 3), np.uint8))
    view = make_view(photo, 6, 4, mask_path=store(tmp_path / "m.png", np.zeros((4, 5), np.uint8)))
    assert "m.png: the image is 5x4 pixels, its camera 6x4" in refusal(load_mask, view)


@pytest.mark.parametrize("name", ["IMG_01.png", "IMG_01.jpg.png"])
def test_colmap_scene_with_a_mask_folder(tmp_path, name):
    source = data_set("brighton")
    shutil.copytree(source / "sparse", tmp_path / "sparse")
    (tmp_path / "images").symlink_to(source / "images")
    views = read_scene(tmp_path).views
    assert all(view.mask_path is None for view in views)
    first = views[0]
    file = name.replace("IMG_01", Path(first.name).stem).replace(".jpg", Path(first.name).suffix)
    mask = store(tmp_path / "masks" / file, np.zeros((first.camera.height, first.camera.width), np.uint8))
    masked = [view for view in read_scene(tmp_path).views if view.mask_path is not None]
    assert [(view.name, view.mask_path) for view in masked] == [(first.name, mask)]
    assert not load_mask(masked[0]).any()


# ---- they alone train, and are measured


def test_masked_pixels_do_not_change_the_model(tiny_scene, tmp_path):
    """Neither of the model nor of the figures, whatever the photographs hold there."""
    figures, digests = [], []
    for filling in (0, 77):
        scene = masked_scene(tiny_scene, tmp_path / f"scene{filling}", filling)
        out = tmp_path / f"run{filling}"
        train(scene, out, "scene.alpha=mask")
        digests.append(digest(out))
        figures.append(json.loads((out / "metrics.json").read_text())["test"])
    assert digests[0] == digests[1]
    assert figures[0] == figures[1]
    train(masked_scene(tiny_scene, tmp_path / "open", 77), tmp_path / "unmasked")
    assert digest(tmp_path / "unmasked") != digests[0]


def test_metrics_average_over_counted_pixels(rng):
    image, photograph = (rng.integers(0, 256, (30, 40, 3)).astype(np.uint8) for _ in range(2))
    mask = rng.random((30, 40)) < 0.7
    error = ((image.astype(float) - photograph)[mask] ** 2).mean() / 255**2
    assert psnr(image, photograph, mask) == pytest.approx(-10 * np.log10(error))
    expected = ref.ssim_map(image.transpose(2, 0, 1) / 255, photograph.transpose(2, 0, 1) / 255)
    np.testing.assert_allclose(ssim_map(image, photograph).transpose(2, 0, 1), expected, atol=1e-12)


# ---- turned photographs


def test_masks_of_rotated_images(tmp_path):
    """A camera of the turned photograph gets it turned, one of the stored photograph as stored."""
    pixels = np.zeros((8, 16, 3), np.uint8)
    pixels[:, :8] = 255
    path = with_orientation(tmp_path / "a.jpg", pixels, 6)  # to be turned clockwise
    stored, turned = load_image(make_view(path, 16, 8)), load_image(make_view(path, 8, 16))
    assert stored[:, :4].min() > 200
    assert stored[:, -4:].max() < 50
    assert turned[:4].min() > 200
    assert turned[-4:].max() < 50
    assert load_image(make_view(path, 4, 8)).shape == (8, 4, 3)
    assert "16x8" in refusal(load_image, make_view(path, 9, 16))


# ---- undistorted photographs


def distorted_view(tmp_path: Path, rng: np.random.Generator) -> View:
    lens = Lens(60, 40, "SIMPLE_RADIAL", (50.0, 30.0, 20.0, -0.1))
    photo = store(tmp_path / "a.png", rng.integers(0, 256, (40, 60, 3)).astype(np.uint8))
    return View("b/a.png", lens.pinhole, np.eye(3, 4), photo, lens=lens)


def test_undistorted_once(tmp_path, rng, monkeypatch):
    view, folder = distorted_view(tmp_path, rng), tmp_path / "undistorted"
    first = load_photograph(view, BLACK, folder)
    np.testing.assert_array_equal(first, load_photograph(view, BLACK))
    monkeypatch.setattr(Lens, "undistort_image", None)
    np.testing.assert_array_equal(load_photograph(view, BLACK, folder), first)


def test_undistorted_for_each_background_of_transparent_pixels(tmp_path, rng):
    view, folder = distorted_view(tmp_path, rng), tmp_path / "undistorted"
    store(view.image_path, np.zeros((40, 60, 4), np.uint8))
    assert load_photograph(view, BLACK, folder).max() == 0
    assert load_photograph(view, (1.0, 1.0, 1.0), folder).min() == 255


def test_undistorted_again_when_the_photograph_changes(tmp_path, rng):
    view, folder = distorted_view(tmp_path, rng), tmp_path / "undistorted"
    first = load_photograph(view, BLACK, folder)
    store(view.image_path, np.zeros((40, 60, 3), np.uint8))
    assert load_photograph(view, BLACK, folder).max() == 0 < first.max()


def test_undistorted_masks(tmp_path, rng):
    view = distorted_view(tmp_path, rng)
    white = np.full((40, 60), 255, np.uint8)
    white[:, :30] = 0
    view = replace(view, mask_path=store(tmp_path / "m.png", white))
    for _ in range(2):  # the second time from the folder
        mask = load_photograph(view, BLACK, tmp_path / "undistorted")[:, :, 3]
        assert mask.shape == (view.camera.height, view.camera.width)
        edge = round(view.camera.cx)
        assert mask[:, : edge - 2].max() == 0
        assert mask[:, edge + 2 :].min() == 1
