"""Panoramas train like pinhole photographs with as many pixels."""

from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.prepare.cache import place_photographs
from tests.support.panorama_scene import write_panoramas, write_pinholes, write_tests
from tests.support.runs import train

pytestmark = pytest.mark.slow
WIDTH = 192
SIDE = round((WIDTH * WIDTH / 12) ** 0.5)  # of six pinhole photographs with the pixels of a panorama


def quality(run: Path, tests: Path) -> float:
    """The mean PSNR of pinhole views from other places, dB."""
    renderer, scene = clsplat.Renderer(clsplat.load(run)), clsplat.read_scene(tests)
    return float(np.mean([clsplat.metrics.psnr(renderer.render(v).image, v.photograph()) for v in scene.views]))


def test_cameras_of_panoramas_are_found(tmp_path: Path) -> None:
    """The relative rotations are those of the scene; a pixel is 0.7 degrees, the worst error measured 0.8."""
    pytest.importorskip("pycolmap")
    write_panoramas(tmp_path / "known", 8, 512)
    place_photographs(tmp_path / "known" / "images", tmp_path / "found", camera_model="EQUIRECTANGULAR")
    known, actual = (clsplat.read_scene(tmp_path / name, holdout=0) for name in ("known", "found"))
    assert len(actual.views) == 6 * 8
    pairs = [
        [view.world_to_camera[:, :3] for view in scene.views if view.name.endswith("/cube_front.png")]
        for scene in (known, actual)
    ]
    for true, rotation in zip(*pairs, strict=True):
        turn = true @ pairs[0][0].T @ (rotation @ pairs[1][0].T).T
        assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 2


def test_panoramas_train_as_well_as_pinhole_photographs(tmp_path: Path) -> None:
    write_panoramas(tmp_path / "panoramas", 8, WIDTH)
    write_pinholes(tmp_path / "pinholes", 8, SIDE)
    write_tests(tmp_path / "tests", 6, 64)
    few = "optimize.steps=200", "scene.holdout=0", "densify.start=1000"
    psnr = {}
    for name in ("panoramas", "pinholes"):
        train(tmp_path / name, tmp_path / f"{name}_run", *few, pipeline="quickstart")
        psnr[name] = quality(tmp_path / f"{name}_run", tmp_path / "tests")
    assert psnr["panoramas"] > psnr["pinholes"] - 1, psnr
    assert psnr["panoramas"] > 20, psnr
