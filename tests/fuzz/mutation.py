"""Damage to valid files: flips, cuts, copies, splices, and numbers and words that have been fatal to programs.

CLSPLAT_FUZZ is the number of examples of each test; without it there are few.  An example is given by its number: the
same damage every time.
"""

import copy
import json
import os
import re
import struct
from collections.abc import Callable, Sequence
from random import Random
from typing import Any

import pytest

EXAMPLES = int(os.environ.get("CLSPLAT_FUZZ", "0"))
MAX_SIZE = 1 << 16  # bytes of a damaged file
SHOWN = 400  # characters of an example
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
KINDS: list[Any] = [None, True, "", "x", [], {}, [[]], {"x": 1}]  # of JSON
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
Drawn = Callable[[Random], Any]


def damaged(seeds: Sequence[bytes], words: Sequence[str] = ()) -> Callable[[Random], bytes]:
    """Draw one of the valid files with one to six changes; `words` are those of the format."""
    known = [*BYTES, *(word.encode() for word in (*WORDS, *words))]

    def draw(random: Random) -> bytes:
        data = random.choice(seeds)
        for _ in range(random.randint(1, 6)):
            change = random.choice(CHANGES)
            data = change(random, data, int(random.random() * len(data)), known, seeds)[:MAX_SIZE]
        return data

    return draw


def rearranged_json(trees: Sequence[Any]) -> Callable[[Random], bytes]:
    """Draw one of the valid trees of JSON with one to three parts exchanged: it stays JSON, of another shape."""

    def draw(random: Random) -> bytes:
        tree = copy.deepcopy(random.choice(trees))
        for _ in range(random.randint(1, 3)):
            held, key = _place(random, tree)
            held[key] = random.choice(PARTS)(random, held[key], tree)
        return json.dumps(tree).encode()[:MAX_SIZE]

    return draw


def _place(random: Random, tree: Any) -> tuple[Any, Any]:
    """A list or mapping of a tree, and the key of one of its parts: half of them near the root."""
    while True:
        key = random.choice(list(tree)) if isinstance(tree, dict) else random.randrange(len(tree))
        if not isinstance(tree[key], dict | list) or not tree[key] or random.random() < 0.5:
            return tree, key
        tree = tree[key]


def _other_kind(random: Random, part: Any, tree: Any) -> Any:
    return random.choice([*KINDS, *WHOLE, *REAL])


def _emptied(random: Random, part: Any, tree: Any) -> Any:
    return type(part)()


def _doubled(random: Random, part: Any, tree: Any) -> Any:
    """A list with an element more than once."""
    return part + [random.choice(part)] * random.choice([1, 2, 50]) if isinstance(part, list) and part else [part] * 2


def _elsewhere(random: Random, part: Any, tree: Any) -> Any:
    """What stands in another place."""
    held, key = _place(random, tree)
    return copy.deepcopy(held[key])


PARTS = [_other_kind, _emptied, _doubled, _elsewhere]


def one_of(values: Sequence[Any]) -> Drawn:
    """Draw one of some values."""
    return lambda random: random.choice(values)


def _flip(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + bytes([data[at] ^ (1 << random.randint(0, 7))]) + data[at + 1 :] if data else data


def _byte(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + bytes([random.randint(0, 255)]) + data[at + 1 :]


def _cut(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at]


def _remove(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + data[at + random.randint(1, 40) :]


def _repeat(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + data[at : at + random.randint(1, 60)] * random.choice([2, 3, 50]) + data[at:]


def _insert(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    return data[:at] + random.choice(known) + data[at:]


def _overwrite(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    word = random.choice(known)
    return data[:at] + word + data[at + len(word) :]


def _splice(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    other = random.choice(seeds)
    return data[:at] + other[int(random.random() * len(other)) :]


def _number(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    """Replace a number in text by a word."""
    actual = NUMBER.search(data, at) or NUMBER.search(data)
    return data[: actual.start()] + random.choice(known) + data[actual.end() :] if actual else data


def _word(random: Random, data: bytes, at: int, known: Sequence[bytes], seeds: Sequence[bytes]) -> bytes:
    """Replace a word, or what stands in quotes, by another."""
    result = re.compile(rb'"[^"]*"|\w+').search(data, at)
    return data[: result.start()] + random.choice(known) + data[result.end() :] if result else data


CHANGES = [_flip, _byte, _cut, _remove, _repeat, _insert, _overwrite, _splice, _number, _number, _word]


def fuzzed(examples: int = 60, **drawn: Drawn) -> Callable[[Callable[..., None]], Callable[[], None]]:
    """Give a test examples, each drawn from its number alone; a failure tells the number."""

    def repeated(test: Callable[..., None]) -> Callable[[], None]:
        def run() -> None:
            for number in range(EXAMPLES or examples):
                random = Random(number)
                values = {name: draw(random) for name, draw in drawn.items()}
                try:
                    test(**values)
                except Exception as error:
                    pytest.fail(f"example {number}: {repr(error)[:SHOWN]} of {str(values)[:SHOWN]}", pytrace=False)

        return run

    return repeated
