"""Streamed SOG of PlayCanvas, version 1: levels of detail, each in SOG files of its own, and a tree of boxes.

    lod-meta.json   version 1, count of all levels, counts by level, lodLevels, filenames, tree, and an environment
    a node          bound {min, max}, and two children, or as a leaf lods: by level a file, an offset and a count
    L_i/meta.json   a SOG of level L as a folder, which holds runs of leaves one after the other; 0 is the finest

A program that shows it takes of each leaf the level that its distance asks for.  Read is the finest level.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import DataError, quoted
from clsplat.formats.sog import read_sog
from clsplat.formats.sog_files import MAX_META, META, with_images
from clsplat.formats.splats import MAX_DEGREE, SplatFile, with_degree
from clsplat.names import is_inside
from clsplat.reading import read_json

LOD_META = "lod-meta.json"
Run = tuple[int, int]  # offset and count of a leaf's splats in a file


def looks_like_lod(data: bytes) -> bool:
    """Return whether bytes begin a lod-meta.json."""
    return data.lstrip()[:1] == b"{" and b'"lodLevels"' in data


def read_lod(path: Path) -> SplatFile:
    """Read the finest level of a lod-meta.json, and its environment.  Raises DataError when it is damaged."""
    meta = _meta(path)
    runs: dict[int, list[Run]] = {}
    for leaf in _leaves(path, meta.get("tree")):
        if "0" in leaf:
            file, offset, count = (_whole(path, key, leaf["0"]) for key in ("file", "offset", "count"))
            runs.setdefault(file, []).append((offset, count))
    names = meta["filenames"]
    if not runs or max(runs) >= len(names):
        raise DataError(f"{path}: its leaves name no file of level 0, or one that it has not; export it again")
    parts = [_part(path, names[file], sorted(runs[file])) for file in sorted(runs)]
    found, declared = sum(map(len, parts)), meta["counts"][0]
    if found != declared:
        raise DataError(f"{path}: declares {quoted(declared)} splats of level 0; its leaves have {found}: export again")
    if "environment" in meta:
        parts.append(read_sog(path.parent / _inside(path, meta["environment"])))
    degree = min(MAX_DEGREE, max(part.sh_degree for part in parts))
    tables = [with_degree(part.parameters, degree) for part in parts]
    joined = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    return SplatFile(joined, parts[0].rendering, parts[0].mode)


def files_of_lod(path: Path) -> list[Path]:
    """Return a lod-meta.json and all files of its levels."""
    meta = _meta(path)
    names = [*meta["filenames"], *([meta["environment"]] if "environment" in meta else [])]
    places = [path.parent / _inside(path, name) for name in names]
    return [path, *(file for place in places for file in with_images(place))]


def _meta(path: Path) -> dict[str, Any]:
    meta = read_json(path, "a lod-meta.json", limit=MAX_META)
    if not isinstance(meta, dict) or meta.get("version") != 1:
        version = quoted(meta.get("version") if isinstance(meta, dict) else meta)
        raise DataError(f"{path}: streamed SOG of version {version}; expected 1: export it again")
    names, counts = meta.get("filenames"), meta.get("counts")
    if not isinstance(names, list) or len({_inside(path, name) for name in names}) < len(names):
        raise DataError(f"{path}: filenames is {quoted(names)}; expected names of files, each once: export it again")
    if not isinstance(counts, list) or not counts:
        raise DataError(f"{path}: counts is {quoted(counts)}; expected a number for each level: export it again")
    return meta


def _inside(path: Path, name: Any) -> str:
    """The name of a meta.json below the folder."""
    if not isinstance(name, str) or not is_inside(name) or Path(name).name != META or "\\" in name:
        raise DataError(f"{path}: names {quoted(name)}; expected a {META} in a folder below; export it again")
    return name


def _leaves(path: Path, tree: Any) -> Iterator[dict[str, Any]]:
    """What each leaf holds by level."""
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        children, lods = (node.get("children"), node.get("lods")) if isinstance(node, dict) else (None, None)
        if isinstance(lods, dict):
            yield lods
        elif isinstance(children, list):
            waiting += children[::-1]
        else:
            raise DataError(f"{path}: a node of its tree is {quoted(node)}; expected children or lods: export it again")


def _whole(path: Path, key: str, run: Any) -> int:
    value = run.get(key) if isinstance(run, dict) else None
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise DataError(f"{path}: {key} of a leaf is {quoted(value)}; expected a whole number: export it again")
    return value


def _part(path: Path, name: str, runs: list[Run]) -> SplatFile:
    """The splats of a file that are in leaves.  runs: ascending."""
    part = read_sog(path.parent / name)
    rows, end = [], 0
    for offset, count in runs:
        if offset < end or offset + count > len(part):
            raise DataError(
                f"{path}: a leaf has {count} splats from {offset} on of {quoted(name)}, which holds {len(part)} and "
                f"whose first {end} are in other leaves; export it again"
            )
        end = offset + count
        rows.append(np.arange(offset, end))
    return part.rows(np.concatenate(rows))
