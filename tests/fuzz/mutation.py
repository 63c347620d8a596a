"""Damage to valid files: flips, cuts, copies, splices, and numbers and words that have been fatal to programs.

CLSPLAT_FUZZ is the number of examples of each test; without it there are few, and always the same.
"""

import os
import re
import struct
from collections.abc import Callable, Sequence
from typing import Any

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

EXAMPLES = int(os.environ.get("CLSPLAT_FUZZ", "0"))
MAX_SIZE = 1 << 16  # bytes of a damaged file
WHOLE = [0, 1, 2, 127, 255, 2**15, 2**16, 2**20 + 1, *(2**n + d for n in (31, 32, 53, 63, 64) for d in (-1, 0)), 10**20]
REAL = [float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e308, -1e308, 1e39, 1e15, 5e-324, -1.0]
WORDS = [
    *(str(sign * number) for number in WHOLE for sign in (1, -1)),
    *(repr(number) for number in REAL),
    *("1e999", "NaN", "Infinity", ".nan", ".inf", "0x" + "f" * 5000, "9" * 400, "9" * 5000, "0." + "1" * 5000, "1_0"),
    *("\u00b2", "\u0663", "", " ", "null", "true", "None", "~", '"x"', '["X"]', '{"X": 1}', "x" * 6000),
    *("[" * 3000, "{" * 3000, "\0", "\n", "\r\n", "\t", "\\ud800", "\ufeff", "../x", "/etc/passwd", "\x1b[31m", "%s"),
]
BYTES = [
    *(struct.pack("<Q", number % 2**64) for number in WHOLE),
    *(struct.pack("<I", number % 2**32) for number in WHOLE),
    *(struct.pack(">I", number % 2**32) for number in WHOLE),
    *(struct.pack("<H", number % 2**16) for number in WHOLE),
    *(struct.pack("<d", number) for number in REAL),
    *(struct.pack("<f", number) for number in REAL if abs(number) < 1e38),
    *(b"\xff", b"\0" * 8, b"\x80", b"\xed\xa0\x80", b"\xff\xfe", b"PK\3\4"),
]
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
share = st.floats(0, 1, exclude_max=True)  # of the length: a place


@st.composite
def damaged(draw: st.DrawFn, seeds: Sequence[bytes], words: Sequence[str] = ()) -> bytes:
    """Draw one of the valid files with one to six changes; `words` are those of the format."""
    data = draw(st.sampled_from(list(seeds)))
    known = [*BYTES, *(word.encode() for word in (*WORDS, *words))]
    for _ in range(draw(st.integers(1, 6))):
        kind = draw(st.sampled_from(CHANGES))
        at = int(draw(share) * len(data))
        data = kind(draw, data, at, known, seeds)[:MAX_SIZE]
    return data


def _flip(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + bytes([data[at] ^ (1 << draw(st.integers(0, 7)))]) + data[at + 1 :] if data else data


def _byte(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]


def _cut(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at]


def _remove(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + data[at + draw(st.integers(1, 40)) :]


def _repeat(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + data[at : at + draw(st.integers(1, 60))] * draw(st.sampled_from([2, 3, 50])) + data[at:]


def _insert(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + draw(st.sampled_from(known)) + data[at:]


def _overwrite(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    word = draw(st.sampled_from(known))
    return data[:at] + word + data[at + len(word) :]


def _splice(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    other = draw(st.sampled_from(list(seeds)))
    return data[:at] + other[int(draw(share) * len(other)) :]


def _number(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    """Replace a number in text by a word."""
    found = NUMBER.search(data, at) or NUMBER.search(data)
    return data[: found.start()] + draw(st.sampled_from(known)) + data[found.end() :] if found else data


def _word(draw: st.DrawFn, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    """Replace a word, or what stands in quotes, by another."""
    found = re.compile(rb'"[^"]*"|\w+').search(data, at)
    return data[: found.start()] + draw(st.sampled_from(known)) + data[found.end() :] if found else data


CHANGES = [_flip, _byte, _cut, _remove, _repeat, _insert, _overwrite, _splice, _number, _number, _word]


def fuzzed(
    examples: int = 60, **strategies: st.SearchStrategy[Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a test damaged files: `examples` that are always the same, or CLSPLAT_FUZZ others.

    Of those that fail hypothesis keeps the seeds.
    """
    chosen = settings(
        max_examples=EXAMPLES or examples,
        derandomize=not EXAMPLES,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        print_blob=True,
        phases=[Phase.reuse, Phase.generate] if EXAMPLES else settings.default.phases,  # shrinking takes minutes
    )
    return lambda test: chosen(given(**strategies)(test))
