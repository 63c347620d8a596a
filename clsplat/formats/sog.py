"""Read SOG files of PlayCanvas, versions 1 and 2, and write version 2.

A SOG is a ZIP or a folder with lossless WebP images and a meta.json.

    means_l, means_u  low and high bytes of 65535 (t - min) / (max - min), t = sign(x) log(1 + |x|)
    quats   the three smallest of w x y z as 255 (c / sqrt 2 + 1/2); alpha is 252 + the index of the largest
    scales  indices into a codebook of log scales
    sh0     indices into a codebook of f_dc, and 255 opacity
    shN     a palette: labels of 16 bits, and centroids, 64 per row, as indices into a codebook

In version 1, scales, sh0, the opacity logit, and shN are 8-bit values between a minimum and a maximum.
"""

import io
import json
import os
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Context
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote
from clsplat.core.reading import read_file, read_json
from clsplat.formats import packing
from clsplat.formats.packing import from_smallest_three, morton_order, smallest_three, write_bytes
from clsplat.formats.palette import fit_codebook, fit_palette, nearest_entries, unique_points
from clsplat.formats.ply import read_extras
from clsplat.formats.sog_quantize import (
    compensate_base,
    fit_tree_palette,
    log_weights,
    round_means,
    round_quats,
    round_to,
    visible_form,
)
from clsplat.formats.splats import (
    MAX_DEGREE,
    MAX_FILE,
    Parameters,
    Quality,
    SplatFile,
    WriteOptions,
    logits,
    normalize_quats,
    opacities,
    require_gaussians,
    require_in_range,
    require_memory,
    sh_coefficients,
)

# The files of a SOG, in a ZIP or in the folder of a meta.json.

META = "meta.json"
PARTS = ("means", "scales", "quats", "sh0")  # required keys of meta.json; shN is optional
MAX_META = 1 << 24  # bytes of the largest meta.json
MAX_IMAGE = 1 << 30
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
MAX_RATIO = 2  # largest accepted compression ratio of images in a ZIP; they are already compressed
SLACK = 1 << 16  # bytes or px allowed in addition to the required ones


def sog_folder_files(path: Path) -> list[Path]:
    """Return the paths of a meta.json and of its existing images; only the meta.json if it is damaged."""
    try:
        meta = read_json(path, limit=MAX_META)
    except DataError:
        return [path]
    parts = [meta.get(name) for name in (*PARTS, "shN")] if isinstance(meta, dict) else []
    lists = [part.get("files") for part in parts if isinstance(part, dict)]
    names = {name: None for files in lists if isinstance(files, list) for name in files if isinstance(name, str)}
    images = [path.with_name(name) for name in names if is_sibling(name) and name != META]
    return [path, *filter(os.path.isfile, images)]


def is_sibling(name: str) -> bool:
    """Return whether a file name has no folder part, so that it names a file next to the meta.json."""
    return name == Path(name).name and "\\" not in name and bool(name.strip("."))


class SogFiles:
    """The files of a SOG, each of which is read only once.

    They are members of a ZIP, in any folder, or files next to a meta.json.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile | None = None, size: int = MAX_FILE) -> None:
        self.path, self.archive, self.max_size = path, archive, size
        self.contents: dict[str, bytes] = {}

    @property
    def bytes_read(self) -> int:
        """The number of bytes read so far, at most the size on disk."""
        return min(self.max_size, sum(map(len, self.contents.values())))

    def read(self, name: str) -> bytes:
        """Return the content of a file.  Raises DataError if it is missing, too large, or damaged."""
        if name not in self.contents:
            self.contents[name] = self._unzip(self.archive, name) if self.archive else self._read_sibling(name)
        return self.contents[name]

    def _read_sibling(self, name: str) -> bytes:
        path = self.path if name == META else self.path.with_name(name)
        return read_file(path, "a file of a SOG", limit=MAX_META if name == META else MAX_IMAGE)

    def _unzip(self, archive: zipfile.ZipFile, name: str) -> bytes:
        info = next((info for info in archive.infolist() if info.filename.rpartition("/")[2] == name), None)
        if info is None or info.compress_type not in COMPRESSIONS:
            fault = f"has no {quote(name)}" if info is None else f"{quote(name)} uses an unsupported compression"
            raise DataError(
                f"{self.path}: {fault}; expected the files that {META} names, stored or deflated; export it again"
            )
        image_bytes = sum(len(data) for key, data in self.contents.items() if key != META)
        limit = MAX_META if name == META else min(MAX_IMAGE, SLACK + MAX_RATIO * self.max_size - image_bytes)
        with archive.open(info) as member:
            data = member.read(limit + 1)
        if len(data) > limit:
            raise DataError(f"{self.path}: {quote(name)} has more than {limit} bytes; export it again")
        return data


@contextmanager
def open_sog(path: Path) -> Iterator[SogFiles]:
    """Open the files of a SOG folder or ZIP.  Raises DataError if the ZIP is missing or damaged."""
    if path.suffix.lower() == ".json":
        yield SogFiles(path)
        return
    data = read_file(path, "a .sog file", limit=MAX_FILE)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            yield SogFiles(path, archive, len(data))
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError, KeyError) as error:
        raise DataError(f"{path}: a damaged ZIP file ({quote(error)}); copy or export the file again") from error


PIXELS_PER_BYTE = 2  # largest accepted number of splats per byte of all images; real files have less than one
MIN_LIMIT = 1 << 19  # splats that a file of any size may have: 0.1 GB in memory
PER_ROW = 64  # centroids in a row of the image
MAX_PALETTE = 1 << 16  # largest number of centroids; labels have 16 bits
WIDTHS = {3: 1, 8: 2, 15: 3}  # SH degree by number of coefficients of a centroid
MAX_NUMBER = 1e30  # largest absolute value in meta.json
LARGEST_W = 252  # alpha of a quaternion whose largest component is w; 253 to 255 for x, y, z


def looks_like_sog(data: bytes) -> bool:
    """Return whether the first bytes are those of a ZIP or of the meta.json of a SOG folder."""
    return data.startswith(b"PK\3\4") or (data.lstrip()[:1] == b"{" and b'"means"' in data)


def read_sog(path: Path) -> SplatFile:
    """Read a `.sog` file, or a SOG folder, given its meta.json.  Raises DataError if a file is missing or damaged."""
    with open_sog(path) as files:
        try:
            meta = json.loads(files.read(META))
        except (ValueError, RecursionError) as error:
            raise DataError(f"{path}: {META} is not valid JSON; copy or export the file again") from error
        return _Sog(path, meta, files).decode()


def require_plausible(path: Path, count: int, size: int, degree: int = 0) -> None:
    """Raise DataError if `size` bytes cannot contain `count` splats, MemoryLimitError if memory is too small."""
    if count > MIN_LIMIT + PIXELS_PER_BYTE * size:
        raise DataError(f"{path}: declares {count} splats, but its files have only {size} bytes; copy it again")
    require_memory(path, count, degree)


class _Sog:
    """The meta.json of a SOG, and the files that it lists."""

    def __init__(self, path: Path, meta: Any, files: SogFiles) -> None:
        self.path, self.meta, self.files = path, meta, files
        shape = self._part("means").get("shape")
        self.is_version_1 = "version" not in meta and isinstance(shape, list)
        version = 1 if self.is_version_1 else meta.get("version")
        if version not in (1, 2):
            raise DataError(f"{path}: SOG version {quote(version)}; expected 1 or 2; export it again")
        self.count = self._require_count("count", shape[0] if self.is_version_1 and shape else meta.get("count"))
        self.images = {name: self._read_files(name) for name in PARTS}
        require_plausible(path, self.count, files.bytes_read, MAX_DEGREE if "shN" in meta else 0)

    def decode(self) -> SplatFile:
        """Decode all splats."""
        base = self._read_pixels("sh0", 0)
        scales, opacity = self._decode("scales", self._read_pixels("scales", 0)[:, :3]), base[:, 3]
        logit = logits(opacity[:, None] / 255.0)
        if self.is_version_1:
            minimum, maximum = self._read_ranges("sh0", 4)
            logit = (minimum[3] + (maximum[3] - minimum[3]) * (opacity[:, None] / 255.0)).astype(np.float32)
        parameters = {
            "means": self._decode_means(),
            "quats": self._decode_quats(),
            "log_scales": scales,
            "logit_opacity": logit,
            "sh_base": self._decode("sh0", base[:, :3]),
            "sh_rest": self._decode_sh_rest(),
        }
        is_mip = self.meta.get("model") == "antialiased" or self.meta.get("antialias") is True
        return SplatFile(parameters, read_extras(self.path, self.meta), "mip" if is_mip else "default")

    def _decode_means(self) -> NDArray[np.float32]:
        low, high = (self._read_pixels("means", i)[:, :3].astype(np.uint16) for i in (0, 1))
        minimum, maximum = self._read_ranges("means", 3)
        span = np.where(maximum > minimum, maximum - minimum, 1)
        t = minimum + (low | high << np.uint16(8)) / 65535.0 * span
        with np.errstate(over="ignore"):  # infinite positions are rejected later
            return (np.sign(t) * np.expm1(np.abs(t))).astype(np.float32)

    def _decode_quats(self) -> NDArray[np.float32]:
        pixels = self._read_pixels("quats", 0)
        is_valid = pixels[:, 3] >= LARGEST_W
        largest_index = np.where(is_valid, pixels[:, 3], LARGEST_W).astype(np.intp) - LARGEST_W
        quats = from_smallest_three(largest_index, (pixels[:, :3] / 255.0 - 0.5) * 2**0.5)
        quats[~is_valid] = [1, 0, 0, 0]
        return quats

    def _decode_sh_rest(self) -> NDArray[np.float32]:
        if "shN" not in self.meta:
            return np.zeros((self.count, 0), np.float32)
        files = self._read_files("shN")
        if len(files) != 2:
            raise DataError(f"{self.path}: shN has {len(files)} files; expected centroids and labels; export it again")
        labels = packing.decode_webp(self.path, "labels of shN", files[1], self.count, SLACK + 4 * self.count)
        splat_labels = labels[: self.count, 0].astype(np.intp) | labels[: self.count, 1].astype(np.intp) << 8
        used_entries = entries = 1 + int(splat_labels.max(initial=0))
        if self.is_version_1:
            degree = self._degree_of_width(files[0])
        else:
            entries = self._require_count("shN.count", self._part("shN").get("count", used_entries), MAX_PALETTE)
            degree = self._require_count("shN.bands", self._part("shN").get("bands"), MAX_DEGREE)
        coefficients = sh_coefficients(degree) - 1
        if used_entries > entries:
            raise DataError(
                f"{self.path}: labels of shN use {used_entries} centroids, but shN.count is {entries}; export it again"
            )
        limit = SLACK + 4 * coefficients * MAX_PALETTE
        centroids = packing.decode_webp(self.path, "centroids of shN", files[0], entries * coefficients, limit)
        table = centroids[: entries * coefficients, :3].reshape(entries, 3 * coefficients)
        return np.asarray(self._decode("shN", table)[splat_labels])

    def _degree_of_width(self, data: bytes) -> int:
        """Return the SH degree of a version 1 file, from the width of its image of centroids, 64 per row."""
        width, _ = packing.webp_size(self.path, "centroids of shN", data)
        if width // PER_ROW not in WIDTHS:
            raise DataError(
                f"{self.path}: centroids of shN are {width} px wide; expected 192, 512, or 960; export it again"
            )
        return WIDTHS[width // PER_ROW]

    def _decode(self, name: str, levels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Decode the bytes of a property, [N, c], which are codebook indices, or in version 1 fractions of a range."""
        if not self.is_version_1:
            entries = self._read_numbers(f"{name}.codebook", self._part(name).get("codebook"), 256)
            return np.asarray(entries.astype(np.float32)[levels])
        part = self._part(name)
        if name == "shN":
            minimum, maximum = (self._read_numbers(f"shN.{key}", [part.get(key)], 1) for key in ("mins", "maxs"))
        else:
            minimum, maximum = (values[: levels.shape[1]] for values in self._read_ranges(name, 3))
        return (minimum + levels / 255.0 * (maximum - minimum)).astype(np.float32)

    def _read_pixels(self, name: str, index: int) -> NDArray[np.uint8]:
        """Return the pixels of one image of a property, such as `means`: one pixel per splat, [count, 4]."""
        images = self.images[name]
        if index >= len(images):
            raise DataError(
                f"{self.path}: {name} lists {len(images)} files; expected at least {index + 1}; export it again"
            )
        label, limit = f"image {index} of {name}", SLACK + 4 * self.count
        return packing.decode_webp(self.path, label, images[index], self.count, limit)[: self.count]

    def _part(self, name: str) -> dict[str, Any]:
        part = self.meta.get(name) if isinstance(self.meta, dict) else None
        if not isinstance(part, dict):
            raise DataError(
                f"{self.path}: {META} has no '{name}'; expected means, scales, quats, and sh0; export it again"
            )
        return part

    def _read_files(self, name: str) -> list[bytes]:
        """Return the contents of the files of a property.  Raises DataError for names outside the folder."""
        names = self._part(name).get("files")
        if not isinstance(names, list) or not 1 <= len(names) <= 2 or not all(isinstance(file, str) for file in names):
            raise DataError(
                f"{self.path}: {name}.files is {quote(names)}; expected one or two file names; export it again"
            )
        if outside_names := [file for file in names if not is_sibling(file)]:
            raise DataError(
                f"{self.path}: {name}.files has {quote(outside_names[0])}; "
                "expected the name of a file in the same folder; export it again"
            )
        return [self.files.read(file) for file in names]

    def _read_ranges(self, name: str, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        part = self._part(name)
        minimum, maximum = (self._read_numbers(f"{name}.{key}", part.get(key), count) for key in ("mins", "maxs"))
        return minimum, maximum

    def _read_numbers(self, key_path: str, value: Any, count: int) -> NDArray[np.float64]:
        """Return a list of at least `count` numbers as an array.  Raises DataError for any other value."""
        is_list = isinstance(value, list) and count <= len(value) <= 256
        if not is_list or not all(isinstance(number, int | float) and abs(number) < MAX_NUMBER for number in value):
            raise DataError(
                f"{self.path}: {key_path} is {quote(value)}; "
                f"expected {count} numbers below {MAX_NUMBER:g}; export it again"
            )
        return np.array(value, np.float64)

    def _require_count(self, key_path: str, value: Any, limit: int = packing.MAX_SIDE**2) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= limit:
            raise DataError(
                f"{self.path}: {key_path} is {quote(value)}; expected a whole number from 1 to {limit}; export it again"
            )
        return value


# Writing SOG version 2; the same model gives the same bytes.

PALETTES = {"small": 1024, "balanced": 4096, "high": 16384}  # maximum palette entries in training
RELATIVE_PALETTES = {"small": 0.16, "balanced": 0.42, "high": 0.45}  # palette entries per splat, outside training
MEDIAN_STEPS = {"small": 6.0, "balanced": 5.0, "high": 3.0}  # rounding steps of palette vectors, in units of 1/128
QUAT_STEP = 4  # rounding step of quaternions, in units of 1/255
SIZE_STEP = 0.25  # rounding step of positions for a Gaussian of median weight, relative to its size
SCALE_STEP = 0.1  # rounding step of log scales
COLOR_STEP = 0.05  # rounding step of coefficients of band 0; a change of 1 changes a color by 0.28
BASE_ENTRIES = 1024  # palette entries in training for 1,024 splats; more splats get more entries
DIGITS = 16  # digits of the SHA-256 in the names of images in a folder


def write_sog(path: Path, splats: SplatFile, options: WriteOptions) -> str:
    """Write a `.sog` file, or a folder if the name is meta.json, and return the SHA-256 of that file.

    The names of images in a folder include a hash, so that images of another model are never replaced.
    Raises OutputError, and DataError if the model is empty or has values outside the range of the format.
    """
    require_gaussians(path, splats)
    require_in_range(path, splats, "SOG")
    sorted_splats = splats.rows(morton_order(splats.parameters["means"]))
    return write_ordered_sog(path, sorted_splats, log_weights(sorted_splats.parameters, sorted_splats.has_sky), options)


def write_ordered_sog(path: Path, splats: SplatFile, weights: NDArray[np.float64], options: WriteOptions) -> str:
    """Write a SOG as `write_sog` does, but keep the order of the splats.

    weights: base-2 logarithms, [N], from `log_weights` of the entire model, of which the splats may be a subset.
    """
    in_folder = path.name == META
    p, harmonics = _quantize(splats.parameters, weights, options)
    width = -(-int(np.ceil(np.sqrt(len(splats)))) // 4) * 4
    images: dict[str, bytes] = {}
    meta: dict[str, Any] = {"version": 2, "count": len(splats), "asset": {"generator": "clsplat"}}
    if splats.mode == "mip":
        meta |= {"model": "antialiased", "antialias": True}
    if splats.rendering:
        meta["extras"] = {"clsplat": splats.rendering}

    def write_image(name: str, *planes: NDArray[Any], columns: int = width) -> str:
        pixels = np.full((len(planes[0]), 4), 255, np.uint8)
        pixels[:, : len(planes)] = np.stack(planes, axis=1)
        data = packing.encode_webp(path, pixels, columns)
        name += f"_{sha256(data).hexdigest()[:DIGITS]}" * in_folder + ".webp"
        images[name] = data
        return name

    meta["means"] = _write_means(p, write_image)
    largest_index, components = smallest_three(normalize_quats(p["quats"]))
    levels = np.clip(np.rint(255 * (components * 0.5**0.5 + 0.5)), 0, 255)
    meta["quats"] = {"files": [write_image("quats", *levels.T, LARGEST_W + largest_index)]}
    for name, table, alpha in (("scales", "log_scales", []), ("sh0", "sh_base", [_alpha(p)])):
        entries = fit_codebook(p[table])
        planes = nearest_entries(p[table], entries).T
        meta[name] = {"codebook": [_round(number) for number in entries], "files": [write_image(name, *planes, *alpha)]}
    if harmonics is not None:
        meta["shN"] = _write_harmonics(harmonics, splats.sh_degree, write_image)
    images[META] = json.dumps(meta, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
    return _write_folder(path, images) if in_folder else write_bytes(path, _zip(images))


def _write_folder(path: Path, images: dict[str, bytes]) -> str:
    """Write the images and then meta.json, so that an old model stays valid until then; remove unused images."""
    old_files, new_files = set(sog_folder_files(path)), {path.with_name(name) for name in images}
    obsolete_files = new_files - old_files
    try:
        hashes = [write_bytes(path.with_name(name), data) for name, data in images.items()]
        obsolete_files = old_files - new_files
    finally:
        for file in obsolete_files - set(sog_folder_files(path)):
            if file.suffix == ".webp":
                with suppress(OSError):
                    file.unlink()
    return hashes[-1]


def _write_means(p: Parameters, write_image: Any) -> dict[str, Any]:
    means = p["means"].astype(np.float64)
    t = np.sign(means) * np.log1p(np.abs(means))
    extrema = zip((t.min(axis=0), t.max(axis=0)), (ROUND_FLOOR, ROUND_CEILING), strict=True)
    minimum, maximum = (np.array([_round(value, rounding) for value in values]) for values, rounding in extrema)
    span = np.where(maximum > minimum, maximum - minimum, 1)
    levels = np.rint(65535 * (t - minimum) / span).astype(np.uint16)
    files = [write_image("means_l", *(levels & 255).T), write_image("means_u", *(levels >> 8).T)]
    return {"mins": minimum.tolist(), "maxs": maximum.tolist(), "files": files}


def _alpha(p: Parameters) -> NDArray[np.float64]:
    """Return opacities from 1 to 255, [N].  0 is not used, because lossless WebP drops colors of transparent pixels."""
    return np.maximum(np.rint(255 * opacities(p["logit_opacity"][:, 0])), 1)


@dataclass(frozen=True)
class Harmonics:
    """The SH coefficients of a SOG, above band 0."""

    codebook: NDArray[np.float64]  # [256] values
    palette: NDArray[np.uint8]  # [E, c] indices into the codebook
    labels: NDArray[np.int64]  # [N] rows of the palette, one per splat

    @classmethod
    def fit(
        cls,
        rest: NDArray[np.float32],
        quality: Quality,
        weights: NDArray[np.float64],
        refine: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.int64]]],
        step: float | None = None,
    ) -> "Harmonics":
        """Fit a small palette to SH coefficients, [N, c].  A model with its `values` is saved without loss.

        weights: weight of each splat's squared error, [N].  refine: receives palette vectors, [E, c], and returns
        better ones and the label of each splat.  step: codebook values are rounded to multiples of this if at most 256
        distinct values remain.
        """
        vectors, labels = fit_palette(rest, _training_entries(len(rest), quality), weights)
        if weights.any() and not np.array_equal(vectors[labels].astype(np.float32), rest):
            vectors, labels = refine(vectors)
        return cls.from_vectors(vectors, labels, step)

    @classmethod
    def from_vectors(
        cls, vectors: NDArray[np.float64], labels: NDArray[np.int64], step: float | None = None
    ) -> "Harmonics":
        """Quantize palette vectors, [E, c], with a codebook.  labels: [N] rows of `vectors`, one per splat."""
        entries = np.array([_round(entry) for entry in fit_codebook(vectors, step)])
        return cls(entries, nearest_entries(vectors, entries), labels)

    @property
    def values(self) -> NDArray[np.float32]:
        """The SH coefficients that a reader decodes, [N, c]."""
        return self.codebook.astype(np.float32)[self.palette][self.labels]


def _training_entries(count: int, quality: Quality) -> int:
    """Return the number of palette entries that training uses for `count` splats."""
    return min(PALETTES[quality], max(1, int(BASE_ENTRIES * 2.0 ** np.floor(np.log2(count / BASE_ENTRIES)))))


def _quantize(
    p: Parameters, weights: NDArray[np.float64], options: WriteOptions
) -> tuple[Parameters, Harmonics | None]:
    """Round the tables; return them, and a palette of the SH (None if there are no SH bands above 0).

    If the SH already form a palette, training has rounded all tables, and they stay unchanged.
    Quality `high` rounds tables only to the precision of the format.
    """
    rest, base = p["sh_rest"], p["sh_base"]
    relative_entries = int(RELATIVE_PALETTES[options.quality] * len(rest))
    max_entries = min(MAX_PALETTE, max(_training_entries(len(rest), options.quality), relative_entries))
    exact_palette = unique_points(rest, max_entries) if rest.shape[1] else None
    harmonics = None if exact_palette is None else Harmonics.from_vectors(*exact_palette)
    if harmonics and rest.any():
        return p, harmonics
    if rest.any():
        harmonics = Harmonics.from_vectors(*fit_tree_palette(rest, weights, max_entries, MEDIAN_STEPS[options.quality]))
        base = compensate_base(base, rest - harmonics.values, visible_form(rest))
    if options.quality == "high":
        return {**p, "sh_base": base}, harmonics
    quats, log_scales = round_quats(p["quats"], p["log_scales"], QUAT_STEP)
    rounded_tables = {
        "means": round_means(p["means"], p["log_scales"], weights, SIZE_STEP),
        "quats": quats,
        "log_scales": round_to(log_scales, SCALE_STEP),
        "sh_base": round_to(base, COLOR_STEP),
    }
    return {**p, **rounded_tables}, harmonics


def _write_harmonics(sh: Harmonics, bands: int, write_image: Any) -> dict[str, Any]:
    size = sh.palette.shape[1] // 3
    files = [write_image("shN_centroids", *sh.palette.reshape(-1, 3).T, columns=PER_ROW * size)]
    files.append(write_image("shN_labels", sh.labels & 255, sh.labels >> 8, np.zeros_like(sh.labels)))
    return {"count": len(sh.palette), "bands": bands, "codebook": sh.codebook.tolist(), "files": files}


def _round(number: float, rounding: str = ROUND_HALF_EVEN) -> float:
    """Round to 8 significant digits, because the last bits of logarithms and means differ between processors."""
    return float(Context(8, rounding).create_decimal(float(number)))


def _zip(images: dict[str, bytes]) -> bytes:
    """Return the bytes of an uncompressed ZIP, which depend on neither the time nor the operating system."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in images.items():
            member = zipfile.ZipInfo(name, packing.EPOCH)
            member.create_system, member.external_attr = 3, 0o644 << 16
            archive.writestr(member, data)
    return buffer.getvalue()
