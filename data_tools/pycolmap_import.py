"""Import pycolmap: when it is needed, and with the signals that it takes given back."""

from types import ModuleType

from clsplat.errors import ConfigError
from clsplat.signals import stopping_on_signals


def require_pycolmap() -> ModuleType:
    """Return pycolmap.  Raises ConfigError where it is not installed.

    Its import takes SIGTERM, to end the process with a dump, and for any exception says that pycolmap is broken: so
    signals wait for its end, where they get their handlers back.
    """
    signals: list[None] = []
    try:
        with stopping_on_signals(lambda: signals.append(None)):
            import pycolmap
    except ImportError as error:
        raise ConfigError("placing photographs needs pycolmap: pip install 'pycolmap>=4,<5'") from error
    if signals:
        raise KeyboardInterrupt
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)  # what ends a step is raised too
    return pycolmap
