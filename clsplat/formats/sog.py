"""SOG of PlayCanvas, versions 1 and 2: numbers as lossless WebP images, in a ZIP or a folder, with meta.json.

    means_l, means_u  low and high bytes of 65535 (t - min) / (max - min), t = sign(x) log(1 + |x|)
    quats   the three smallest of w x y z as 255 (c / sqrt 2 + 1/2); alpha is 252 + the index of the largest
    scales  indices into a codebook of logarithms · sh0  indices into one of f_dc, and 255 opacity
    shN     a palette: labels in 16 bits, and centroids, 64 a row, as indices into a codebook

In version 1 scales, sh0, the logit of opacity, and shN lie between a least and a largest value, in 8 bits.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, quoted
from clsplat.formats import webp
from clsplat.formats.packing import from_smallest_three
from clsplat.formats.ply import checked_numbers
from clsplat.formats.sog_files import META, PARTS, SLACK, Files, is_beside, sog_files
from clsplat.formats.splats import MAX_DEGREE, SplatFile, logits, sh_coefficients

PIXELS_PER_BYTE = 16  # of all images; real ones have less than one
PER_ROW = 64  # centroids
MAX_PALETTE = 1 << 16  # centroids, as labels have 16 bits
WIDTHS = {3: 1, 8: 2, 15: 3}  # degree by coefficients of a centroid
LIMIT = 1e30  # of numbers in meta.json
ROTATED = 252  # alpha of a quaternion whose largest component is w


def looks_like_sog(data: bytes) -> bool:
    """Return whether bytes begin a ZIP, or the meta.json of a folder."""
    return data.startswith(b"PK\3\4") or (data.lstrip()[:1] == b"{" and b'"means"' in data)


def read_sog(path: Path) -> SplatFile:
    """Read a `.sog`, or the meta.json of a folder.  Raises DataError when it is missing or damaged."""
    with sog_files(path) as files:
        try:
            meta = json.loads(files.read(META))
        except (ValueError, RecursionError) as error:
            raise DataError(f"{path}: {META} is no JSON; copy or export the file again") from error
        return _Sog(path, meta, files).splats()


class _Sog:
    """One SOG: its meta.json, and the files that it names."""

    def __init__(self, path: Path, meta: Any, files: Files) -> None:
        self.path, self.meta, self.files = path, meta, files
        first = self._part("means").get("shape")
        self.old = "version" not in meta and isinstance(first, list)
        version = 1 if self.old else meta.get("version")
        if version not in (1, 2):
            raise DataError(f"{path}: SOG of version {quoted(version)}; expected 1 or 2: export it again")
        self.count = self._whole("count", first[0] if self.old and first else meta.get("count"))
        self.images = {name: self._data(name) for name in PARTS}
        if self.count > SLACK + PIXELS_PER_BYTE * files.size:
            raise DataError(f"{path}: declares {self.count} splats; its files have {files.size} bytes: copy it again")

    def splats(self) -> SplatFile:
        """Everything, as parameters."""
        base = self._pixels("sh0", 0)
        scales, opacity = self._looked_up("scales", self._pixels("scales", 0)[:, :3]), base[:, 3]
        if self.old:
            lows, highs = self._ends("sh0", 4)
            logit = (lows[3] + (highs[3] - lows[3]) * (opacity[:, None] / 255.0)).astype(np.float32)
        else:
            logit = logits(opacity[:, None] / 255.0)
        parameters = {
            "means": self._means(),
            "quats": self._quats(),
            "log_scales": scales,
            "logit_opacity": logit,
            "sh_base": self._looked_up("sh0", base[:, :3]),
            "sh_rest": self._rest(),
        }
        mip = self.meta.get("model") == "antialiased" or self.meta.get("antialias") is True
        extras = self.meta.get("extras")
        ours = extras.get("clsplat") if isinstance(extras, dict) else None
        rendering = checked_numbers(self.path, ours) if isinstance(ours, dict) else {}
        return SplatFile(parameters, rendering, "mip" if mip else "default")

    def _means(self) -> NDArray[np.float32]:
        low, high = (self._pixels("means", i)[:, :3].astype(np.uint16) for i in (0, 1))
        lows, highs = self._ends("means", 3)
        span = np.where(highs > lows, highs - lows, 1)
        t = lows + (low | high << np.uint16(8)) / 65535.0 * span
        with np.errstate(over="ignore"):  # infinity is refused
            return (np.sign(t) * np.expm1(np.abs(t))).astype(np.float32)

    def _quats(self) -> NDArray[np.float32]:
        pixels = self._pixels("quats", 0)
        known = pixels[:, 3] >= ROTATED
        largest = np.where(known, pixels[:, 3], ROTATED).astype(np.intp) - ROTATED
        quats = from_smallest_three(largest, (pixels[:, :3] / 255.0 - 0.5) * 2**0.5)
        quats[~known] = [1, 0, 0, 0]
        return quats

    def _rest(self) -> NDArray[np.float32]:
        if "shN" not in self.meta:
            return np.zeros((self.count, 0), np.float32)
        files = self._data("shN")
        if len(files) != 2:
            raise DataError(f"{self.path}: shN has {len(files)} files; expected centroids and labels: export it again")
        labels = webp.decode(self.path, "labels of shN", files[1], self.count, self._most(self.count))
        chosen = labels[: self.count, 0].astype(np.intp) | labels[: self.count, 1].astype(np.intp) << 8
        used = entries = 1 + int(chosen.max(initial=0))
        if self.old:
            degree = self._degree_of_width(files[0])
        else:
            entries = self._whole("shN.count", self._part("shN").get("count", used), MAX_PALETTE)
            degree = self._whole("shN.bands", self._part("shN").get("bands"), MAX_DEGREE)
        size = sh_coefficients(degree) - 1
        if used > entries:
            raise DataError(
                f"{self.path}: labels of shN name {used} centroids; shN.count is {entries}: export it again"
            )
        most = self._most(size * MAX_PALETTE)
        centroids = webp.decode(self.path, "centroids of shN", files[0], entries * size, most)
        table = centroids[: entries * size, :3].reshape(entries, 3 * size)
        return np.asarray(self._looked_up("shN", table)[chosen])

    def _degree_of_width(self, data: bytes) -> int:
        """The degree of a version 1, which no number tells: its centroids are 64 a row."""
        width, _ = webp.size(self.path, "centroids of shN", data)
        if width // PER_ROW not in WIDTHS:
            raise DataError(
                f"{self.path}: centroids of shN are {width} px wide; expected 192, 512 or 960: export it again"
            )
        return WIDTHS[width // PER_ROW]

    def _looked_up(self, name: str, levels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The numbers that bytes stand for: entries of a codebook, or in version 1 shares of a range."""
        if not self.old:
            entries = self._numbers(f"{name}.codebook", self._part(name).get("codebook"), 256)
            return np.asarray(entries.astype(np.float32)[levels])
        part = self._part(name)
        if name == "shN":
            lows, highs = (self._numbers(f"shN.{key}", [part.get(key)], 1) for key in ("mins", "maxs"))
        else:
            lows, highs = (ends[: levels.shape[1]] for ends in self._ends(name, 3))
        return (lows + levels / 255.0 * (highs - lows)).astype(np.float32)

    def _pixels(self, name: str, number: int) -> NDArray[np.uint8]:
        """The first pixels of an image, one for each splat, [count, 4]."""
        group = self.images[name]
        if number >= len(group):
            raise DataError(
                f"{self.path}: {name} names {len(group)} files; expected {number + 1} at least: export it again"
            )
        pixels = webp.decode(self.path, f"image {number} of {name}", group[number], self.count, self._most(self.count))
        return pixels[: self.count]

    @staticmethod
    def _most(count: int) -> int:
        return SLACK + 4 * count

    def _part(self, name: str) -> dict[str, Any]:
        part = self.meta.get(name) if isinstance(self.meta, dict) else None
        if not isinstance(part, dict):
            raise DataError(
                f"{self.path}: {META} has no '{name}'; expected means, scales, quats and sh0: export it again"
            )
        return part

    def _data(self, name: str) -> list[bytes]:
        """The files of a part.  Raises DataError for names that leave the folder."""
        names = self._part(name).get("files")
        if not isinstance(names, list) or not 1 <= len(names) <= 2 or not all(isinstance(one, str) for one in names):
            raise DataError(
                f"{self.path}: {name}.files is {quoted(names)}; expected the names of one or two files: export it again"
            )
        if wrong := [one for one in names if not is_beside(one)]:
            raise DataError(
                f"{self.path}: {name}.files has {quoted(wrong[0])}; "
                "expected the name of a file beside it: export it again"
            )
        return [self.files.read(one) for one in names]

    def _ends(self, name: str, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        part = self._part(name)
        lows, highs = (self._numbers(f"{name}.{key}", part.get(key), count) for key in ("mins", "maxs"))
        return lows, highs

    def _numbers(self, place: str, value: Any, count: int) -> NDArray[np.float64]:
        """A list of numbers, `count` at least."""
        fits = isinstance(value, list) and count <= len(value) <= 256
        if not fits or not all(isinstance(one, int | float) and abs(one) < LIMIT for one in value):
            raise DataError(
                f"{self.path}: {place} is {quoted(value)}; expected {count} numbers below {LIMIT:g}: export it again"
            )
        return np.array(value, np.float64)

    def _whole(self, place: str, value: Any, most: int = webp.MAX_SIDE**2) -> int:
        if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most or math.isnan(value):
            raise DataError(
                f"{self.path}: {place} is {quoted(value)}; expected a whole number from 1 to {most}: export it again"
            )
        return value
