"""Schemes that are not installed: in a package's folder, or a program that answers scores of checks."""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Self

from detector.errors import DetectionInputError
from detector.schemes.base import LIMIT, Floats, Scheme
from detector.schemes.registry import KIND, scheme
from services.system import plug_ins
from services.system.lifeline import die_with_parent

ANSWER_S = 60.0
"""Wall time within which a program answers a check."""

LONGEST_ANSWER = 1000
"""Bytes of an answer beyond which it is none."""

FAREWELL_S = 1.0
"""Wall time that a program has at the end of a flight to end by itself."""


class OutsideSchemeError(DetectionInputError):
    """A scheme from outside that cannot be used: one line that names it."""


def scheme_in(folder: Path) -> tuple[str, type[Scheme]]:
    """The name and class of the one scheme that a package's folder declares; its code is imported.

    :raises OutsideSchemeError: if its pyproject.toml declares none, or several.
    :raises UnknownSchemeError: if it cannot be imported, or is no scheme.
    """
    file = folder / "pyproject.toml"
    try:
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        points = dict(project["entry-points"][f"zenfi.{KIND}"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f'{file}: has no [project.entry-points."zenfi.{KIND}"] ({error})'
        raise OutsideSchemeError(message) from error
    if len(points) != 1:
        message = f"{file}: declares {len(points)} detectors, {', '.join(points)}; one is wanted"
        raise OutsideSchemeError(message)
    ((name, value),) = points.items()
    sys.path[:0] = [str(folder.resolve()), str(folder.resolve() / "src")]
    plug_ins.tell({f"{KIND}/{name}": str(value)})
    return str(name), scheme(name)


class ScoringProgram:
    """A program that judges one flight: a line of JSON with a check in, a line with its score out.

    It dies with the process that started it.
    """

    def __init__(self, program: Path) -> None:
        """Start the program, with pipes to its input and output.

        :raises OutsideSchemeError: if that cannot be.
        """
        self.name = program.stem
        self._program = program
        self._fresh: set[str] = set()
        self._score = 0.0
        try:
            self._process = subprocess.Popen(  # noqa: S603 - its owner asks for it
                [str(program.resolve())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                preexec_fn=die_with_parent,  # noqa: PLW1509 - two system calls
            )
        except OSError as error:
            message = f"{program}: cannot be started ({error.strerror})"
            raise OutsideSchemeError(message) from error

    def score(self, stage: str, values: Floats) -> float:
        """Ask the program for the score of a check.

        :raises OutsideSchemeError: if it does not answer one, or not in time.
        """
        asked = {"stage": stage, "fresh": stage not in self._fresh, "values": values.tolist()}
        self._fresh.add(stage)
        self._score = self._answer(json.dumps(asked).encode() + b"\n")
        return self._score

    def _answer(self, question: bytes) -> float:
        assert self._process.stdin is not None  # noqa: S101 - as it was started
        try:
            self._process.stdin.write(question)
            self._process.stdin.flush()
        except OSError as error:
            raise self._failed(f"ended with status {self._process.wait()}") from error
        line = self._line()
        try:
            score = float(line if line.endswith(b"\n") else b"")
        except ValueError as error:
            raise self._failed(f"answered {line[:40]!r}: a score is one number in a line") from error
        if math.isnan(score) or score < 0:
            raise self._failed(f"answered {score:g}: a score is at least 0")
        return score

    def _line(self) -> bytes:
        """The one line that the program has answered."""
        assert self._process.stdout is not None  # noqa: S101 - as it was started
        answer, descriptor = b"", self._process.stdout.fileno()
        deadline = time.monotonic() + ANSWER_S
        while not answer.endswith(b"\n") and len(answer) < LONGEST_ANSWER:
            if not select.select([descriptor], [], [], max(deadline - time.monotonic(), 0.0))[0]:
                raise self._failed(f"did not answer within {ANSWER_S:g} s")
            more = os.read(descriptor, LONGEST_ANSWER)
            if not more:
                raise self._failed(f"ended with status {self._process.wait()}")
            answer += more
        return answer

    def _failed(self, what: str) -> OutsideSchemeError:
        return OutsideSchemeError(f"{self._program}: {what}")

    def check(self, stage: str, values: Floats) -> float | None:  # noqa: ARG002 - the score is known
        """The last score, if it is an alarm."""
        return self._score if self._score > LIMIT else None

    def reset(self, stage: str) -> None:
        """Say with the stage's next check that it has no predecessor."""
        self._fresh.discard(stage)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        process = self._process
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[union-attr]
        try:
            process.wait(FAREWELL_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
