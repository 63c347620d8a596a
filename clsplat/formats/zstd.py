"""Zstandard, of Python from 3.14 on, else of the package zstandard, which is an extra."""

import io
from pathlib import Path
from types import ModuleType
from typing import Any

from clsplat.errors import ConfigError, DataError

LEVEL = 12  # as SPZ's library has
MAX_WINDOW = 27  # log2 of bytes: what a stream may ask the decoder to hold


def compress(data: bytes) -> bytes:
    """Return one frame.  Raises ConfigError where there is no Zstandard."""
    module, builtin = _module()
    packed: bytes = module.compress(data, LEVEL) if builtin else module.ZstdCompressor(LEVEL).compress(data)
    return packed


def decompress(path: Path, data: bytes, size: int) -> bytes:
    """Return the `size` bytes of a frame; nothing larger is made.  Raises DataError for another size or a bad frame."""
    module, builtin = _module()
    try:
        found: bytes = _stream(module, builtin, data).read(size + 1)
    except (module.ZstdError, EOFError) as error:
        raise DataError(f"{path}: a stream is damaged ({error}); copy or export the file again") from error
    if len(found) != size:
        raise DataError(f"{path}: a stream holds {len(found)} bytes or more; expected {size}: export the file again")
    return found


def _stream(module: ModuleType, builtin: bool, data: bytes) -> Any:
    if builtin:
        limit = {module.DecompressionParameter.window_log_max: MAX_WINDOW}
        return module.ZstdFile(io.BytesIO(data), options=limit)
    return module.ZstdDecompressor(max_window_size=1 << MAX_WINDOW).stream_reader(data)


def _module() -> tuple[ModuleType, bool]:
    """The module, and whether it is that of Python itself."""
    try:
        from compression import zstd

        return zstd, True
    except ImportError:
        pass
    try:
        import zstandard

        return zstandard, False
    except ImportError as error:
        raise ConfigError(
            "SPZ of version 4 needs Zstandard; install it: pip install 'clsplat[spz]', or use version 3"
        ) from error
