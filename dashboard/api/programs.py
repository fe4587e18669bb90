"""Which programs may take the place of stages for who asks over HTTP: those that the owner has named.

The service runs them as its own user, and a shell with ``-c`` is any program. So what is named is all of what
is run: the executable, its arguments, the folder, and the digest of its files.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from dashboard.campaigns.spec import CampaignSpec, stacks
from deploy.config.definitions import own_stack
from deploy.errors import BadSpecError
from services.models.own_stack import OwnAutopilot, OwnStack, OwnStage


class ForbiddenError(BadSpecError):
    """What may not be asked for over HTTP."""


class AllowedProgram(NamedTuple):
    """A program that may be run: its command, folder and the digest of its files."""

    command: tuple[str, ...]
    folder: str
    sha256: str

    @classmethod
    def of(cls, own: OwnStage | OwnAutopilot) -> AllowedProgram:
        """The allowed program that would be run."""
        return cls(own.command, own.folder, own.sha256)


Programs = frozenset[AllowedProgram]


def named(files: Iterable[Path]) -> Programs:
    """The programs in stack files, as they are now.

    :raises BadSpecError: naming the file, if it is none, or a program cannot be run.
    """
    read = [OwnStack.model_validate(own_stack(file)) for file in files]
    return frozenset(AllowedProgram.of(own) for stack in read for own in stack.programs.values())


def refuse_others(programs: Programs, spec: CampaignSpec) -> None:
    """Refuse a campaign that would run any other program; no file is looked at.

    :raises ForbiddenError: naming the program and the remedy.
    """
    for stack in stacks(spec):
        for replaced, own in stack.programs.items():
            if AllowedProgram.of(own) not in programs:
                message = (
                    f"stack: {replaced}: {own.command[0]!r} with these arguments, folder and digest is no "
                    "program that the service was started with: zenfi serve --allow-stack FILE"
                )
                raise ForbiddenError(message)
