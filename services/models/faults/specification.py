"""The specification of a fault: where, when and what is corrupted. One definition for all levels.

Names of kernels, states, sensors and motors are checked against the tables that declare them by
:func:`deploy.config.check.check`; here only form and range are.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, get_args

from pydantic import Field, model_validator

from services.models.base import Strict
from services.models.faults.mask_histogram import MaskHistogram
from services.system import plug_ins

EquipmentFailure = Literal["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
"""The ways in which a sensor or a motor fails: those of PX4's failure injection."""

FaultModel = Literal["bitflip", "stuck_at", "opcode", "memory", "none"] | EquipmentFailure

SENSORS = ("depth", "odometry", "imu")
MOTORS = ("motor0", "motor1", "motor2", "motor3")

MaskKind = Literal["bits", "uniform", "byte", "word", "histogram"]
MASK_KINDS: tuple[MaskKind, ...] = get_args(MaskKind)


class FaultSpec(Strict):
    """One fault: where, when and what is flipped.

    At ``level`` instruction ``target`` is a kernel (``services/kernels.py``), and the bits are those of an
    instruction that it executes; at level source it is an inter-kernel state or a vector of them
    (``services/models/inter_kernel_states.py``), and the bits are those of one message that carries it.

    At level sensor or actuator ``target`` is one of :data:`SENSORS` or :data:`MOTORS`, which fails from
    ``from_s`` to ``until_s`` as ``model`` says (:mod:`sim.sensors.faults`, :mod:`sim.vehicle.motor_fault`).

    ``trigger`` may be left out; it is drawn then, from ``seed``. A stored outcome's specification says
    exactly when the fault struck.

    ``recurrence`` says how often it strikes: ``once``; and from ``from_s`` to ``until_s`` ``intermittent``,
    each message, or execution of an instruction, with ``probability``; ``permanent``, each in the same bits;
    ``rate``, as a Poisson process of ``rate_hz`` in virtual time, each upset in the next message, or in the
    time that the kernel takes.

    A ``permanent`` defect of instructions may depend on what they read: it then shows only in executions
    whose first named register, of those read, has the bits ``where_set`` set and ``where_clear`` clear.

    ``mask`` says which bits are drawn: ``bits`` distinct ones; with ``uniform`` every non-zero mask of what
    is accessed or of the ``field`` alike; with ``byte`` and ``word`` every non-zero mask of one aligned byte
    or 32-bit word alike; or as a ``histogram`` says. Where a specification is written, the name of a mask
    that another package adds stands for its histogram.

    Struck is a register that the instruction reads or writes; or, before it, one of ``registers``, all alike.

    Models: ``bitflip`` inverts bits of a register; ``stuck_at`` holds them at ``stuck_value`` for
    ``stuck_instructions``; ``opcode`` inverts bits of the instruction for one execution; ``memory``
    inverts bits of the word that the instruction reads or writes; ``none`` does everything but the flip.
    """

    level: Literal["instruction", "source", "sensor", "actuator"] = "instruction"
    target: str = Field(description="kernel, inter-kernel state, sensor or motor")
    seed: int = Field(default=0, ge=0, lt=2**32)
    model: FaultModel = "bitflip"
    operand: Literal["source", "destination", "any"] = "any"
    register_class: Literal["gpr", "vector", "flags", "mask", "any"] = "any"
    registers: tuple[str, ...] | None = Field(
        default=None,
        description="one of these, whether or not the instruction uses it: rax, xmm0, rflags, rip",
    )
    bits: int = Field(default=1, ge=1, le=64, description="how many distinct bits are drawn")
    field: Literal["any", "sign", "exponent", "mantissa"] = Field(
        default="any", description="of one number of a floating-point operand"
    )
    bit_numbers: tuple[int, ...] | None = Field(default=None, description="these bits, instead of drawn ones")
    mask: MaskKind = Field(default="bits", description="the law by which the bits are drawn")
    histogram: MaskHistogram | None = Field(default=None, description="of mask histogram: its content")
    stuck_value: Literal[0, 1] | None = None
    stuck_instructions: int | None = Field(default=None, ge=1, le=10_000)
    scope: Literal["kernel", "thread"] | None = Field(
        default=None, description="the kernel's own code (default), or all that its thread runs in the call"
    )
    components: Literal["one", "all"] = Field(default="one", description="of a vector of states")
    point: int | None = Field(default=None, ge=0, description="of a trajectory, instead of a drawn one")
    recurrence: Literal["once", "intermittent", "permanent", "rate"] = "once"
    probability: float | None = Field(
        default=None, gt=0, le=1, description="that a message, or an execution, is struck"
    )
    rate_hz: float | None = Field(
        default=None,
        gt=0,
        le=1000,
        description="upsets per virtual second; of kernel time at level instruction",
    )
    opcodes: tuple[str, ...] | None = Field(
        default=None, description="mnemonics of the instructions that a fault which recurs strikes"
    )
    where_set: tuple[int, ...] | None = Field(
        default=None, description="of a permanent defect: bits of the first register read that must be 1"
    )
    where_clear: tuple[int, ...] | None = Field(default=None, description="those that must be 0")
    from_s: float = Field(default=0.0, ge=0, le=3600, description="virtual time from which it recurs")
    until_s: float | None = Field(default=None, gt=0, le=3600, description="virtual time until which")
    size: float | None = Field(
        default=None, ge=-1000, le=1000, description="wrong: factor, or m; slow: period, s; delayed: delay, s"
    )
    trigger: Trigger | None = None

    @model_validator(mode="before")
    @classmethod
    def _expand_mask(cls, given: Any) -> Any:
        return _with_histogram(given)

    @model_validator(mode="after")
    def _refuse_nonsense(self) -> FaultSpec:
        equipment = self.at_equipment or self.model in get_args(EquipmentFailure)
        problem = next(self._equipment_problems() if equipment else self._problems(), None)
        if problem is not None:
            raise ValueError(problem)
        return self

    def _problems(self) -> Iterator[str]:
        """The contradictions between the fields, one line each."""
        if self.size is not None:
            yield "size goes with level sensor or actuator"
        if self.level == "source":
            yield from self._source_problems()
        elif self.components != "one" or self.point is not None:
            yield "components and point go with level source"
        yield from self._recurrence_problems()
        yield from self._register_problems()
        stuck = (self.stuck_value, self.stuck_instructions)
        if self.model == "stuck_at" and None in stuck:
            yield "model stuck_at needs stuck_value (0 or 1) and stuck_instructions (how many)"
        if self.model != "stuck_at" and stuck != (None, None):
            yield f"stuck_value and stuck_instructions go with model stuck_at, not {self.model}"
        if self.model in ("opcode", "memory") and self.register_class != "any":
            yield f"model {self.model} strikes no register: leave out register_class"
        if self.model == "opcode" and (self.operand, self.field) != ("any", "any"):
            yield "model opcode strikes no operand: leave out operand and field"
        if self.field != "any":
            yield from self._field_problems()
        if self.bit_numbers is not None:
            yield from self._bit_number_problems(self.bit_numbers)
        yield from _mask_problems(self)

    @property
    def at_equipment(self) -> bool:
        """Whether a sensor or a motor fails, beside the computer."""
        return self.level in ("sensor", "actuator")

    @property
    def recurs(self) -> bool:
        """Whether it may strike more than once."""
        return self.recurrence != "once" or self.at_equipment

    @property
    def most_bits(self) -> int:
        """The bits that whatever is struck must have at least: as many as may be drawn of it."""
        return self.bits if self.histogram is None else self.histogram.most_bits

    @property
    def named_bits(self) -> frozenset[int]:
        """The numbers of the bits of which whatever is struck must have each; empty if none is named."""
        return frozenset(self.bit_numbers or ()) if self.histogram is None else self.histogram.named_bits

    @property
    def recurs_in_instructions(self) -> bool:
        """Whether it strikes executions of instructions again and again."""
        return self.level == "instruction" and self.recurrence != "once"

    def _equipment_problems(self) -> Iterator[str]:
        failures = get_args(EquipmentFailure)
        if not self.at_equipment or self.model not in failures:
            yield f"model {self.model}: {', '.join(failures)} go with level sensor or actuator, and only they"
            return
        known = SENSORS if self.level == "sensor" else MOTORS
        if self.target not in known:
            yield f"unknown {self.level} {self.target!r}; known: {', '.join(known)}"
        if (self.probability is not None) != (self.model == "intermittent"):
            yield "model intermittent and probability go together"
        if (self.size is not None) != (self.model in ("wrong", "slow", "delayed")):
            yield "size goes with the models wrong, slow and delayed, which need it"
        if self.model in ("slow", "delayed") and not 0.0 < (self.size or 0.0) <= 60.0:
            yield f"size: {self.model} takes seconds, more than 0 and at most 60"
        if self.until_s is not None and self.until_s <= self.from_s:
            yield f"until_s: {self.until_s} s is not after from_s, {self.from_s} s"
        own = {"level", "target", "model", "seed", "from_s", "until_s", "size", "probability", "trigger"}
        extra = self.model_dump(exclude_defaults=True).keys() - own
        if extra:
            yield f"{', '.join(sorted(extra))}: not of a sensor or motor"

    def _recurrence_problems(self) -> Iterator[str]:
        if self.recurs_in_instructions:
            yield from self._execution_problems()
        elif self.opcodes is not None:
            yield "opcodes goes with level instruction and recurrence intermittent, permanent or rate"
        yield from self._pattern_problems()
        needs = {"intermittent": "probability", "rate": "rate_hz"}
        for kind, name in needs.items():
            if (getattr(self, name) is not None) != (self.recurrence == kind):
                yield f"recurrence {kind} and {name} go together"
        if self.recurrence == "once" and (self.from_s, self.until_s) != (0.0, None):
            yield "from_s and until_s go with a recurrence: intermittent, permanent or rate"
        if self.until_s is not None and self.until_s <= self.from_s:
            yield f"until_s: {self.until_s} s is not after from_s, {self.from_s} s"

    def _execution_problems(self) -> Iterator[str]:
        models = ("bitflip", "none") if self.recurrence == "permanent" else ("bitflip", "memory", "none")
        if self.model not in models:
            yield f"recurrence {self.recurrence} at level instruction goes with model {' or '.join(models)}"
        if self.scope == "thread":
            yield "a fault that recurs strikes a kernel's own code: leave out scope"
        if self.recurrence == "permanent" and not self.opcodes:
            yield "recurrence permanent needs opcodes, those of the defective unit: opcodes=mulsd+mulpd"
        if self.opcodes is not None and not all(self.opcodes):
            yield "opcodes: expected mnemonics, like mulsd"
        if self.trigger is not None and (self.trigger.site is not None or self.trigger.cpu_ns is not None):
            yield f"recurrence {self.recurrence} has no one site: leave out site and cpu_ns"

    @property
    def operand_pattern(self) -> tuple[int, int] | None:
        """The bits of an operand that a defect depends on, and which of them must be 1; None: of none."""
        ones, zeros = (sum(1 << bit for bit in bits or ()) for bits in (self.where_set, self.where_clear))
        return (ones | zeros, ones) if ones | zeros else None

    def _pattern_problems(self) -> Iterator[str]:
        given = [bits for bits in (self.where_set, self.where_clear) if bits is not None]
        if given and not (self.recurs_in_instructions and self.recurrence == "permanent"):
            yield "where_set and where_clear go with level instruction and recurrence permanent"
        numbers = [bit for bits in given for bit in bits]
        if not all(given) or len(set(numbers)) < len(numbers) or not all(0 <= bit < 64 for bit in numbers):
            yield f"where_set, where_clear: expected distinct numbers from 0 to 63, got {numbers}"

    def _source_problems(self) -> Iterator[str]:
        if self.model not in ("bitflip", "none"):
            yield f"model {self.model} goes with level instruction; at level source: bitflip, none"
        # Specifications that were stored have the default of then, which was thread.
        if (self.operand, self.register_class) != ("any", "any") or self.scope == "kernel":
            yield "operand, register_class and scope go with level instruction: a message has none"

    def _register_problems(self) -> Iterator[str]:
        names = self.registers
        if names is None:
            return
        if not names or len(set(names)) < len(names) or not all(names):
            yield f"registers: expected distinct names, like rax or rip, got {list(names)}"
        if self.level != "instruction" or self.recurs or self.model in ("opcode", "memory"):
            yield "registers goes with level instruction, recurrence once and a model that strikes registers"
        if (self.operand, self.register_class, self.field) != ("any", "any", "any"):
            yield "registers says which, used or not: leave out operand, register_class and field"

    def _field_problems(self) -> Iterator[str]:
        if self.register_class not in ("vector", "any"):
            yield (
                f"field {self.field} is one of a floating-point number: register_class vector or any, "
                f"not {self.register_class}"
            )
        if self.bit_numbers is not None:
            yield "field and bit_numbers both say which bits: leave out one"
        largest = {"sign": 1, "exponent": 11, "mantissa": 52}.get(self.field, self.most_bits)
        if self.most_bits > largest:
            yield f"bits: {self.field} has at most {largest}, got {self.most_bits}"

    def _bit_number_problems(self, numbers: tuple[int, ...]) -> Iterator[str]:
        if not numbers or len(set(numbers)) < len(numbers) or not all(0 <= one < 512 for one in numbers):
            yield f"bit_numbers: expected distinct numbers from 0 to 511, got {list(numbers)}"
        if self.bits not in (1, len(numbers)):
            yield "bits counts bits to be drawn, bit_numbers names them: leave out bits"


def _mask_problems(fault: FaultSpec) -> Iterator[str]:
    if fault.mask == "histogram" and fault.histogram is None:
        yield "mask histogram needs histogram: a FILE.toml, or the tables of one"
    if fault.mask != "histogram" and fault.histogram is not None:
        yield f"histogram goes with mask histogram, not {fault.mask}"
    if fault.mask == "bits":
        return
    if fault.bits != 1:
        yield f"bits goes with mask bits: mask {fault.mask} itself says how many"
    both = f"mask {fault.mask} both say which bits: leave out one"
    if fault.bit_numbers is not None:
        yield f"bit_numbers and {both}"
    if fault.field != "any" and (fault.mask in ("byte", "word") or fault.named_bits):
        yield f"field and {both}"
    if fault.mask == "word" and fault.model == "opcode":
        yield "model opcode: an instruction has bytes, no words: choose mask byte"


def _with_histogram(given: Any) -> Any:
    """A specification as it is written, with the histogram of a mask of another package for its name."""
    name = given.get("mask") if isinstance(given, dict) else None
    if not isinstance(name, str) or name in MASK_KINDS or not plug_ins.is_installed("masks", name):
        return given
    if given.get("histogram") is not None:
        message = f"histogram and mask {name} both say which bits: leave out one"
        raise ValueError(message)
    return {**given, "mask": "histogram", "histogram": plug_ins.load("masks", name)}


class Waypoint(Strict):
    """A pass shortly before a site, from which fewer passes are to be counted than from the call's beginning.

    It is the ``hit``-th through ``offset`` of ``module`` since the call began; the site's own address is
    passed ``rest`` times after it, the pass of the site included.
    """

    module: str = ""
    build_id: str = ""
    offset: int = Field(default=0, ge=0)
    hit: int = Field(ge=1)
    rest: int = Field(ge=1)


class Site(Strict):
    """One dynamic instruction of a call, so that it can be found again.

    It is ``steps`` instructions after the ``hit``-th pass of the thread through ``offset`` of ``module``
    (no module: the address itself) since the call began; without a ``hit``, after the call's beginning.
    ``way`` is a quicker way to that pass.
    ``code``, and ``registers`` or ``relative``, must be found there before a bit is flipped; empty: not
    known yet.
    """

    precision: Literal["exact", "occurrence"] = Field(description="how exactly this is the drawn instruction")
    step: int | None = Field(default=None, ge=0, description="number in the call, counted from 0, if known")
    module: str = ""
    build_id: str = ""
    offset: int = Field(default=0, ge=0)
    hit: int = Field(default=0, ge=0)
    way: Waypoint | None = None
    steps: int = Field(default=0, ge=0)
    code: str = Field(default="", description="bytes of the instruction")
    registers: str = Field(default="", description="hash of those that it reads")
    relative: str = Field(default="", description="the same hash, pointers told by what they point into")


class Trigger(Strict):
    """When a fault strikes: in which call of the kernel, and where in it.

    The call is the ``invocation``-th, or the first that begins at ``after_ns`` of virtual time or later.
    The place is a ``site``, or ``cpu_ns`` of thread time after the beginning. What is not given is drawn:
    the call uniformly ``over`` the golden twin's calls or its flight time, the place by the injector when
    the call comes. The specification in an outcome has all of it.
    """

    over: Literal["calls", "time"] = "calls"
    calls: int | None = Field(
        default=None, ge=1, description="faults of one mission strike so many different calls at most"
    )
    invocation: int | None = Field(default=None, ge=0)
    after_ns: int | None = Field(default=None, ge=0)
    site: Site | None = None
    cpu_ns: int | None = Field(default=None, ge=0)

    def names(self, number: int, now_ns: int) -> bool:
        """Whether it names the call or message of that number, at this virtual time."""
        if self.invocation is not None:
            return number == self.invocation
        return self.after_ns is not None and now_ns >= self.after_ns

    @property
    def names_a_call(self) -> bool:
        """Whether it need not be drawn which call is struck."""
        return self.invocation is not None or self.after_ns is not None
