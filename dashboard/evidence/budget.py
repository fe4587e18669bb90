"""The budget of a claim: how often each element is upset, and what else its owner states, with sources."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Self

from pydantic import Field, ValidationError, model_validator

from deploy.errors import BadSpecError, one_line
from services.models.base import Strict


class Stated(Strict):
    """A positive number that somebody states: its value, the ends of its 95 % range if known, the source."""

    value: float = Field(gt=0)
    low: float | None = Field(default=None, gt=0)
    high: float | None = None
    source: str = Field(min_length=1)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if (self.low is None) != (self.high is None):
            raise ValueError("low and high go together")
        if self.low is not None and self.high is not None and not self.low <= self.value <= self.high:
            raise ValueError("value must lie between low and high")
        return self


class Element(Strict):
    """Something that upsets strike, and the cell of a campaign whose faults stand for them; '' is any.

    ``fit``: upsets of the whole element in 1e9 hours at the reference flux. ``flux``: times the reference.
    ``share``: the part of the time in which it holds what the cell's faults strike.
    """

    name: str = Field(min_length=1)
    campaign: str = ""
    arm: str = ""
    world: str = ""
    fault: str = ""
    fit: Stated
    flux: Stated
    share: Stated

    @model_validator(mode="after")
    def _part(self) -> Self:
        if self.share.value > 1 or (self.share.high or 0) > 1:
            raise ValueError("share: is a part of the time, at most 1")
        return self


class UpsetBudget(Strict):
    """What a claim is made of. ``target_per_hour``: the failures in a flight hour that it allows."""

    name: str = Field(min_length=1)
    confidence: float = Field(default=0.95, gt=0.5, lt=1, description="of the one-sided bound")
    draws: int = Field(default=100_000, ge=1_000, le=10_000_000)
    target_per_hour: float | None = Field(default=None, gt=0)
    elements: tuple[Element, ...] = Field(min_length=1)
    assumptions: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        names = [one.name for one in self.elements]
        if len(set(names)) < len(names):
            raise ValueError("elements: two have the same name")
        return self


def load_budget(path: Path) -> UpsetBudget:
    """Read a budget of upsets from a TOML file.

    :raises BadSpecError: if there is none, naming the file and what is wrong.
    """
    try:
        return UpsetBudget.model_validate(tomllib.loads(path.read_text()))
    except OSError as error:
        message = f"{path}: {error.strerror}"
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        message = f"{path}: {error}"
    except ValidationError as error:
        message = f"{path}: {one_line(error)}"
    raise BadSpecError(message)
