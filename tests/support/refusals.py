"""Refusals of bad input: a DataError of one line, quickly and with little memory."""

import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import pytest

from clsplat.core.errors import DataError


def refusal(read: Callable[..., Any], *args: Any) -> str:
    """Return the message with which `read(*args)` refuses."""
    tracemalloc.start()
    start = time.perf_counter()
    try:
        with pytest.raises(DataError) as caught:
            read(*args)
        seconds, peak = time.perf_counter() - start, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert "\n" not in message
    assert seconds < 2
    assert peak < 1 << 24, "more than any file of these tests needs"
    return message
