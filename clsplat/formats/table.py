"""The table of formats.  A file is told apart by its content; its name decides what is written."""

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clsplat.core.errors import ConfigError, DataError, OutputError, quote, shorten
from clsplat.core.reading import open_file
from clsplat.formats.compressed_ply import is_compressed, read_compressed_ply, write_compressed_ply
from clsplat.formats.gltf_usd import read_glb, write_glb, write_usda
from clsplat.formats.ply import MAX_HEADER, PlyHeader, checked_numbers, parse_ply_header, read_ply, write_ply
from clsplat.formats.sog import META, looks_like_sog, read_sog, with_images, write_sog
from clsplat.formats.splat import looks_like_ksplat, looks_like_splat, read_ksplat, read_splat, write_splat
from clsplat.formats.splats import (
    MIP_VARIANCE,
    NEAR,
    VARIANCE,
    Reading,
    SplatFile,
    Writing,
    not_finite,
    require_still,
    settled,
)
from clsplat.formats.spz import read_spz, write_spz
from clsplat.formats.streamed_sog import LOD_META, files_of_lod, looks_like_lod, read_lod

# What the table of formats holds for each: words, and functions that tell, read and write it.


@dataclass(frozen=True)
class Start:
    """How a file begins."""

    path: Path
    data: bytes  # at most MAX_HEADER
    size: int  # bytes of the file

    def ply(self) -> PlyHeader | None:
        """The header, where it is a PLY file that can be read."""
        if not self.data.startswith(b"ply"):
            return None
        try:
            return parse_ply_header(self.path, self.data)
        except DataError:  # its reader says what is wrong
            return None


@dataclass(frozen=True)
class Codec:
    """One format."""

    name: str
    endings: tuple[str, ...]  # of names of files; the first is the usual one
    reads: str  # in words; "" where there is no reader
    writes: str  # in words; "" where there is no writer, "by …" where a command alone writes it
    loses: str  # in words: what writing changes
    is_one: Callable[[Start], bool] = lambda start: False
    read: Callable[[Path, Reading], SplatFile] | None = None
    write: Callable[[Path, SplatFile, Writing], str] | None = None  # returns the SHA-256 of the file
    keeps_filter: bool = False  # filter_3D
    keeps_motion: bool = False
    keeps_mode: bool = True  # the mark of a mip model
    keeps_numbers: bool = False  # of the rasterizer
    keeps_nan: bool = False
    has_quality: bool = False  # writing heeds Writing.quality
    has_axes: bool = False  # reading and writing heed axes, of which nothing in the file tells
    has_bits: bool = False  # writing heeds Writing.sh_bits and Writing.spz_version


# Where a model lies, and which files belong to it.


def located(path: Path) -> Path:
    """Return the file of a model: of a folder with a meta.json, or a lod-meta.json, that one."""
    places = (path / name for name in (META, LOD_META)) if path.is_dir() else ()
    return next(filter(Path.is_file, places), path)


def files_of(place: Path) -> list[Path]:
    """Return all files of a model's file: of the JSON of SOG, or of levels, those that it names, too."""
    return {META: with_images, LOD_META: files_of_lod}.get(place.name, lambda one: [one])(place)


def bytes_of(path: Path) -> int:
    """Return the size of a model: of a folder of SOG, or of levels, that of all files that its JSON names.

    Raises DataError where one is missing.
    """
    place = located(path)
    try:
        return sum(one.stat().st_size for one in files_of(place))
    except OSError as error:
        missing = "" if error.filename == str(place) else f"names {quote(error.filename)}, which "
        raise DataError(f"{place}: {missing}cannot be read ({error.strerror}); copy or export it again") from error


LOG = logging.getLogger("clsplat")


CODECS = (
    Codec(
        "PLY",
        (".ply",),
        "any order and number types, little or big endian, discs of 2DGS, other elements around the vertices",
        "the order of 3DGS",
        "nothing",
        lambda start: (header := start.ply()) is not None and "f_dc_0" in (header.dtype.names or ()),
        lambda path, options: read_ply(path),
        lambda path, splats, options: write_ply(path, splats.parameters, splats.rendering),
        keeps_filter=True,
        keeps_motion=True,
        keeps_numbers=True,
        keeps_nan=True,
    ),
    Codec(
        "compressed PLY",
        (".compressed.ply",),
        "with and without ranges of colors",
        "chunks of 256 along a Morton curve",
        "position and scale to 1/2047 of a chunk's range, quaternions to 10 bits, colors and opacity to 8, "
        "harmonics to 1/32, order",
        lambda start: (header := start.ply()) is not None and is_compressed(header),
        lambda path, options: read_compressed_ply(path),
        write_compressed_ply,
        keeps_numbers=True,
    ),
    Codec(
        "SPZ",
        (".spz",),
        "versions 1 to 4",
        "version 3, or 4 with the extra `spz`, in groups of like precision, each along a Morton curve",
        "rounds: position to 2^-12 or half of the smallest deviation, more where the Gaussian weighs little, "
        "log scale to 1/16, quaternions to 7 bits, opacity to 8, colors and harmonics to 8 or fewer by the weight of "
        "the Gaussian; "
        "cuts: harmonics beyond 1, colors beyond -0.44 and 1.44, scales beyond 4.5e-5 and 379; order",
        lambda start: start.data.startswith((b"NGSP", b"\x1f\x8b")),
        read_spz,
        write_spz,
        has_quality=True,
        has_axes=True,
        has_bits=True,
    ),
    Codec(
        "SOG",
        (".sog", META),
        "versions 1 and 2, bundled or as a folder with meta.json",
        "version 2, bundled, or as the files beside a meta.json, along a Morton curve",
        "position to 16 bits of a logarithm, or a quarter of a Gaussian's size, more where it weighs little, "
        "quaternions to 6 bits, scales and colors to 256 values or to steps of 10 % and 0.014, opacity to 8 bits, "
        "harmonics to a palette, names of axes, order",
        lambda start: looks_like_sog(start.data),
        lambda path, options: read_sog(path),
        write_sog,
        keeps_numbers=True,
        has_quality=True,
    ),
    Codec(
        "streamed SOG",
        (LOD_META,),
        "version 1: the finest level, and the environment",
        "by `clsplat lod`: levels of detail, along a Morton curve in each leaf of a tree",
        "as SOG",
        lambda start: looks_like_lod(start.data),
        lambda path, options: read_lod(path),
        keeps_numbers=True,
    ),
    Codec(
        "GLB",
        (".glb",),
        "KHR_gaussian_splatting, numbers of every kind, nodes that are moved, turned or scaled",
        "KHR_gaussian_splatting, 32-bit floats, and colors for other viewers",
        "digits of large logits: opacities and scales are stored, not their logits and logarithms",
        lambda start: start.data.startswith(b"glTF"),
        lambda path, options: read_glb(path),
        write_glb,
        keeps_numbers=True,
    ),
    Codec(
        "OpenUSD",
        (".usda",),
        "",
        "ParticleField3DGaussianSplat, as text",
        "digits of large logits",
        lambda start: start.data.startswith(b"#usda"),
        None,
        write_usda,
        keeps_mode=False,
    ),
    Codec(
        "ksplat",
        (".ksplat",),
        "versions 0.1 and later, levels 0 to 2, SH degree 0 to 2",
        "",
        "",
        lambda start: looks_like_ksplat(start.data, start.size),
        lambda path, options: read_ksplat(path),
    ),
    Codec(
        "splat",
        (".splat",),
        "all",
        "the largest and most opaque first",
        "harmonics, colors outside [0, 1], order; colors and opacity are in 8 bits, quaternions in 8",
        lambda start: looks_like_splat(start.data, start.size),
        lambda path, options: read_splat(path),
        write_splat,
        keeps_mode=False,
    ),
)


def endings(reads: bool = False) -> list[str]:
    """Return the endings of names that are written, or of those that are read."""
    return [end for codec in CODECS if (codec.read if reads else codec.write) for end in codec.endings]


def detect(path: Path) -> Codec | None:
    """Return the format of a file by its content, or None.  Raises DataError when it cannot be read."""
    with open_file(path, "a model file") as file:
        start = Start(path, file.read(MAX_HEADER), file.seek(0, os.SEEK_END))
    return next((codec for codec in CODECS if codec.is_one(start)), None)


def named(path: Path) -> Codec | None:
    """Return the format that a name stands for, or None; the longest ending counts."""
    name = path.name.lower()
    fits = [(end, codec) for codec in CODECS for end in codec.endings if name == end or name.endswith(end)]
    found = [(len(end), codec) for end, codec in fits if end.startswith(".") or name == end]
    return max(found, key=lambda one: one[0])[1] if found else None


def read(path: Path, options: Reading | None = None) -> SplatFile:
    """Read a model file of any format.  Raises DataError when it is missing, damaged or of no known format."""
    options = options or Reading()
    path = located(path)
    codec = detect(path) or named(path)  # the reader of a format that the name stands for says what is wrong
    if codec is None:
        known = ", ".join(endings(reads=True))
        raise DataError(f"{path}: no model file of a known format; expected one of {known}: export it again")
    if codec.read is None:
        raise DataError(f"{path}: {codec.name} is written, not read; convert the model that it was made from")
    with np.errstate(all="ignore"):  # what is not finite is refused, dropped or kept
        return settled(path, codec.read(path, options), options)


def for_writing(path: Path) -> Codec:
    """Return the format that a name stands for.

    Raises ConfigError where none is written, OutputError for an empty name.
    """
    if not path.name:
        raise OutputError(f"{path}: cannot be written (it has no name); expected the path of a file")
    codec = named(path)
    if codec is None or codec.write is None:
        how = "written " + codec.writes.partition(":")[0] if codec and codec.writes else "read, not written"
        what = f"{codec.name} is {how}" if codec else f"no format has the name {quote(path.name)}"
        raise ConfigError(f"{shorten(str(path))}: {what}; expected a name that ends in {', '.join(endings())}")
    return codec


def write(path: Path, splats: SplatFile, options: Writing | None = None) -> str:
    """Write a model file in the format that its name stands for; `tell_losses`, unless the options say not to.

    Returns the SHA-256 of what was written, of a folder of SOG that of its meta.json.
    Raises ConfigError for a name of no format, DataError for a model that the format cannot hold, OutputError where
    the file cannot be written, and ValueError for a world filter that is not part of the scales and opacities already:
    a PLY alone holds one.
    """
    codec = for_writing(path)
    assert codec.write is not None
    if not codec.keeps_filter and "filter_variance" in splats.parameters:
        raise ValueError(f"{path}: {codec.name} holds no world filter; call baked() first")
    if not codec.keeps_motion:
        require_still(path, splats, codec.name)
    if not codec.keeps_nan and (bad := int(not_finite(splats.parameters).sum())):
        raise DataError(
            f"{path}: {bad:,} Gaussians hold values that are not finite, which {codec.name} cannot hold; drop them, "
            "or write a PLY"
        )
    options = options or Writing()
    if not options.quiet:
        tell_losses(path, splats)
    if codec.keeps_numbers:
        checked_numbers(path, splats.rendering)  # its reader would refuse them
    return codec.write(path, splats, options)


def tell_losses(path: Path, splats: SplatFile) -> None:
    """Log in a line what the format that a name stands for does not hold of a mark and of numbers."""
    codec = for_writing(path)
    if not codec.keeps_mode and splats.mode == "mip":
        LOG.warning(
            "%s: %s has no mark for a mip model, which viewers then show as plain 3DGS; PLY, SPZ, SOG and GLB have one",
            path,
            codec.name,
        )
    if not codec.keeps_numbers and (lost := _unusual(splats)):
        LOG.warning("%s: %s does not keep %s; PLY, SOG and GLB do", path, codec.name, lost)


def _unusual(splats: SplatFile) -> str:
    """The numbers of the renderer that a reader would not take for a file without them, in words."""
    usual = {"near": NEAR, "screen_variance": MIP_VARIANCE if splats.mode == "mip" else VARIANCE, "background": None}
    usual["pixel_box"] = 0
    given = {name: splats.rendering.get(name, value) for name, value in usual.items()}
    return ", ".join(f"{name} = {value}" for name, value in given.items() if value != usual[name])
