"""Read and write streamed SOG of PlayCanvas, version 1: levels of detail in SOG files, and a tree of boxes.

    lod-meta.json   version 1, count of all levels, counts by level, lodLevels, filenames, tree, and an environment
    a node          bound {min, max}, and two children; a leaf has lods: file, offset, and count for each level
    L_i/meta.json   a SOG folder of level L, with the splats sorted by leaf; level 0 is the finest

A viewer chooses the level of each leaf by its distance.  Reading returns the finest level.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, quote
from clsplat.core.files import invalid_name_reason, is_inside
from clsplat.core.reading import read_json
from clsplat.formats.packing import morton_order, write_bytes
from clsplat.formats.sog import MAX_META, META, read_sog, require_plausible, sog_folder_files, write_ordered_sog
from clsplat.formats.sog_quantize import log_weights
from clsplat.formats.splats import (
    Parameters,
    SplatFile,
    WriteOptions,
    concatenate,
    normalize_quats,
    require_gaussians,
    require_in_range,
    typical_size,
)

LOD_META = "lod-meta.json"
MAX_LEVELS = 64  # programs write about ten levels
RowRange = tuple[int, int]  # offset and count of a leaf's splats in a file
RangesByFile = dict[int, list[RowRange]]  # row ranges of one level, ascending, by file number


def looks_like_lod(data: bytes) -> bool:
    """Return whether the first bytes are those of a lod-meta.json."""
    return data.lstrip()[:1] == b"{" and b'"lodLevels"' in data


def read_lod(path: Path) -> SplatFile:
    """Read the finest level of a lod-meta.json and its environment.  Raises DataError if it is damaged."""
    meta = _read_meta(path)
    ranges = _row_ranges(path, meta)[0]
    if not ranges:
        raise DataError(f"{path}: its leaves have no file of level 0; export it again")
    count = sum(count for leaves in ranges.values() for _, count in leaves)
    require_plausible(path, count, sum(file.stat().st_size for file in lod_files(path) if file.is_file()))
    parts = [_read_splats(path, meta["filenames"][file], ranges[file]) for file in sorted(ranges)]
    _require_count(path, meta, 0, ranges)
    if "environment" in meta:
        parts.append(read_sog(path.parent / _check_name(path, meta["environment"])))
    return SplatFile(concatenate([part.parameters for part in parts]), parts[0].rendering, parts[0].mode)


def find_level_faults(path: Path) -> list[str]:
    """Return a message for each missing or damaged file of the coarser levels; `read_lod` checks the finest level."""
    meta, faults = _read_meta(path), []
    levels = _row_ranges(path, meta)
    unused_files: RangesByFile = {file: [] for file in {*range(len(meta["filenames"]))}.difference(*levels)}
    for level, ranges in enumerate(levels):
        try:
            faults += _find_faults(path, meta, ranges) if level else []
            _require_count(path, meta, level, ranges)
        except DataError as error:
            faults.append(str(error))
    return faults + _find_faults(path, meta, unused_files)


def _find_faults(path: Path, meta: dict[str, Any], ranges: RangesByFile) -> list[str]:
    """Return an error message for each missing or damaged file.  ranges: row ranges of leaves, by file number."""
    faults = []
    for file, leaves in sorted(ranges.items()):
        try:
            _read_splats(path, meta["filenames"][file], leaves)
        except DataError as error:
            faults.append(str(error))
    return faults


def lod_files(path: Path) -> list[Path]:
    """Return the paths of a lod-meta.json and of all files of its levels."""
    meta = _read_meta(path)
    names = [*meta["filenames"], *([meta["environment"]] if "environment" in meta else [])]
    metas = [path.parent / _check_name(path, name) for name in names]
    return [path, *(file for meta in metas for file in sog_folder_files(meta))]


def _read_meta(path: Path) -> dict[str, Any]:
    meta = read_json(path, "a lod-meta.json", limit=MAX_META)
    if not isinstance(meta, dict) or meta.get("version") != 1:
        version = quote(meta.get("version") if isinstance(meta, dict) else meta)
        raise DataError(f"{path}: streamed SOG version {version}; expected 1; export it again")
    names, counts = meta.get("filenames"), meta.get("counts")
    if not isinstance(names, list) or len({PureWindowsPath(_check_name(path, name)) for name in names}) < len(names):
        raise DataError(f"{path}: filenames is {quote(names)}; expected distinct file names; export it again")
    if not isinstance(counts, list) or not 1 <= len(counts) <= MAX_LEVELS:
        raise DataError(
            f"{path}: counts is {quote(counts)}; expected a list with one number per level, for 1 to {MAX_LEVELS} "
            "levels; export it again"
        )
    if (levels := meta.get("lodLevels")) != len(counts):
        raise DataError(
            f"{path}: lodLevels is {quote(levels)}; expected {len(counts)}, the length of counts; export it again"
        )
    return meta


def _check_name(path: Path, name: Any) -> str:
    """Return `name` if it is the path of a meta.json in a subfolder.  Raises DataError otherwise."""
    if not isinstance(name, str) or not _is_meta_below(name):
        raise DataError(f"{path}: names {quote(name)}; expected a {META} in a subfolder; export it again")
    return name


def _is_meta_below(name: str) -> bool:
    path = PureWindowsPath(name)
    return is_inside(name) and path.name == META and "\\" not in name and not any(map(invalid_name_reason, path.parts))


def _row_ranges(path: Path, meta: dict[str, Any]) -> list[RangesByFile]:
    """Return the row ranges of the leaves in each file, for each level.  Raises DataError for a damaged leaf."""
    levels: list[RangesByFile] = [{} for _ in meta["counts"]]
    level_by_name = {str(level): level for level in range(len(levels))}
    for leaf in _iterate_leaves(path, meta.get("tree")):
        for name, entry in leaf.items():
            if name not in level_by_name:
                raise DataError(
                    f"{path}: a leaf refers to level {quote(name)}; expected 0 to {len(levels) - 1}; export it again"
                )
            file, offset, count = (_parse_integer(path, key, entry) for key in ("file", "offset", "count"))
            levels[level_by_name[name]].setdefault(file, []).append((offset, count))
    for level, ranges in enumerate(levels):
        if max(ranges, default=-1) >= len(meta["filenames"]):
            raise DataError(f"{path}: a leaf refers to a missing file of level {level}; export it again")
    return [{file: sorted(leaves) for file, leaves in ranges.items()} for ranges in levels]


def _require_count(path: Path, meta: dict[str, Any], level: int, ranges: RangesByFile) -> None:
    count, expected = sum(count for leaves in ranges.values() for _, count in leaves), meta["counts"][level]
    if count != expected:
        raise DataError(
            f"{path}: declares {quote(expected)} splats of level {level}, but its leaves have {count}; export it again"
        )


def _iterate_leaves(path: Path, tree: Any) -> Iterator[dict[str, Any]]:
    """Yield the row ranges of each leaf, by level."""
    pending = [tree]
    while pending:
        node = pending.pop()
        children, lods = (node.get("children"), node.get("lods")) if isinstance(node, dict) else (None, None)
        if isinstance(lods, dict):
            yield lods
        elif isinstance(children, list):
            pending += children[::-1]
        else:
            raise DataError(f"{path}: a node of its tree is {quote(node)}; expected children or lods; export it again")


def _parse_integer(path: Path, key: str, entry: Any) -> int:
    value = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise DataError(f"{path}: {key} of a leaf is {quote(value)}; expected a whole number; export it again")
    return value


def _read_splats(path: Path, name: str, ranges: list[RowRange]) -> SplatFile:
    """Return the splats of a file that belong to leaves.  ranges: row ranges in ascending order."""
    splats = read_sog(path.parent / name)
    rows, end = [np.arange(0)], 0
    for offset, count in ranges:
        if offset < end or offset + count > len(splats):
            raise DataError(
                f"{path}: a leaf contains splats {offset} to {offset + count - 1} of {quote(name)}; expected splats "
                f"from {end} to {len(splats) - 1}, which no other leaf contains; export it again"
            )
        end = offset + count
        rows.append(np.arange(offset, end))
    return splats.rows(np.concatenate(rows))


# The tree of a streamed SOG: boxes of the splats of all levels, halved until they are small.

MAX_LOG_SCALE = 80.0  # limit for boxes, because JSON has no infinity
Floats = NDArray[np.float64]
Rows = NDArray[np.intp]


@dataclass(frozen=True)
class LeafLimits:
    """The limits of a leaf; the defaults are those of PlayCanvas."""

    splats: int = 512 * 1024  # largest number, counting all levels; a file may exceed it by one leaf
    extent: float = 4.0  # longest side of the box of the means, in typical sizes: 16 scene units for a size of 4
    min_splats: int = 1024  # leaves with no more splats are not split because of their extent


@dataclass(frozen=True)
class Node:
    """A box with two children, or a leaf with the rows of its splats by level, in Morton order."""

    low: Floats  # [3] scene units
    high: Floats
    children: tuple["Node", ...] = ()
    rows: tuple[Rows, ...] = ()

    def leaves(self) -> Iterator["Node"]:
        """Yield all leaves from left to right."""
        if not self.children:
            yield self
        for child in self.children:
            yield from child.leaves()


def build_tree(levels: Sequence[Parameters], limits: LeafLimits) -> Node:
    """Build the tree of all levels.  levels: not empty, finest first."""
    means = np.concatenate([level["means"] for level in levels]).astype(np.float64)
    reach, max_extent = np.concatenate([half_boxes(level) for level in levels]), limits.extent * typical_size(means)
    starts = np.cumsum([0, *(len(level["means"]) for level in levels)])

    def build_node(rows: Rows) -> Node:
        span = np.ptp(means[rows], axis=0)
        if len(rows) > limits.splats or (span.max() > max_extent and len(rows) > limits.min_splats):
            sorted_rows = rows[np.argsort(means[rows, int(span.argmax())], kind="stable")]
            halves = build_node(sorted_rows[: len(rows) // 2]), build_node(sorted_rows[len(rows) // 2 :])
            low = np.minimum(*(half.low for half in halves))
            return Node(low, np.maximum(*(half.high for half in halves)), halves)
        low, high = (means[rows] - reach[rows]).min(axis=0), (means[rows] + reach[rows]).max(axis=0)
        return Node(low, high, rows=tuple(split_levels(np.sort(rows))))

    def split_levels(rows: Rows) -> Iterator[Rows]:
        for part, start in zip(np.split(rows, np.searchsorted(rows, starts[1:-1])), starts, strict=False):
            yield part[morton_order(means[part])] - start

    return build_node(np.arange(len(means)))


def half_boxes(level: Parameters) -> Floats:
    """Return half the side lengths of the bounding boxes of Gaussians at one sigma, [N, 3] scene units."""
    from scipy.spatial.transform import Rotation

    axes = np.abs(Rotation.from_quat(np.roll(normalize_quats(level["quats"]), -1, axis=1)).as_matrix())
    scales = np.exp(np.minimum(level["log_scales"].astype(np.float64), MAX_LOG_SCALE))
    half: Floats = np.einsum("nij,nj->ni", axes, scales)
    return half


# Writing streamed SOG version 1; the same levels give the same bytes.

DEFAULT_LIMITS = LeafLimits()


def write_lod(
    folder: Path, levels: Sequence[SplatFile], options: WriteOptions | None = None, limits: LeafLimits = DEFAULT_LIMITS
) -> str:
    """Write levels, finest first, into a folder; return the SHA-256 of its JSON, which is written last.

    Raises DataError for a level that is empty or that SOG cannot store, and OutputError.
    """
    for level in levels:
        require_gaussians(folder / LOD_META, level)
        require_in_range(folder / LOD_META, level, "SOG")
    root = build_tree([level.parameters for level in levels], limits)
    files = _FileList(limits.splats)
    root_data = files.to_json(root)
    counts = [len(level) for level in levels]
    meta = {
        "version": 1,
        "asset": {"generator": "clsplat"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "filenames": list(files.rows),
        "tree": root_data,
    }
    weights = [log_weights(level.parameters, level.has_sky) for level in levels]
    for name, (index, parts) in files.rows.items():
        rows = np.concatenate(parts)
        write_ordered_sog(folder / name, levels[index].rows(rows), weights[index][rows], options or WriteOptions())
    return write_bytes(folder / LOD_META, json.dumps(meta, separators=(",", ":"), allow_nan=False).encode())


@dataclass
class _FileList:
    """The files of all levels.  Leaves are added to a file until it has more than `splats` splats."""

    splats: int
    rows: dict[str, tuple[int, list[Rows]]] = field(default_factory=dict)  # by file name: level, rows of leaves
    next_file: dict[int, int] = field(default_factory=dict)  # by level, the number of the file for the next leaf

    def to_json(self, node: Node) -> dict[str, Any]:
        """Return a node as JSON data, and assign the rows of its leaves to files."""
        bound = {"bound": {"min": _round(node.low), "max": _round(node.high)}}
        if node.children:
            return {**bound, "children": [self.to_json(child) for child in node.children]}
        lods = {str(level): self._add_rows(level, rows) for level, rows in enumerate(node.rows) if len(rows)}
        return {**bound, "lods": lods}

    def _add_rows(self, level: int, rows: Rows) -> dict[str, int]:
        number = self.next_file.setdefault(level, 0)
        name = f"{level}_{number}/{META}"
        parts = self.rows.setdefault(name, (level, []))[1]
        offset = sum(map(len, parts))
        parts.append(rows)
        if offset + len(rows) > self.splats:
            self.next_file[level] += 1
        return {"file": list(self.rows).index(name), "offset": offset, "count": len(rows)}


def _round(numbers: NDArray[np.float64]) -> list[float]:
    """Round numbers to 7 digits, the precision of float32."""
    return [float(f"{number:.7g}") for number in numbers]
