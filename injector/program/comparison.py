"""Comparing what a run of a program has put out with what one without a fault did."""

from __future__ import annotations

import hashlib
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ABSENT = "absent"
"""In the place of the digest of a file that is not there."""

COMPARATOR_S = 60.0
"""Longest wall time of a comparison."""

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


class UnsuitableProgramError(Exception):
    """The program cannot be struck as it is: one line that says why and what to do."""


@dataclass(frozen=True, slots=True)
class RunOutput:
    """What a run left: exit status (negative: the signal), and the digest of each file that is compared."""

    status: int
    digests: tuple[tuple[str, str], ...]

    def differs_from(self, golden: RunOutput) -> str:
        """What differs, in words; empty if nothing does."""
        words = [f"exit status {self.status}, not {golden.status}"] if self.status != golden.status else []
        pairs = zip(self.digests, golden.digests, strict=True)
        return ", ".join([*words, *(name for (name, ours), (_, theirs) in pairs if ours != theirs)])


@dataclass(frozen=True, slots=True)
class OutputDifference:
    """What a run has otherwise than one without a fault, in ``words``, and by how much."""

    words: str
    within_tolerance: bool = False
    deviation: float | None = None

    @property
    def matters(self) -> bool:
        """Whether there is one that the tolerance does not allow."""
        return bool(self.words) and not self.within_tolerance


def compared_by(comparator: Sequence[str], folder: str, golden: Path, run: Path) -> bool:
    """Whether a comparator, run in ``folder``, calls the outputs in two others the same.

    It does so by exit status 0; 1: it does not.

    :raises UnsuitableProgramError: if it ends otherwise, or not within a minute.
    """
    try:
        ended = subprocess.run(  # noqa: S603 - the user's own
            [*comparator, str(golden), str(run)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=folder,
            timeout=COMPARATOR_S,
            check=False,
        ).returncode
    except (OSError, subprocess.TimeoutExpired) as error:
        message = f"--comparator {comparator[0]}: {error}"
        raise UnsuitableProgramError(message) from error
    if ended not in (0, 1):
        message = f"--comparator {comparator[0]}: exit status {ended}, expected 0 (the same) or 1 (not)"
        raise UnsuitableProgramError(message)
    return ended == 0


def deviation_of(run: Path, golden: Path) -> float | None:
    """The largest relative deviation of a number in a text; None if anything else differs.

    That of two numbers is the difference by the larger of their magnitudes.
    """
    try:
        ours, theirs = run.read_text(), golden.read_text()
    except (OSError, UnicodeDecodeError):
        return None
    if _NUMBER.split(ours) != _NUMBER.split(theirs):
        return None
    pairs = zip(map(float, _NUMBER.findall(ours)), map(float, _NUMBER.findall(theirs)), strict=True)
    apart = (abs(one - other) / max(abs(one), abs(other)) for one, other in pairs if one != other)
    return max(apart, default=0.0)


def digest_of(file: Path) -> str:
    """The digest of a file's content, or that it is not there."""
    try:
        with file.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    except OSError:
        return ABSENT
