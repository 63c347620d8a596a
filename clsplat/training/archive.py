"""Write and read named arrays and metadata in an .npz file, with a SHA-256 of each to detect damage.

    NAME.npy          a float32 array; the SHA-256 of all bytes of the member is in the metadata
    meta.npy          JSON metadata, with the hashes of arrays by name under the key `sha256`
    meta_sha256.npy   the SHA-256 of meta.npy

NumPy can read the arrays.  Any changed byte is detected, except in ZIP fields that are not used, such as timestamps.
"""

import errno
import hashlib
import io
import json
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError, OutputError, one_line, shorten
from clsplat.core.reading import open_regular

META, META_DIGEST, DIGESTS = "meta", "meta_sha256", "sha256"
DAMAGE_ERRNOS = {None, errno.EINVAL, errno.EISDIR, errno.EIO}  # a seek before the start, a folder, a bad sector
Metadata = dict[str, Any]
Arrays = dict[str, NDArray[np.float32]]


def write(file: BinaryIO, metadata: Metadata, arrays: Iterable[tuple[str, NDArray[np.float32]]]) -> None:
    """Write arrays, and metadata as JSON.  Only one array is in memory at a time."""
    with zipfile.ZipFile(file, "w") as archive:
        digests = {name: _add(archive, name, array) for name, array in arrays}
        digest = _add(archive, META, np.array(json.dumps({**metadata, DIGESTS: digests})))
        _add(archive, META_DIGEST, np.array(digest))


def read(path: Path) -> tuple[Metadata, Arrays]:
    """Read metadata and arrays.

    Raises DataError if the file is damaged; the message gives only the reason, not the path.  Raises OutputError or
    MemoryError if the system cannot read the file; the file itself may then be intact.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            _validate_members(archive, path.stat().st_size)
            metadata = _read_metadata(archive)
            digests = metadata.pop(DIGESTS)
            expected_names = sorted(f"{name}.npy" for name in (*digests, META, META_DIGEST))
            if sorted(archive.namelist()) != expected_names:
                raise DataError("its list of contents has changed")
            return metadata, {name: _parse_array(_read(archive, name, digest)) for name, digest in digests.items()}
    except MemoryError:
        raise
    except Exception as error:  # zipfile and NumPy raise many types for damaged bytes, such as EOFError and TokenError
        if isinstance(error, OSError) and error.errno not in DAMAGE_ERRNOS:
            raise OutputError(f"{path}: cannot be read ({error.strerror}); check the disk and permissions") from error
        if isinstance(error, DataError):
            raise
        is_empty = isinstance(error, zipfile.BadZipFile) and path.stat().st_size == 0
        reason = shorten(
            (error.strerror if isinstance(error, OSError) else "") or one_line(error) or type(error).__name__
        )
        if isinstance(error, OSError) and error.errno == errno.EIO:
            raise DataError(f"it cannot be read from disk: {error.strerror}") from error
        raise DataError("it is empty" if is_empty else f"it cannot be parsed ({reason})") from error


def split(arrays: Mapping[str, NDArray[np.float32]], folder: str) -> tuple[Arrays, Arrays]:
    """Return the arrays whose names start with `folder`, without that prefix, and the remaining arrays."""
    members = {name.removeprefix(folder): array for name, array in arrays.items() if name.startswith(folder)}
    return members, {name: array for name, array in arrays.items() if not name.startswith(folder)}


def _add(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> str:
    """Write an array in the .npy format; return the SHA-256 of its bytes."""
    header, values = io.BytesIO(), np.asarray(array, order="C")
    np.lib.format.write_array_header_1_0(header, np.lib.format.header_data_from_array_1_0(values))
    digest = hashlib.sha256()
    with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
        for chunk in (memoryview(header.getvalue()), values.reshape(-1).view(np.uint8).data):
            digest.update(chunk)
            member.write(chunk)
    return digest.hexdigest()


def _validate_members(archive: zipfile.ZipFile, size: int) -> None:
    """Raise DataError if members declare more bytes than the file has, or are compressed or encrypted."""
    members = archive.infolist()
    if any(member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1 for member in members):
        raise DataError("its contents are compressed or encrypted")
    if sum(max(member.file_size, member.compress_size) for member in members) > size:
        raise DataError(f"it declares more bytes than the file has ({size})")


def _read_metadata(archive: zipfile.ZipFile) -> Metadata:
    """Read the metadata and check it against its SHA-256."""
    data = archive.read(f"{META}.npy")
    if hashlib.sha256(data).hexdigest() != str(_parse_array(archive.read(f"{META_DIGEST}.npy"))):
        raise DataError("its metadata does not match its checksum")
    metadata = json.loads(str(_parse_array(data)))
    if not isinstance(metadata, dict) or DIGESTS not in metadata:
        raise DataError("its checksums are missing")
    return metadata


def _read(archive: zipfile.ZipFile, name: str, digest: str) -> bytes:
    data = archive.read(f"{name}.npy")
    if hashlib.sha256(data).hexdigest() != digest:
        raise DataError(f"{name} does not match its checksum")
    return data


def _parse_array(data: bytes) -> NDArray[Any]:
    """Return the array in the bytes of an .npy file, as a view, because a damaged header may declare a huge shape."""
    stream = io.BytesIO(data)
    np.lib.format.read_magic(stream)
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream, max_header_size=1000)
    if is_fortran or dtype.hasobject:
        raise DataError("an array does not have the layout of a checkpoint")
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape)
