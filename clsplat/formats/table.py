"""List the file formats.  Reading detects the format by content, and writing selects it by file name."""

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.core.errors import ConfigError, DataError, OutputError, quote, shorten
from clsplat.core.reading import open_file, require_content
from clsplat.formats.compressed_ply import is_compressed, read_compressed_ply
from clsplat.formats.gltf import gltf_files, looks_like_gltf, read_gltf, write_glb
from clsplat.formats.mesh import write_csv, write_points
from clsplat.formats.ply import MAX_HEADER, PlyHeader, check_rendering, parse_ply_header, read_ply, write_ply
from clsplat.formats.sog import META, looks_like_sog, read_sog, sog_folder_files, write_sog
from clsplat.formats.splat import looks_like_ksplat, looks_like_splat, read_ksplat, read_splat, write_splat
from clsplat.formats.splats import (
    MIP_VARIANCE,
    VARIANCE,
    ReadOptions,
    SplatFile,
    WriteOptions,
    clamp_limits,
    default_near,
    handle_not_finite,
    not_finite,
    require_static,
)
from clsplat.formats.spz import read_spz, write_spz
from clsplat.formats.streamed_sog import LOD_META, lod_files, looks_like_lod, read_lod
from clsplat.formats.usd import looks_like_usd, read_usd, write_usd

# Each format with its functions that recognize, read, and write files.


@dataclass(frozen=True)
class FileStart:
    """The first bytes of a file, by which its format is detected."""

    path: Path
    data: bytes  # start of the file, at most MAX_HEADER bytes
    size: int  # bytes of the file

    def parse_ply(self) -> PlyHeader | None:
        """Return the header of a readable PLY file, or None for other files."""
        if not self.data.startswith(b"ply"):
            return None
        try:
            return parse_ply_header(self.path, self.data)
        except DataError:  # the reader reports what is wrong
            return None


@dataclass(frozen=True)
class Codec:
    """One file format."""

    name: str
    endings: tuple[str, ...]  # endings of file names
    matches: Callable[[FileStart], bool]
    read: Callable[[Path, ReadOptions], SplatFile] | None = None
    write: Callable[[Path, SplatFile, WriteOptions], str] | None = None  # returns the SHA-256
    command: str = ""  # the only command that writes this format
    keeps_all: bool = False  # stores the world filter, motion, values that are not finite, and positions in float64
    keeps_mode: bool = True  # stores whether a model is a mip model
    keeps_rendering: bool = False  # stores rendering settings
    keeps_origin: bool = False  # stores the origin without the other rendering settings
    has_quality: bool = False  # writing uses WriteOptions.quality
    has_magic: bool = True  # a magic number, or another clear mark at the start of files
    is_model: bool = True  # stores Gaussians, not only points
    has_collider: bool = False  # writing uses WriteOptions.collider


# The files of a model.


def model_file(path: Path) -> Path:
    """Return the main file of a model: the meta.json or lod-meta.json of a folder, else the path itself."""
    files = (path / name for name in (META, LOD_META)) if path.is_dir() else ()
    return next(filter(Path.is_file, files), path)


def model_files(path: Path) -> list[Path]:
    """Return a model's main file and the files that it refers to."""
    if path.name == LOD_META:
        return lod_files(path)
    files = {".json": sog_folder_files, ".gltf": gltf_files}.get(path.suffix.lower())
    return files(path) if files else [path]


def model_bytes(path: Path) -> int:
    """Return the size of a model in bytes, with all files that its JSON names.  Raises DataError if one is missing."""
    main = model_file(path)
    try:
        return sum(file.stat().st_size for file in model_files(main))
    except OSError as error:
        prefix = "" if error.filename == str(main) else f"names {quote(error.filename)}, which "
        raise DataError(f"{main}: {prefix}cannot be read ({error.strerror}); copy or export it again") from error


LOG = logging.getLogger("clsplat")

CODECS = (
    Codec(
        "PLY",
        (".ply",),
        lambda start: (header := start.parse_ply()) is not None and "f_dc_0" in (header.dtype.names or ()),
        lambda path, options: read_ply(path),
        lambda path, splats, options: write_ply(path, splats.parameters, splats.rendering),
        keeps_all=True,
        keeps_rendering=True,
    ),
    Codec(
        "compressed PLY",
        (".compressed.ply",),
        lambda start: (header := start.parse_ply()) is not None and is_compressed(header),
        lambda path, options: read_compressed_ply(path),
        keeps_rendering=True,
    ),
    Codec(
        "SPZ",
        (".spz",),
        lambda start: start.data.startswith((b"NGSP", b"\x1f\x8b")),
        read_spz,
        write_spz,
        has_quality=True,
    ),
    Codec(
        "OpenUSD",
        (".usda", ".usdz"),
        lambda start: looks_like_usd(start.data),  # before SOG, another ZIP
        lambda path, options: read_usd(path),
        write_usd,
        keeps_mode=False,
        keeps_origin=True,
        has_collider=True,
    ),
    Codec(
        "SOG",
        (".sog", META),
        lambda start: looks_like_sog(start.data),
        lambda path, options: read_sog(path),
        write_sog,
        keeps_rendering=True,
        has_quality=True,
    ),
    Codec(
        "streamed SOG",
        (LOD_META,),
        lambda start: looks_like_lod(start.data),
        lambda path, options: read_lod(path),
        command="clsplat lod",
        keeps_rendering=True,
    ),
    Codec(
        "GLB",
        (".glb",),
        lambda start: start.data.startswith(b"glTF"),
        lambda path, options: read_gltf(path),
        write_glb,
        keeps_rendering=True,
    ),
    Codec(
        "glTF",
        (".gltf",),
        lambda start: looks_like_gltf(start.data),
        lambda path, options: read_gltf(path),
    ),
    Codec(
        "ksplat",
        (".ksplat",),
        lambda start: looks_like_ksplat(start.data, start.size),
        lambda path, options: read_ksplat(path),
    ),
    Codec(
        "splat",
        (".splat",),
        lambda start: looks_like_splat(start.data, start.size),
        lambda path, options: read_splat(path),
        write_splat,
        keeps_mode=False,
        has_magic=False,
    ),
    Codec("point cloud", (".points.ply",), lambda start: False, None, write_points, is_model=False),
    Codec("CSV", (".csv",), lambda start: False, None, write_csv, is_model=False),
)


def endings(reads: bool = False) -> list[str]:
    """Return the file name endings of all formats that can be written, or with `reads`, of all that can be read."""
    return [end for codec in CODECS if (codec.read if reads else codec.write) for end in codec.endings]


def detect(path: Path) -> Codec | None:
    """Return the format of a file by its content, or None if no format matches.

    If a format has no magic number, the name of the file must match, too.
    Raises DataError if the file cannot be read, is empty, or is a failed download.
    """
    with open_file(path, "a model file") as file:
        start = FileStart(path, file.read(MAX_HEADER), file.seek(0, os.SEEK_END))
    named_codec = format_from_name(path)
    codec = next((c for c in CODECS if c.matches(start) and (c.has_magic or named_codec in (None, c))), None)
    if codec is None or not start.size:
        require_content(path, start.data)
    return codec


def format_from_name(path: Path) -> Codec | None:
    """Return the format with the longest ending that matches a file name, or None if none matches."""
    name = path.name.lower()
    pairs = [(end, codec) for codec in CODECS for end in codec.endings]
    matches = [(end, codec) for end, codec in pairs if name == end or (end.startswith(".") and name.endswith(end))]
    return max(matches, key=lambda pair: len(pair[0]))[1] if matches else None


def read(path: Path, options: ReadOptions | None = None) -> SplatFile:
    """Read a model file of any format.  Raises DataError if it is missing, damaged, or of an unknown format."""
    options = options or ReadOptions()
    path = model_file(path)
    codec = detect(path) or format_from_name(path)  # the reader for that file name reports what is wrong
    if codec is None:
        known_endings = ", ".join(endings(reads=True))
        raise DataError(f"{path}: unknown model format; expected one of {known_endings}")
    if codec.read is None:
        raise DataError(f"{path}: {codec.name} can be written but not read; convert the model it was created from")
    with np.errstate(all="ignore"):  # values that are not finite are handled below
        return handle_not_finite(path, clamp_limits(path, codec.read(path, options), options), options)


def writing_format(path: Path) -> Codec:
    """Return the format in which a file of this name is written.

    Raises ConfigError if there is none, and OutputError for an empty name.
    """
    if not path.name:
        raise OutputError(f"{path}: cannot be written (it has no file name); use the path of a file")
    codec = format_from_name(path)
    if codec is None or codec.write is None:
        remedy = f"is only written by `{codec.command}`" if codec and codec.command else "can be read but not written"
        fault = f"{codec.name} {remedy}" if codec else f"no format matches the name {quote(path.name)}"
        raise ConfigError(
            f"{shorten(str(path))}: {fault}; use a name that ends in {', '.join(endings())}; "
            "`clsplat convert` also writes one page, .html"
        )
    return codec


def write(path: Path, splats: SplatFile, options: WriteOptions | None = None) -> str:
    """Write a model file in the format that its name implies; warn about losses unless `options.quiet`.

    Returns the SHA-256 of the file; for a SOG folder, that of its meta.json.
    Raises ConfigError if the name implies no format that can be written, DataError for a model that the format cannot
    store, OutputError if the file cannot be written, and ValueError for a world filter that is not baked, since only a
    PLY can store it.
    """
    codec = writing_format(path)
    assert codec.write is not None
    if not codec.keeps_all and "filter_variance" in splats.parameters:
        raise ValueError(f"{path}: {codec.name} cannot store a world filter; call baked() first")
    if not codec.keeps_all:
        require_static(path, splats, codec.name)
    if not codec.keeps_all and (count := int(not_finite(splats.parameters).sum())):
        raise DataError(
            f"{path}: {count:,} Gaussians have values that are not finite, which {codec.name} cannot store; drop them "
            "with `clsplat convert`, or write a PLY"
        )
    options = options or WriteOptions()
    if not options.quiet:
        warn_about_losses(path, splats)
    if codec.keeps_rendering:
        check_rendering(path, splats.rendering)  # the reader would refuse invalid numbers
    return codec.write(path, splats, options)


def warn_about_losses(path: Path, splats: SplatFile) -> None:
    """Warn if the format of a file name cannot mark a mip model, or store the rendering settings or the origin."""
    codec = writing_format(path)
    if not codec.is_model:
        return
    if not codec.keeps_mode and splats.mode == "mip":
        LOG.warning(
            "%s: %s cannot mark a mip model, so viewers show it as plain 3DGS; PLY, SPZ, SOG, and GLB can",
            path,
            codec.name,
        )
    if not codec.keeps_rendering and (losses := _unusual_settings(splats)):
        LOG.warning("%s: %s does not store %s; PLY, SOG, and GLB do", path, codec.name, losses)
    if (origin := splats.rendering.get("origin")) and not (codec.keeps_rendering or codec.keeps_origin):
        LOG.warning(
            "%s: %s does not store the origin (%s) of the coordinates; PLY, SOG, GLB, and OpenUSD do",
            *(path, codec.name, ", ".join(f"{value:.15g}" for value in origin)),
        )


FACTOR = 10  # a near plane within this factor of the default needs no warning


def _unusual_settings(splats: SplatFile) -> str:
    """Describe the rendering settings that differ from the defaults for files without them."""
    near, default = splats.rendering.get("near"), default_near(splats.parameters["means"])
    defaults: dict[str, Any] = {} if near and default / FACTOR < near < default * FACTOR else {"near": near and default}
    variance = MIP_VARIANCE if splats.mode == "mip" else VARIANCE
    defaults |= {"screen_variance": variance, "background": None, "pixel_box": 0}
    values = {name: splats.rendering.get(name, value) for name, value in defaults.items()}
    return ", ".join(f"{name} = {value}" for name, value in values.items() if value != defaults[name])
