"""Damaged PLY files: models and points."""

import itertools
import warnings
from pathlib import Path

import numpy as np

from clsplat.formats.ply import write_ply
from clsplat.formats.splats import PARAMETERS
from clsplat.formats.table import detect
from clsplat.gaussians.model import load
from clsplat.scene.points import read_points_ply, write_points_ply
from clsplat.scene.scene import PointCloud
from tests.fuzz.mutation import damaged, fuzzed
from tests.fuzz.outcome import outcome
from tests.support.models import as_text

RNG = np.random.default_rng(0)
WORDS = [
    "element vertex 5\n",
    "element face 1\nproperty list uchar int v\n",
    "property list uchar int x\n",
    "element\n",
]
WORDS += ["property float f_rest_0\n", "property double y\n", "format ascii 1.0", "binary_big_endian", "end_header\n"]
WORDS += ['comment clsplat {"near": 1e999}\n', "comment SplatRenderMode: mip\n", "obj_info\n", "property uchar red\n"]


def splats(folder: Path) -> list[bytes]:
    """Models of each degree, with and without a world filter."""
    files = []
    for degree, filtered in itertools.product(range(4), (False, True)):
        widths = (3, 4, 3, 1, 3, 3 * ((degree + 1) ** 2 - 1))
        tables = {
            name: RNG.normal(size=(3, width)).astype("f4") for name, width in zip(PARAMETERS, widths, strict=True)
        }
        more = {"filter_variance": np.ones((3, 1), np.float32)} if filtered else {}
        write_ply(folder / "seed.ply", tables | more, {"near": 0.2, "compensate": 1.0, "background": "white"})
        files.append((folder / "seed.ply").read_bytes())
    return [*files, as_text(files[0]), as_text(files[4]).replace(b"\n", b"\r\n")]


def clouds(folder: Path) -> list[bytes]:
    """Points, binary and as text, with lists after them."""
    write_points_ply(folder / "seed.ply", PointCloud(RNG.normal(size=(4, 3)).astype("f4"), RNG.random((4, 3), "f4")))
    binary = (folder / "seed.ply").read_bytes()
    rows = "\n".join("0.5 1.5 -2e-3 255 0 17" for _ in range(4))
    properties = "".join(
        f"property {'float' if n in 'xyz' else 'uchar'} {n}\n" for n in [*"xyz", "red", "green", "blue"]
    )
    head = f"ply\nformat ascii 1.0\ncomment a\nelement camera 1\nproperty float f\nelement vertex 4\n{properties}"
    text = f"{head}element face 1\nproperty list uchar int v\nend_header\n7\n{rows}\n3 0 1 2\n"
    return [binary, text.encode(), text.replace("\n", "\r\n").encode()]


def test_damaged_model_is_read_or_refused(folder):
    @fuzzed(data=damaged(splats(folder), WORDS))
    def reads(data):
        (folder / "model.ply").write_bytes(data)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            model = outcome(load, folder / "model.ply")
            outcome(detect, folder / "model.ply")
        if model is not None:
            assert all(np.isfinite(table).all() for table in model.tables().values())
            assert np.isfinite(
                [model.rendering.near, model.rendering.screen_variance, model.rendering.compensate]
            ).all()
            model.save(folder / "again.ply")
            assert len(load(folder / "again.ply")) == len(model)

    reads()


def test_damaged_points_are_read_or_refused(folder):
    @fuzzed(data=damaged(clouds(folder), WORDS))
    def reads(data):
        (folder / "points.ply").write_bytes(data)
        points = outcome(read_points_ply, folder / "points.ply")
        if points is not None:
            assert np.isfinite(points.positions).all()
            assert ((points.colors >= 0) & (points.colors <= 1)).all()

    reads()
