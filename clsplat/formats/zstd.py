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


class Frame:
    """A frame that holds `size` bytes, read a part at a time.  Raises DataError for another size or a bad frame."""

    def __init__(self, path: Path, data: bytes, size: int) -> None:
        module, builtin = _module()
        self.path, self.size, self.left, self.error = path, size, size, module.ZstdError
        self.stream = _stream(module, builtin, data)

    def read(self, size: int) -> bytes:
        """Return the next bytes, so many."""
        found = self._some(size)
        self.left -= size
        if len(found) != size or (not self.left and self._some(1)):
            end = "ends early" if len(found) != size else "goes on"
            raise DataError(f"{self.path}: a stream {end}; expected {self.size} bytes: copy or export the file again")
        return found

    def _some(self, size: int) -> bytes:
        try:
            found: bytes = self.stream.read(size)
        except (self.error, EOFError) as error:
            raise DataError(f"{self.path}: a stream is damaged ({error}); copy or export the file again") from error
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
