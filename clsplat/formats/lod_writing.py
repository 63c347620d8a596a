"""Write streamed SOG, version 1 (layout: lod.py): the same levels give the same bytes."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.lod import LOD_META
from clsplat.formats.lod_tree import Limits, Node, Rows, tree
from clsplat.formats.output import written
from clsplat.formats.sog_files import META
from clsplat.formats.sog_writing import write_as_ordered
from clsplat.formats.splats import SplatFile, Writing, require_moderate, require_some
from clsplat.formats.weights import log_weights

USUAL = Limits()


def write_lod(folder: Path, levels: Sequence[SplatFile], options: Writing | None = None, limits: Limits = USUAL) -> str:
    """Write levels, the finest first, into a folder; return the SHA-256 of its JSON, which is written last.

    Raises DataError for a level without Gaussians, or one that SOG cannot hold, OutputError.
    """
    for level in levels:
        require_some(folder / LOD_META, level)
        require_moderate(folder / LOD_META, level, "SOG")
    root = tree([level.parameters for level in levels], limits)
    files = _Files(limits.splats)
    shape = files.shape(root)
    counts = [len(level) for level in levels]
    meta = {
        "version": 1,
        "asset": {"generator": "clsplat"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "filenames": list(files.rows),
        "tree": shape,
    }
    weights = [log_weights(level.parameters, level.has_sky) for level in levels]
    for name, (number, parts) in files.rows.items():
        rows = np.concatenate(parts)
        write_as_ordered(folder / name, levels[number].rows(rows), weights[number][rows], options or Writing())
    with written(folder / LOD_META) as file:
        file.write(json.dumps(meta, separators=(",", ":"), allow_nan=False).encode())
    return file.sha256


@dataclass
class _Files:
    """The files of all levels: a file takes leaves until it holds more than so many splats."""

    splats: int
    rows: dict[str, tuple[int, list[Rows]]] = field(default_factory=dict)  # by name: the level, and runs of its rows
    held: dict[str, int] = field(default_factory=dict)
    open: dict[int, int] = field(default_factory=dict)  # by level the number of the file that takes the next leaf

    def shape(self, node: Node) -> dict[str, Any]:
        """A node as JSON, whose leaves' rows get places in files."""
        bound = {"bound": {"min": _short(node.low), "max": _short(node.high)}}
        if node.children:
            return {**bound, "children": [self.shape(child) for child in node.children]}
        lods = {str(level): self._run(level, rows) for level, rows in enumerate(node.rows) if len(rows)}
        return {**bound, "lods": lods}

    def _run(self, level: int, rows: Rows) -> dict[str, int]:
        number = self.open.setdefault(level, 0)
        name = f"{level}_{number}/{META}"
        runs = self.rows.setdefault(name, (level, []))[1]
        offset = self.held.get(name, 0)
        runs.append(rows)
        self.held[name] = offset + len(rows)
        if self.held[name] > self.splats:
            self.open[level] += 1
        return {"file": list(self.rows).index(name), "offset": offset, "count": len(rows)}


def _short(numbers: NDArray[np.float64]) -> list[float]:
    """Numbers in 7 digits, as float32 has them."""
    return [float(f"{number:.7g}") for number in numbers]
