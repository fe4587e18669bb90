"""A stack of one's own: executables, of any language, that take the places of stages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from services.bus.topics import RECORDED, published_by
from services.models.base import Strict
from services.models.platform import KernelLatency

Stage = Literal["perception", "planning", "control"]
Text = Annotated[str, StringConstraints(min_length=1, pattern=r"^[^\x00]*$")]


class OwnStage(Strict):
    """An executable in a stage's place. Its protocol is in docs/own_stack.md.

    ``command`` is run by no shell, in ``folder``; its first word is the path of an ELF file. ``sha256`` is of
    that and of the other files in it, as they were when the specification was made. It is given ``inputs``
    beside its stage's trigger. A fault of level instruction strikes in a call of ``function``: its C, C++ or
    mangled name. Each of its steps takes ``latency`` of virtual time.
    """

    command: Annotated[tuple[Text, ...], Field(min_length=1)]
    folder: Text
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    inputs: tuple[str, ...] = ()
    function: str = ""
    latency: KernelLatency


class OwnAutopilot(Strict):
    """A program in the flight controller's place, by PX4's simulator protocol (docs/autopilots.md).

    ``command``, ``folder`` and ``sha256`` are as of an :class:`OwnStage`; ``{instance}`` in a word stands
    for the number that is to be added to PX4's ports. Before the mission it has ``boot_s``, in which no
    answer is awaited, then ``settle_s``, in which it is armed; the vehicle is held meanwhile.
    """

    command: Annotated[tuple[Text, ...], Field(min_length=1)]
    folder: Text
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    boot_s: float = Field(default=0.0, ge=0, le=120)
    settle_s: float = Field(default=1.0, ge=0, le=120)


class OwnStack(Strict):
    """The own stages of a mission, by the stages that they replace, and its own autopilot."""

    name: str = Field(min_length=1, max_length=60, pattern=r"^[A-Za-z0-9._-]+$")
    stages: Mapping[Stage, OwnStage] = Field(default_factory=dict)
    autopilot: OwnAutopilot | None = None

    @property
    def programs(self) -> dict[str, OwnStage | OwnAutopilot]:
        """All that is run, by what it replaces."""
        run: dict[str, OwnStage | OwnAutopilot] = dict(self.stages.items())
        if self.autopilot is not None:
            run["autopilot"] = self.autopilot
        return run

    def of(self, stage: str) -> OwnStage | None:
        """The own stage that replaces ``stage``, if there is one."""
        return next((own for name, own in self.stages.items() if name == stage), None)

    @model_validator(mode="after")
    def _refuse_nonsense(self) -> Self:
        problem = next(self._problems(), None)
        if problem is not None:
            raise ValueError(problem)
        return self

    def _problems(self) -> Iterator[str]:
        if not self.programs:
            yield "it replaces nothing: give it [stages.control], say, or [autopilot]"
        for stage, own in self.stages.items():
            given = [topic.name for topic in RECORDED if topic.publisher != stage]
            for name in own.inputs:
                if name not in given:
                    yield f"{stage} cannot have the input {name!r}; it can have {', '.join(given)}"
            if len(set(own.inputs)) < len(own.inputs) or trigger(stage) in own.inputs:
                yield f"inputs of {stage}: name each once, and not {trigger(stage)}, which sets it going"


def trigger(stage: str) -> str:
    """The topic whose messages trigger a stage."""
    name = published_by(stage)[0].trigger
    assert name is not None  # noqa: S101 - of every stage but the simulator, which owns the clock
    return name
