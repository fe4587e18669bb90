"""What lies in a process's memory, to be compared word by word."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Memory = dict[int, NDArray[np.uint64]]


def memory(pid: int, *, stack: bool = True) -> Memory:
    """The private memory that a process can write, by address; without its stack, if need be."""
    found = {}
    with Path(f"/proc/{pid}/mem").open("rb", 0) as content:
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines():
            extent, permissions, *_, name = line.split()
            if permissions == "rw-p" and (stack or name != "[stack]"):
                start, end = (int(bound, 16) for bound in extent.split("-"))
                content.seek(start)
                found[start] = np.frombuffer(content.read(end - start), np.uint64)
    return found


def different(one: Memory, other: Memory) -> set[int]:
    """The addresses of the words that are not the same."""
    assert {at: len(words) for at, words in one.items()} == {at: len(words) for at, words in other.items()}
    return {at + 8 * int(word) for at, words in one.items() for word in np.flatnonzero(words != other[at])}
