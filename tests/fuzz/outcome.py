"""Every reader either returns or refuses its input in one line."""

import signal
from collections.abc import Callable
from typing import Any, TypeVar

from clsplat.core.errors import MESSAGE_LIMIT, ConfigError, DataError

SECONDS = 60  # of a reader that hangs; a small file takes milliseconds
Result = TypeVar("Result")


def outcome(read: Callable[..., Result], *arguments: Any) -> Result | None:
    """Return what `read` returns, or None where it refuses; any other exception fails the test."""
    signal.alarm(SECONDS)
    try:
        return read(*arguments)
    except (DataError, ConfigError) as error:
        message = str(error)
    finally:
        signal.alarm(0)
    assert 0 < len(message) <= MESSAGE_LIMIT, f"{len(message)} characters"
    assert "\n" not in message, message
    return None
