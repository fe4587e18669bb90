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


def save(found: Memory, file: Path) -> None:
    """Write memory to a file."""
    with file.open("wb") as content:
        for at, words in found.items():
            np.array([at, len(words)], np.uint64).tofile(content)
            words.tofile(content)


def load(file: Path) -> Memory:
    """Read what :func:`save` has written."""
    words, found, place = np.fromfile(file, np.uint64), {}, 0
    while place < len(words):
        at, count = int(words[place]), int(words[place + 1])
        found[at] = words[place + 2 : place + 2 + count]
        place += 2 + count
    return found


def different(one: Memory, other: Memory, *, numbers: bool = True) -> set[int]:
    """The addresses of the words that are not the same; without those that hold text of numbers, if need be.

    Such text is what a process read last about itself: its pid and times, and all behind them, which a
    digit more or less moves.
    """
    assert {at: len(words) for at, words in one.items()} == {at: len(words) for at, words in other.items()}
    found: dict[int, tuple[np.uint64, np.uint64]] = {}
    for at, words in one.items():
        found |= {
            at + 8 * int(word): (words[word], other[at][word]) for word in np.flatnonzero(words != other[at])
        }
    return {at for at, both in found.items() if numbers or not all(_of_numbers(word) for word in both)}


def _of_numbers(word: np.uint64) -> bool:
    """Whether a word is text of numbers: two digits at least, or small integers would count as such."""
    content = word.tobytes()
    digits = sum(byte in b"0123456789" for byte in content)
    return digits >= 2 and set(content) <= set(b"0123456789 \t\n\0")
