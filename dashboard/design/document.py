"""What ``zenfi study design`` finds: the options, the front and its predictions, as one document."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dashboard.design.overheads import ProtectionCost, RelativeOverhead
from dashboard.design.prediction import HarmPrediction
from dashboard.design.second_computer import SecondComputer
from dashboard.evidence.budget import UpsetBudget
from deploy.errors import BadSpecError
from services.models.base import Strict

DOCUMENT, CAMPAIGNS = "design.json", "campaigns"
"""The document's file, and the folder of the campaigns that fly the designs."""


class OptionLine(Strict):
    """What an element's strikes did with one option. ``low`` and ``high`` are of the 95 % interval (exact).

    ``difference`` is the harm probability beside the same strikes bare, with Newcombe's paired interval.
    ``unpaired`` strikes of the bare arm have none beside them. A masked option has no strikes: its residual
    of 0 is assumed.
    """

    element: str
    option: str
    masked: bool
    struck: int
    harmed: int
    residual: float
    low: float | None
    high: float | None
    difference: float | None
    difference_low: float | None
    difference_high: float | None
    unpaired: int


class ProtectionLine(Strict):
    """A protection: the arms that fly it, what they change, and what it costs flights without a fault.

    ``check_share`` is the part of a mission's virtual time that its checks take, if it has a detector.
    """

    name: str
    arms: list[str]
    changes: dict[str, Any]
    cost: ProtectionCost
    check_share: RelativeOverhead | None


class DesignElement(Strict):
    """An element in a design: its option, the strikes that stand for it, and the fault that flies it.

    ``planned`` is how many strikes its flights should make. Masked by further computers it is not flown.
    """

    element: str
    option: str
    masked: bool
    struck: int
    harmed: int
    fault: str
    planned: int


class DesignLine(Strict):
    """A design: what it has on, the harm that it leaves (1/h), what it costs, and what is predicted of it.

    ``prediction`` is of its strikes when ``campaign`` is flown; None if there is nothing to be flown.
    """

    name: str
    elements: list[DesignElement]
    protections: list[str]
    scheme: str
    changes: dict[str, Any]
    rate_per_hour: float
    bound_per_hour: float
    meets_target: bool | None
    flight_time: RelativeOverhead
    energy: RelativeOverhead
    mass_kg: float
    prediction: HarmPrediction | None
    campaign: str | None


class DesignStudy(Strict):
    """All designs of a vehicle: those on the front, the bare one, and how many there were.

    ``impossible`` combinations were left out, and ``pruned`` options (element, option) as there were too
    many. ``others`` are designs that are to be flown beside a short front, so that enough predictions can be
    held against flights. ``evaluated`` has bound, flight time, energy and mass of each.
    """

    name: str
    zenfi: str
    campaigns: list[str]
    budget: UpsetBudget
    options: list[OptionLine]
    protections: list[ProtectionLine]
    computers: list[SecondComputer]
    left_out: list[str]
    combinations: int
    impossible: int
    pruned: list[tuple[str, str]]
    designs: int
    bare: DesignLine
    front: list[DesignLine]
    others: list[DesignLine]
    evaluated: list[tuple[float, float, float, float]]

    @property
    def lines(self) -> dict[str, DesignLine]:
        """The bare design, those on the front and the others that are to be flown, by name, each once."""
        return {one.name: one for one in (self.bare, *self.front, *self.others)}


def read_design_study(folder: Path) -> DesignStudy:
    """Read the document in a folder that ``zenfi study design`` wrote.

    :raises BadSpecError: if there is none.
    """
    path = folder / DOCUMENT
    try:
        return DesignStudy.model_validate_json(path.read_bytes())
    except OSError as error:
        message = f"{path}: {error.strerror}"
    except ValidationError:
        message = f"{path}: no designs; zenfi study design LABEL --budget FILE --output DIR writes some"
    raise BadSpecError(message)
