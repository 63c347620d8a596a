"""Write the surface of a model as a mesh, or as a closed hull for collision detection.

Median depths of the training views are fused into a truncated signed distance field (clsplat/render/fusion.py), from
which the surface is extracted, cleaned, and smoothed.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError, MemoryLimitError, shell_quote
from clsplat.core.machine import available_memory
from clsplat.core.progress import counted
from clsplat.formats.mesh import WRITERS, Mesh
from clsplat.gaussians.conversion import check_output
from clsplat.render.fusion import (
    MAX_PIXEL,
    MIN_VIEWS,
    POINT_BYTES,
    SIDE,
    Blocks,
    DepthImage,
    count_free,
    find_blocks,
    fuse,
)
from clsplat.runs.model_file import ModelFile, is_moving
from clsplat.scene.view import View
from clsplat.viewer.video.frames import Canvas
from clsplat.workflows.surface import extract, hull, reduce, remove_small_parts, smooth

LOG = logging.getLogger("clsplat")
VOXEL = 1.2  # in pixels at the median depth
TRUNCATION = 5.0  # voxels
OPAQUE, EMPTY = 0.9, 0.1  # the smallest alpha of pixels whose depth is used, and the largest alpha of empty pixels
NOTHING = 1e10  # depth of empty pixels, scene units
WINDOW, SIGMA, SIMILAR = 9, 2.5, 2.0  # bilateral filter: window side and sigma, px; sigma of the depths, voxels
PROBES = 16  # views whose depths determine the voxel
CELL, MAX_CELLS = 2.0, 1 << 23  # of a hull: side of a cell in voxels, and maximum number of cells
HULL_BYTES = 32  # per cell, on the device and the host


@dataclass(frozen=True)
class MeshOptions:
    """The options of a mesh."""

    voxel: float | None = None  # scene units; None: from the size of pixels
    keep: float = 1.0  # fraction of the faces
    collision: bool = False  # whether to write a closed hull of all space that the views do not show to be free

    def __post_init__(self) -> None:
        if self.voxel is not None and not 0 < self.voxel < math.inf:
            raise ConfigError(f"--voxel {self.voxel:g}: expected a length above 0, in scene units")
        if not 0 < self.keep <= 1:
            raise ConfigError(f"--keep {self.keep:g}: expected a fraction of the faces above 0, up to 1")
        if self.keep < 1 and find_spec("fast_simplification") is None:  # before minutes of work
            raise ConfigError("--keep needs fast-simplification; in a checkout, run `pip install '.[mesh]'`")


@dataclass(frozen=True)
class RenderedDepth(DepthImage):
    """The depths and colors of a view, and a mask of the pixels that show nothing."""

    is_empty: NDArray[np.bool_]  # [height, width]


def denoise(image: DepthImage, voxel: float) -> NDArray[np.float32]:
    """Return the depths after a bilateral filter (Tomasi & Manduchi 1998).  voxel: scene units.

    The filter quantizes depth differences to 1/4096 of the depth range.  To keep this range small, depths beyond the
    reach of `find_blocks` are left unchanged.
    """
    depth, reach = image.depth, np.float32(MAX_PIXEL * voxel * image.view.camera.fx)
    smooth = cv2.bilateralFilter(np.minimum(depth, reach), WINDOW, SIMILAR * voxel, SIGMA)
    return np.where((depth > 0) & (depth < reach), smooth, depth)


@dataclass(frozen=True)
class DepthSource:
    """Renders the depths and colors of views."""

    canvas: Canvas
    views: Sequence[View]

    def images(self, label: str, voxel: float, empty_depth: float = 0.0) -> Iterator[DepthImage]:
        """Yield the denoised depth images of all views.

        voxel: scene units; empty_depth: depth of pixels that show nothing, in scene units.
        """
        for view in counted(self.views, label, len(self.views)):
            image = self.render(view)
            depth = denoise(image, voxel)
            yield replace(image, depth=np.where(image.is_empty, np.float32(empty_depth), depth))

    def render(self, view: View) -> "RenderedDepth":
        """Return the colors of a view, and its median depths, which are 0 where the model is not opaque."""
        layers = self.canvas.render_layers(view, ("median_depth",))
        assert layers.median_depth is not None
        depth = np.where(layers.alpha >= OPAQUE, layers.median_depth, 0)
        return RenderedDepth(view, depth, np.clip(layers.image, 0, 1), layers.alpha < EMPTY)

    def pixel_size(self) -> float:
        """Return the median size of a pixel on the surface, in scene units, over some views; 0 if no view shows it."""
        sample = np.unique(np.linspace(0, len(self.views) - 1, min(PROBES, len(self.views))).round().astype(int))
        images = [self.render(self.views[i]) for i in sample]
        depths = [(image.depth[image.depth > 0], image.view.camera.fx) for image in images]
        sizes = [np.median(depth) / focal for depth, focal in depths if len(depth)]
        return float(np.median(sizes)) if sizes else 0.0


def write_mesh(
    model: Path,
    out: Path,
    scene: Path | None = None,
    options: MeshOptions | None = None,
    downscale: float | None = None,
    device: Any = None,
) -> dict[str, Any]:
    """Write the mesh of a model; return `file`, `bytes`, `vertices`, `faces`, `voxel`, and `closed`.

    The suffix of `out` selects the format, one of WRITERS.  Raises ConfigError, DataError, MemoryLimitError,
    OutputError.
    """
    options = options or MeshOptions()
    if (write := WRITERS.get(out.suffix.lower())) is None:
        raise ConfigError(f"{out}: expected a name that ends in {', '.join(WRITERS)}")
    check_output([model], out)
    photo_model = ModelFile(model, scene, device, downscale)
    if is_moving(photo_model.gaussians):
        command = f"`clsplat convert {shell_quote(model)} OUT.ply --time T`"
        raise DataError(f"{model}: the model is dynamic; first export it at one time with {command}")
    views = photo_model.scene.split("train") or photo_model.scene.views
    source = DepthSource(Canvas(photo_model.painter), views)
    pixel = source.pixel_size()
    if not pixel:
        raise DataError(f"{model}: no view shows an opaque surface; train the model longer, or check --scene")
    voxel = options.voxel or VOXEL * pixel
    blocks = find_blocks(source.images("views searched", voxel), voxel, TRUNCATION * voxel)
    if not len(blocks):
        raise _disagreement(model, voxel, VOXEL * pixel if options.voxel else None)
    if options.collision:
        mesh, voxel = _hull(source, blocks, voxel, options.voxel)
    else:
        mesh = _surface(source, blocks, voxel)
    if not len(mesh.faces):
        raise _disagreement(model, voxel, VOXEL * pixel if options.voxel else None)
    mesh = reduce(mesh, options.keep)
    write(out, mesh, np.asarray(photo_model.scene.origin, np.float64))
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    return {"file": str(out), "bytes": out.stat().st_size, **counts, "voxel": voxel, "closed": mesh.is_closed}


def _disagreement(model: Path, voxel: float, default: float | None) -> DataError:
    """Return the error for an empty mesh.  default: the voxel without --voxel, scene units; None if it was used."""
    advice = f"omit --voxel to use {default:.3g}" if default else "check --scene"
    return DataError(f"{model}: no two views agree on a surface with a voxel of {voxel:.3g} scene units; {advice}")


def _surface(source: DepthSource, blocks: Blocks, voxel: float) -> Mesh:
    """Return the surface that the views agree on."""
    _require_memory(len(blocks), POINT_BYTES, voxel)
    device = source.canvas.painter.workspace.device
    field = fuse(device, source.images("views fused", voxel), blocks, voxel, TRUNCATION * voxel)
    return smooth(remove_small_parts(extract(field)))


def _hull(source: DepthSource, blocks: Blocks, voxel: float, cell: float | None) -> tuple[Mesh, float]:
    """Return the closed hull of the space that fewer than two views show to be free, and its cell side, scene units.

    cell: side of the cells; None: CELL voxels, doubled until there are at most MAX_CELLS.
    """
    step = cell or CELL * voxel
    first, shape = _box(blocks, voxel / step)
    while cell is None and np.prod(shape) * SIDE**3 > MAX_CELLS:
        step *= 2
        first, shape = _box(blocks, voxel / step)
    _require_memory(int(np.prod(shape)), HULL_BYTES, step)
    box = (np.indices(shape.tolist()).reshape(3, -1).T + first).astype(np.int32)
    device = source.canvas.painter.workspace.device
    views = count_free(device, source.images("views carved", voxel, NOTHING), box, step)
    is_free = views.reshape(*shape, SIDE, SIDE, SIDE).transpose(0, 3, 1, 4, 2, 5).reshape(shape * SIDE) >= MIN_VIEWS
    return remove_small_parts(hull(is_free, first * SIDE, step)), step


def _box(blocks: Blocks, ratio: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first block and the shape, [3] each, of the smallest box on another grid that contains these blocks.

    ratio: the step of the grid of these blocks divided by that of the other grid.
    """
    first = np.floor(blocks.min(axis=0) * ratio).astype(np.int64)
    return first, np.ceil((blocks.max(axis=0) + 1) * ratio).astype(np.int64) - first


def _require_memory(blocks: int, point_bytes: int, voxel: float) -> None:
    """Log the memory that blocks need.  Raises MemoryLimitError if it exceeds the free memory."""
    size, free = blocks * SIDE**3 * point_bytes, available_memory()
    LOG.info("voxel %.4g scene units, %s blocks of %d³ voxels, %.0f MB", voxel, f"{blocks:,}", SIDE, size / 1e6)
    if free is not None and size > free:
        raise MemoryLimitError(
            f"--voxel {voxel:.3g}: needs {size / 2**30:.1f} GiB of memory, but only {free / 2**30:.1f} GiB is free; "
            f"use a larger voxel, such as {2 * voxel:.2g}, or a larger --scale"
        )
