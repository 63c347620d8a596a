"""Fail a test that hangs, after some seconds."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def failing(message: str, seconds: int = 0) -> Iterator[None]:
    """Let an alarm raise an AssertionError in the block, after so many seconds or when one is set.

    Skips the test where a system has no alarms.
    """
    if not hasattr(signal, "SIGALRM"):
        pytest.skip("this system has no alarms")

    def ring(*_: object) -> None:
        raise AssertionError(message)

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)
