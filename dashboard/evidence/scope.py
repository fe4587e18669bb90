"""What every claim takes for granted, and what no fault of ZenFI ever strikes: parts of each evidence."""

from __future__ import annotations

from services.models.base import Strict


class UnstruckPart(Strict):
    """A part of the computer or vehicle that is never struck, and what that means for a claim."""

    part: str
    meaning: str


ASSUMPTIONS = (
    "Upsets come at a constant rate and independently of each other, so that rates of elements are added.",
    "Faults of an element strike as the cell that stands for it draws them: uniformly over what it names.",
    "Missions of the campaigns stand for those that the claim is about: worlds, wind, pilot and airframe.",
    "The simulated vehicle, its sensors and the latencies of the platform stand for the real ones.",
)
"""Those of the method; a budget states its own beside them."""

NEVER_STRUCK = (
    UnstruckPart(
        part="caches, TLBs, buffers, main memory",
        meaning="Faults strike registers, operands of instructions and messages. An upset of memory that is "
        "read later is represented only as far as the value that is read is struck.",
    ),
    UnstruckPart(
        part="the operating system's kernel and its drivers",
        meaning="Only the nodes' own code is struck. A fault that has the kernel panic stops all nodes.",
    ),
    UnstruckPart(
        part="graphics processors and other accelerators",
        meaning="Nothing of the simulated stack runs there.",
    ),
    UnstruckPart(
        part="flight controller, sensors and motors",
        meaning="Their faults are separate targets; they count here only where an element names their cell.",
    ),
    UnstruckPart(
        part="several upsets at a time in different nodes",
        meaning="Each flight has one fault, which may recur. Rates are added: coincidences are neglected.",
    ),
)
