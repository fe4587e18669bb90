"""What tells a dynamic instruction from others: its bytes, and what it finds in its registers."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from injector.inject import stand
from injector.process import Process
from injector.thread import Thread


@dataclass(frozen=True, slots=True)
class Seen:
    """The bytes of the next instruction, and a hash of the registers that it reads, both hexadecimal."""

    code: str
    registers: str


def look(thread: Thread, process: Process) -> Seen:
    """What a standing thread is about to do, in a form that is the same in every repetition of a flight.

    Registers that the instruction does not read may hold what is left of a clock's reading.

    :raises TargetError: if the thread has been killed, or there is no instruction.
    """
    registers, instruction = stand(thread, process)
    read = sorted(
        one.register for one in instruction.candidates if one.role == "source" and one.register_class == "gpr"
    )
    text = ",".join(f"{name}={registers.get(name):x}" for name in read)
    return Seen(instruction.code.hex(), hashlib.blake2b(text.encode(), digest_size=8).hexdigest())
