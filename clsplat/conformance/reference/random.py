"""Generate random words (Philox 4x32-10, Salmon et al. 2011) and normal random numbers (Box and Muller 1958)."""

import math

import numpy as np
from numpy.typing import NDArray

MASK = 0xFFFFFFFF


def philox(counter: tuple[int, int, int, int], key: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return four random 32-bit words from a counter and a key."""
    c0, c1, c2, c3 = counter
    k0, k1 = key
    for _ in range(10):
        first, second = 0xD2511F53 * c0, 0xCD9E8D57 * c2
        c0, c1, c2, c3 = (second >> 32) ^ c1 ^ k0, second & MASK, (first >> 32) ^ c3 ^ k1, first & MASK
        k0, k1 = (k0 + 0x9E3779B9) & MASK, (k1 + 0xBB67AE85) & MASK
    return c0, c1, c2, c3


def drop_mask(probability: float, seed: int, step: int, count: int) -> NDArray[np.bool_]:
    """Return a mask of the Gaussians that a step drops, [count], from a random word for each (Park et al. 2025)."""
    words = [philox((row, step, 2, 0), (seed, 0))[0] for row in range(count)]
    return np.array([word / 2**32 < probability for word in words])


def normal3(counter: tuple[int, int, int, int], key: tuple[int, int]) -> NDArray[np.float64]:
    """Return three random numbers with a standard normal distribution, [3]."""
    a, b, c, d = (((bits >> 8) + 1) / 2**24 for bits in philox(counter, key))
    radius, angle = math.sqrt(-2 * math.log(a)), 2 * math.pi * b
    third = math.sqrt(-2 * math.log(c)) * math.cos(2 * math.pi * d)
    return np.array([radius * math.cos(angle), radius * math.sin(angle), third])
