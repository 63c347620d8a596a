"""Photographs at several scales: the dataset on disk, scaling on the fly, and the order of views."""

import json
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.core.settings import variants
from clsplat.photos.sampling import Order, ViewPool
from clsplat.scene.camera import Camera
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import make_scene
from clsplat.scene.view import View, load_image
from tests.support.multiscale_scene import pyramid, write_multiscale
from tests.support.refusals import refusal


@pytest.fixture(scope="module")
def folders(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    out = tmp_path_factory.mktemp("multiscale") / "tiny"
    assert write_multiscale(tiny_scene, out, levels=4) == 40
    return tiny_scene, out


def test_levels_are_box_means_without_alpha(rng):
    """Not premultiplied: colors count in full where alpha is zero; truncated, not rounded."""
    pixels = rng.integers(0, 256, (16, 24, 4), dtype=np.uint8)
    levels = pyramid(pixels, 4)
    for j, level in enumerate(levels):
        size = 2**j
        means = pixels.astype(np.float64).reshape(16 // size, size, 24 // size, size, 4).mean(axis=(1, 3))
        np.testing.assert_array_equal(level, np.floor(means))


def test_metadata_follows_the_layout_of_mip_nerf(folders):
    source, out = folders
    metadata = json.loads((out / "metadata.json").read_text())
    assert set(metadata) == {"train", "test"}
    train = metadata["train"]
    assert train["file_path"][:5] == [f"images_train/000_d{j}.png" for j in range(4)] + ["images_train/001_d0.png"]
    assert train["label"][:5] == [0, 1, 2, 3, 0]
    assert train["lossmult"][:4] == [1, 4, 16, 64]
    assert train["width"][:4] == train["height"][:4] == [40, 20, 10, 5]
    assert set(train["near"]) == {2}
    assert set(train["far"]) == {6}
    full = read_scene(source).views[0].camera.fx
    np.testing.assert_allclose(train["focal"][:4], [full, full / 2, full / 4, full / 8])
    np.testing.assert_allclose(train["pix2cam"][1], [[2 / full, 0, -20 / full], [0, -2 / full, 20 / full], [0, 0, -1]])
    poses = [
        frame["transform_matrix"] for frame in json.loads((source / "transforms_train.json").read_text())["frames"]
    ]
    assert train["cam2world"][::4] == poses
    for j in range(4):
        assert cv2.imread(str(out / "images_train" / f"003_d{j}.png"), cv2.IMREAD_UNCHANGED).shape[:2] == (40 >> j,) * 2


def test_dataset_is_read_back(folders):
    """The full scale is the single-scale dataset, bit for bit; the others are what scaling on the way gives."""
    single, multi = (read_scene(folder) for folder in folders)
    assert multi.downscales == (1, 2, 4, 8)
    assert (len(multi.train), len(multi.test)) == (32, 8)
    assert multi.background == "white"
    assert multi.extent == pytest.approx(single.extent)
    white = (1.0, 1.0, 1.0)
    for scale in (1, 2, 4, 8):
        for split in ("train", "test"):
            on_disk, on_the_way = multi.downscaled(scale).split(split), single.downscaled(scale).split(split)
            assert len(on_disk) == len(on_the_way)
            for one, other in zip(on_disk, on_the_way, strict=True):
                assert one.downscale == other.downscale == scale
                np.testing.assert_allclose(one.world_to_camera, other.world_to_camera)
                cameras = [list(vars(view.camera).values()) for view in (one, other)]
                np.testing.assert_allclose(*cameras)
                images = load_image(one, white), load_image(other, white)
                difference = np.abs(images[0].astype(int) - images[1])
                assert difference.max() <= (0 if scale == 1 else 2)  # truncated twice


def test_damaged_metadata_is_refused(folders, tmp_path):
    text = (folders[1] / "metadata.json").read_text()
    metadata = json.loads(text)
    short = {**metadata, "train": {**metadata["train"], "focal": metadata["train"]["focal"][:-1]}}
    label = {**metadata, "test": {**metadata["test"], "label": [0.5] * 8}}
    for content, words in (
        (text[:-20], "not a JSON file"),
        ("[]", "'train' needs lists of equal length named file_path"),
        (json.dumps({"train": metadata["train"]}), "'test' needs lists"),
        (json.dumps(short), "'train' needs lists"),
        (json.dumps(label), r"test\[0\]: label is 0.5"),
        (text, "image files are missing"),
    ):
        (tmp_path / "metadata.json").write_text(content)
        message = refusal(read_scene, tmp_path)
        assert str(tmp_path) in message
        with pytest.raises(DataError, match=words):
            read_scene(tmp_path)


def test_images_that_cannot_be_halved_are_refused(tiny_scene, tmp_path):
    with pytest.raises(DataError, match="40x40 pixels of uint8; expected 8 bits and a size that can be halved 4 times"):
        write_multiscale(tiny_scene, tmp_path, levels=5)
    with pytest.raises(DataError, match=r"no transforms_train\.json"):
        write_multiscale(tmp_path / "images_train", tmp_path, levels=2)


def test_scales_match_the_images(tiny_scene):
    """However a scene was scaled before, a factor divides the size of the photograph."""
    scene = read_scene(tiny_scene)
    assert scene.downscaled(1) is scene
    assert scene.downscaled(4).views[0].camera.width == 10
    several = scene.downscaled(2, 4, 8)
    assert several.downscales == (2, 4, 8)
    assert len(several.train) == 3 * len(scene.train)
    assert [view.camera.width for view in several.downscaled(8).views] == [5] * len(scene.views)
    assert several.downscaled(8).views[0].camera.fx == pytest.approx(scene.views[0].camera.fx / 8)
    assert several.extent == scene.extent
    with pytest.raises(DataError, match="already downscaled by 2; expected a downscale of at least 2, got 1"):
        several.downscaled(1)


def views_of(count: int, *scales: float) -> list[View]:
    camera = Camera(80, 80, 50, 50, 40, 40)
    views = [View(f"{i}", camera, np.eye(4)[:3], Path("none")) for i in range(count)]
    return list(make_scene(Path("none"), views, set(), None).downscaled(*scales).views)


def draw_views(views: list[View], order: str, steps: int | list[int], seed: int = 0) -> list[View]:
    """The views of some steps, or of all from 1 to `steps`."""
    pool, chosen = ViewPool(views, seed), variants(Order)[order]()
    return [chosen.view_at(pool, step) for step in (range(1, steps + 1) if isinstance(steps, int) else steps)]


def scale_fractions(views: list[View], order: str, steps: int) -> dict[float, float]:
    result = Counter(view.downscale for view in draw_views(views, order, steps))
    return {scale: count / steps for scale, count in result.items()}


def test_order_decides_how_often_scales_are_sampled():
    views = views_of(10, 1, 2, 4, 8)
    assert scale_fractions(views, "uniform", 400) == {1: 0.25, 2: 0.25, 4: 0.25, 8: 0.25}
    assert scale_fractions(views, "shuffle", 500) == {1: 0.4, 2: 0.2, 4: 0.2, 8: 0.2}
    stack = scale_fractions(views, "stack", 20_000)
    assert stack[1] == pytest.approx(0.475, abs=0.015)
    for scale in (2, 4, 8):
        assert stack[scale] == pytest.approx(0.175, abs=0.015)


@pytest.mark.parametrize("order", ["uniform", "shuffle", "stack"])
def test_order_depends_only_on_seed_and_step(order):
    views = views_of(7, 1, 2)
    straight = draw_views(views, order, 60, seed=3)
    assert draw_views(views, order, [50, 3, 21], seed=3) == [straight[step - 1] for step in (50, 3, 21)]
    assert draw_views(views, order, 60, seed=4) != straight


def test_every_view_is_sampled_before_any_repeats():
    views = views_of(7, 1, 2)
    result = draw_views(views, "uniform", 28)
    for epoch in (result[:14], result[14:]):
        assert len({(view.name, view.downscale) for view in epoch}) == 14
