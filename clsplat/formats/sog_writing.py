"""Write SOG, version 2 (layout: sog.py): the same model gives the same bytes."""

import io
import json
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Context
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.formats import webp
from clsplat.formats.output import written
from clsplat.formats.packing import morton_order, smallest_three
from clsplat.formats.palette import Clustering, HostClusters, codebook, different, nearest, palette
from clsplat.formats.sh_rounding import base_for, visible_form
from clsplat.formats.sh_tree import tree_palette
from clsplat.formats.sog import MAX_PALETTE, PER_ROW, ROTATED
from clsplat.formats.sog_files import META, with_images
from clsplat.formats.sog_steps import rounded, rounded_opacities, rounded_quats, weighed_means
from clsplat.formats.splats import (
    Parameters,
    Quality,
    SplatFile,
    Writing,
    opacities,
    require_moderate,
    require_some,
    unit,
)
from clsplat.formats.weights import log_weights

PALETTES = {"small": 1024, "balanced": 4096, "high": 16384}  # entries at most, of a palette for all
SHARES = {"small": 0.16, "balanced": 0.42, "high": 0.45}  # entries at most for a splat, of a palette for neighbours
MEDIAN_STEPS = {"small": 6.0, "balanced": 5.0, "high": 3.0}  # of its vectors, in 128ths
TURN_STEP, ALPHA_STEP = 4, 2  # levels of 255
SIZE_SHARE = 0.25  # of a Gaussian's size, for its position: of one of median weight
SCALE_STEP = 0.1  # of logarithms of standard deviations
COLOUR_STEP = 0.05  # of the coefficients of band 0; 1 changes a colour by 0.28
SMALLEST = 1024  # entries for so many splats, and twice as many for twice as many
DIGITS = 16  # of the SHA-256 of an image in a folder, in its name
EPOCH = (1980, 1, 1, 0, 0, 0)  # of files in the ZIP: the same model gives the same bytes


def write_sog(path: Path, splats: SplatFile, options: Writing) -> str:
    """Write a `.sog`, or where the name is meta.json the files of a folder.  Raises OutputError, DataError.

    The images of a folder have their content in their names, so that none of another model is replaced.
    """
    require_some(path, splats)
    require_moderate(path, splats, "SOG")
    ordered = splats.rows(morton_order(splats.parameters["means"]))
    return write_as_ordered(path, ordered, log_weights(ordered.parameters, ordered.has_sky), options)


def write_as_ordered(path: Path, splats: SplatFile, weights: NDArray[np.float64], options: Writing) -> str:
    """Write a SOG as `write_sog` does, whose splats stay in the order that they have.

    weights: their binary logarithms, [N], of weights.py: of the model that the splats may be a part of.
    """
    in_folder = path.name == META
    p, harmonics = _quantised(splats.parameters, weights, options)
    width = -(-int(np.ceil(np.sqrt(len(splats)))) // 4) * 4
    images: dict[str, bytes] = {}
    meta: dict[str, Any] = {"version": 2, "count": len(splats), "asset": {"generator": "clsplat"}}
    if splats.mode == "mip":
        meta |= {"model": "antialiased", "antialias": True}
    if splats.rendering:
        meta["extras"] = {"clsplat": splats.rendering}

    def image(name: str, *planes: NDArray[Any], across: int = width) -> str:
        pixels = np.full((len(planes[0]), 4), 255, np.uint8)
        pixels[:, : len(planes)] = np.stack(planes, axis=1)
        data = webp.encode(path, pixels, across)
        name += f"_{sha256(data).hexdigest()[:DIGITS]}" * in_folder + ".webp"
        images[name] = data
        return name

    meta["means"] = _means(p, image)
    largest, others = smallest_three(unit(p["quats"]))
    levels = np.clip(np.rint(255 * (others * 0.5**0.5 + 0.5)), 0, 255)
    meta["quats"] = {"files": [image("quats", *levels.T, ROTATED + largest)]}
    for name, table, more in (("scales", "log_scales", []), ("sh0", "sh_base", [_alpha(p)])):
        entries = codebook(p[table])
        planes = nearest(p[table], entries).T
        meta[name] = {"codebook": [_short(number) for number in entries], "files": [image(name, *planes, *more)]}
    if harmonics is not None:
        meta["shN"] = _write_harmonics(harmonics, splats.sh_degree, image)
    images[META] = json.dumps(meta, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
    return _write_beside(path, images) if in_folder else _write(path, _zipped(images))


def _write_beside(path: Path, images: dict[str, bytes]) -> str:
    """Write images and then their meta.json: until it is renamed, the model before is whole.  Images of no use go."""
    before, new = set(with_images(path)), {path.with_name(name) for name in images}
    kept = before
    try:
        sums = [_write(path.with_name(name), data) for name, data in images.items()]
        kept = new
    finally:
        for one in (before | new) - kept - set(with_images(path)):
            if one.suffix == ".webp":
                with suppress(OSError):
                    one.unlink()
    return sums[-1]


def _write(path: Path, data: bytes) -> str:
    with written(path) as file:
        file.write(data)
    return file.sha256


def _means(p: Parameters, image: Any) -> dict[str, Any]:
    wide = p["means"].astype(np.float64)
    t = np.sign(wide) * np.log1p(np.abs(wide))
    ends = zip((t.min(axis=0), t.max(axis=0)), (ROUND_FLOOR, ROUND_CEILING), strict=True)
    lows, highs = (np.array([_short(end, way) for end in row]) for row, way in ends)
    span = np.where(highs > lows, highs - lows, 1)
    levels = np.rint(65535 * (t - lows) / span).astype(np.uint16)
    files = [image("means_l", *(levels & 255).T), image("means_u", *(levels >> 8).T)]
    return {"mins": lows.tolist(), "maxs": highs.tolist(), "files": files}


def _alpha(p: Parameters) -> NDArray[np.float64]:
    """Opacities in 255 steps, 1 at least: lossless WebP forgets the colour under 0."""
    return np.maximum(np.rint(255 * opacities(p["logit_opacity"][:, 0])), 1)


@dataclass(frozen=True)
class Harmonics:
    """What a SOG holds of harmonics: numbers [256], a palette [E, c] of their indices, and a label for each splat."""

    numbers: NDArray[np.float64]
    palette: NDArray[np.uint8]
    labels: NDArray[np.int64]

    @classmethod
    def of(
        cls,
        rest: NDArray[np.float32],
        quality: Quality,
        clustering: Clustering = HostClusters,
        weights: NDArray[np.float64] | None = None,
        better: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.int64]]] | None = None,
        step: float | None = None,
    ) -> "Harmonics":
        """Quantise harmonics [N, c] by vectors for all; errors count by `weights` [N].  Those of `values` come out as
        they are.

        better: makes of a palette [E, c] another one, and the label of each splat.  step: of numbers, where those are
        few enough.
        """
        vectors, labels = palette(rest, _few(len(rest), quality), clustering, weights)
        if better and not np.array_equal(vectors[labels].astype(np.float32), rest):
            vectors, labels = better(vectors)
        return cls.by(vectors, labels, step)

    @classmethod
    def by(cls, vectors: NDArray[np.float64], labels: NDArray[np.int64], step: float | None = None) -> "Harmonics":
        """Those that vectors [E, c] and labels [N] stand for."""
        numbers = np.array([_short(number) for number in codebook(vectors, step)])
        return cls(numbers, nearest(vectors, numbers), labels)

    @property
    def values(self) -> NDArray[np.float32]:
        """The harmonics as they are read back, [N, c]."""
        return self.numbers.astype(np.float32)[self.palette][self.labels]


def _few(count: int, quality: Quality) -> int:
    """Entries of a palette for all Gaussians."""
    return min(PALETTES[quality], max(1, int(SMALLEST * 2.0 ** np.floor(np.log2(count / SMALLEST)))))


def _quantised(p: Parameters, weights: NDArray[np.float64], options: Writing) -> tuple[Parameters, Harmonics | None]:
    """The tables, rounded, and a palette of the harmonics.

    Harmonics that are a palette already stay as they are, and so do the tables then: whoever made it rounded them.
    In `high` the tables have the precision of the format.
    """
    rest, base = p["sh_rest"], p["sh_base"]
    most, few = min(MAX_PALETTE, int(SHARES[options.quality] * len(rest))), _few(len(rest), options.quality)
    kept = (different(rest, few) or different(rest, most, padded=False)) if rest.shape[1] else None
    harmonics = None if kept is None else Harmonics.by(*kept)
    if harmonics and rest.any():
        return p, harmonics
    if rest.any():
        harmonics = Harmonics.by(*tree_palette(rest, weights, max(most, few), MEDIAN_STEPS[options.quality]))
        base = base_for(base, rest - harmonics.values, visible_form(rest))
    if options.quality == "high":
        return {**p, "sh_base": base}, harmonics
    quats, log_scales = rounded_quats(p["quats"], p["log_scales"], TURN_STEP)
    changed = {
        "means": weighed_means(p["means"], p["log_scales"], weights, SIZE_SHARE),
        "quats": quats,
        "log_scales": rounded(log_scales, SCALE_STEP),
        "logit_opacity": rounded_opacities(p["logit_opacity"], ALPHA_STEP),
        "sh_base": rounded(base, COLOUR_STEP),
    }
    return {**p, **changed}, harmonics


def _write_harmonics(found: Harmonics, bands: int, image: Any) -> dict[str, Any]:
    size = found.palette.shape[1] // 3
    files = [image("shN_centroids", *found.palette.reshape(-1, 3).T, across=PER_ROW * size)]
    files.append(image("shN_labels", found.labels & 255, found.labels >> 8, np.zeros_like(found.labels)))
    return {"count": len(found.palette), "bands": bands, "codebook": found.numbers.tolist(), "files": files}


def _short(number: float, rounding: str = ROUND_HALF_EVEN) -> float:
    """A number in few digits, as float32 has it: the last bit of logarithms and means is the processor's."""
    return float(Context(8, rounding).create_decimal(float(number)))


def _zipped(images: dict[str, bytes]) -> bytes:
    """A ZIP without times, systems and compression of its own."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in images.items():
            member = zipfile.ZipInfo(name, EPOCH)
            member.create_system, member.external_attr = 3, 0o644 << 16
            archive.writestr(member, data)
    return packed.getvalue()
