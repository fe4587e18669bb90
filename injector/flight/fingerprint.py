"""Fingerprints of dynamic instructions: the bytes, and a hash of the registers that are read."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from injector.faults.stopped_thread import stand
from injector.tracing.process import Process
from injector.tracing.tracee import Tracee


@dataclass(frozen=True, slots=True)
class Fingerprint:
    """The bytes of the next instruction, and a hash of the registers that it reads, both hexadecimal."""

    code: str
    registers: str


def fingerprint_of(thread: Tracee, process: Process) -> Fingerprint:
    """What a standing thread is about to do, in a form that is the same in every repetition of a flight.

    Registers that the instruction does not read may hold what is left of a clock's reading.

    :raises TargetError: if the thread has been killed, or there is no instruction.
    """
    registers, instruction = stand(thread, process)
    read = sorted(
        one.register for one in instruction.candidates if one.role == "source" and one.register_class == "gpr"
    )
    text = ",".join(f"{name}={registers.get(name):x}" for name in read)
    return Fingerprint(instruction.code.hex(), hashlib.blake2b(text.encode(), digest_size=8).hexdigest())
