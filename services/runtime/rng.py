"""Random numbers: every draw comes from a counter-based generator keyed by seed and purpose."""

from __future__ import annotations

import hashlib

import numpy as np


def generator(seed: int, purpose: str, *counters: int) -> np.random.Generator:
    """A Philox generator of its own for (``seed``, ``purpose``, ``counters``).

    Two purposes never share a stream, so drawing more for one changes nothing for another.
    """
    text = ":".join([str(seed), purpose, *map(str, counters)])
    key = int.from_bytes(hashlib.blake2b(text.encode(), digest_size=16).digest(), "little")
    return np.random.Generator(np.random.Philox(key=key))


def native_seed(seed: int, purpose: str, *counters: int) -> int:
    """A seed in [1, 2^31) for libraries with a generator of their own (OMPL)."""
    return int(generator(seed, purpose, *counters).integers(1, 2**31))
