"""Pictures of a model in a folder, one file for each view and layer."""

import io
import json
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import ConfigError, DataError
from clsplat.files import atomic, is_there, told_as, write_text
from clsplat.progress import counted
from clsplat.reading import read_json
from clsplat.scene.images import write_image
from clsplat.scene.view import View
from clsplat.stages.render import image_paths
from clsplat.video.pictures import LAYERS, Canvas, shown, values

FRAME = re.compile(r"frame_\d{5,6}(_[a-z]+)?\.[a-z]+")  # of a film; those of the path `views` are called as views
LOG = logging.getLogger("clsplat")
KINDS = ("png", "npy")  # of files
RECORD = ".renders.json"  # beside renders: a table of their names, and whether each is a frame of a film


def write_pictures(
    canvas: Canvas,
    views: Sequence[View],
    out: Path,
    kind: str,
    layers: Sequence[str],
    photographs: Sequence[Path],
    film: bool = False,
) -> list[Path]:
    """Write images (`kind` png) or float32 arrays (npy) of the layers of each view; return their files.

    A layer but the colours has its name in that of the file.  photographs: files that no picture may mix with; film:
    the views are a film, and frames of this kind that an earlier one has left are removed at the end.
    """
    own = image_paths(out, [view.name for view in views], f".{kind}")
    files = [{layer: _of_layer(path, layer) for layer in layers} for path in own]
    paths = [path for of_view in files for path in of_view.values()]
    if len(set(paths)) < len(paths):
        raise ConfigError(f"{out}: two pictures would have one name, as a view is called _depth or _alpha; rename it")
    _check_folder(out, paths, photographs)
    names = [path.relative_to(out).as_posix() for path in paths]
    rendered = {**_rendered(out), **dict.fromkeys(names, film)}
    _note(out, rendered)
    depths = canvas.depth_range(views) if "depth" in layers and kind == "png" else (0.0, 0.0)
    for view, of_view in counted(zip(views, files, strict=True), "views rendered", len(views)):
        found = canvas.layers(view, "depth" in layers)
        for layer, path in of_view.items():
            if kind == "png":
                write_image(path, shown(found, layer, depths))
            else:
                _write_array(path, values(found, layer))
    if film:
        _remove(out, {name for name, framed in rendered.items() if framed and name.endswith(f".{kind}")} - {*names})
    return paths


def _remove(out: Path, frames: set[str]) -> None:
    """Remove frames of an earlier film from a folder and its record."""
    with told_as(out):
        for name in frames:
            (out / name).unlink(missing_ok=True)
    _note(out, {name: framed for name, framed in _rendered(out).items() if name not in frames})
    if frames:
        LOG.info("%s: removed %d pictures of an earlier film", out, len(frames))


def _of_layer(path: Path, layer: str) -> Path:
    return path if layer == LAYERS[0] else path.with_name(f"{path.stem}_{layer}{path.suffix}")


def _write_array(path: Path, array: NDArray[np.float32]) -> None:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    with atomic(path) as stream:
        stream.write(buffer.getvalue())


def _check_folder(out: Path, paths: Sequence[Path], photographs: Sequence[Path]) -> None:
    """Raise ConfigError where renders would mix with photographs, or replace what no earlier call has rendered."""
    folder = out.resolve()
    for images in {path.resolve().parent for path in photographs}:
        if folder == images or folder in images.parents or images in folder.parents:
            raise ConfigError(
                f"{out}: is, holds or lies in the folder of the photographs, {images}; give another --out"
            )
    own = _rendered(out)
    for path in paths:
        if is_there(path) and path.relative_to(out).as_posix() not in own:
            raise ConfigError(f"{path}: exists, and is no render of an earlier call; give another --out")


def _rendered(out: Path) -> dict[str, bool]:
    """The files that earlier calls have rendered into a folder, and whether each is a frame of a film."""
    try:
        found = read_json(out / RECORD)
    except DataError:
        return {}
    table = found if isinstance(found, dict) else {}
    return {name: film is True and FRAME.fullmatch(name) is not None for name, film in table.items()}


def _note(out: Path, rendered: Mapping[str, bool]) -> None:
    write_text(out / RECORD, json.dumps(rendered, indent=1, sort_keys=True) + "\n")
