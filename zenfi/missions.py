"""Single missions: flown, and flown again.

The first flight starts a fork server, which later ones use too and which ends with this process.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Mapping
from pathlib import Path
from threading import RLock
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from deploy.compose.bus import own_address
from deploy.compose.control import stacks_up
from deploy.config.check import check
from deploy.config.definitions import inlined
from deploy.config.written_faults import detector_fields, parse_fault
from deploy.errors import BadSpecError, InfrastructureError, one_line
from deploy.mission.far_processes import Companion
from deploy.mission.flight import Watch
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import Replay
from deploy.pairing.replay import replay as fly_again
from deploy.workers import installation
from services.bus.session import BusAddress
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import Outcome

if TYPE_CHECKING:
    from typing import Unpack

    from zenfi.mission_fields import MissionFields

Fault = FaultSpec | Mapping[str, Any] | str
"""A fault as specification, as its fields, or written: ``instruction:rrt_star,field=exponent``."""

_FORKED = (
    "this process was forked from one that had flown, and Zenoh does not survive that: "
    "start processes that fly by multiprocessing.get_context('spawn')"
)


def fly(
    spec: MissionSpec | None = None,
    *,
    fault: Fault | None = None,
    fault_seed: int = 0,
    record: Path | str | None = None,
    companion: str | None = None,
    **fields: Unpack[MissionFields],
) -> Outcome:
    """Fly one mission, with a fault its golden twin first; the same arguments give the same bytes.

    ``fields`` are those of :class:`MissionSpec`, in place of what ``spec`` says; worlds, airframes,
    platforms and stacks may be names of TOML files. ``fault_seed`` draws what a written fault leaves open.
    ``record`` keeps every message in that file (MCAP). ``companion`` is the host whose companion computer
    runs the stages (docs/two_hosts.md); the bytes are the same.

    :raises BadSpecError: if that cannot be flown, naming what is wrong.
    :raises DisturbedFlightError: if a process was ended from outside.
    :raises InfrastructureError: if the infrastructure failed. A lost mission returns normally.
    """
    mission = mission_of(spec, fault=fault, fault_seed=fault_seed, **fields)
    return fly_mission(mission, Path(record) if record is not None else None, companion=companion)


def mission_of(
    spec: MissionSpec | None = None,
    *,
    fault: Fault | None = None,
    fault_seed: int = 0,
    **fields: Unpack[MissionFields],
) -> MissionSpec:
    """The specification that :func:`fly` flies with these arguments.

    :raises BadSpecError: if it cannot be flown, naming what is wrong.
    """
    given: dict[str, Any] = spec.model_dump(exclude_unset=True) if spec is not None else {}
    given |= {name: str(value) if isinstance(value, Path) else value for name, value in fields.items()}
    if isinstance(given.get("detector"), str):
        given["detector"] = detector_fields(given["detector"])
    try:
        if fault is not None:
            given["fault"] = fault_of(fault, fault_seed)
        mission = MissionSpec.model_validate(inlined(given))
    except ValidationError as error:
        raise BadSpecError(one_line(error)) from error
    check(mission)
    return mission


def fault_of(fault: Fault, seed: int = 0) -> FaultSpec:
    """A fault from the way in which it is given.

    :raises pydantic.ValidationError, BadSpecError: if it is none.
    """
    if isinstance(fault, str):
        return parse_fault(fault, seed)
    if isinstance(fault, FaultSpec):
        return fault
    return FaultSpec.model_validate(inlined({"fault": dict(fault)})["fault"])


def fly_mission(
    spec: MissionSpec, record: Path | None = None, watch: Watch | None = None, companion: str | None = None
) -> Outcome:
    """Fly a specification that was checked; ``watch`` is given the recorder of each flight.

    Stages run on the ``companion`` computer, if one is named.

    :raises DisturbedFlightError, InfrastructureError: as :func:`fly` does.
    """
    if record is not None and not record.parent.is_dir():
        message = f"record {record}: there is no folder {record.parent}"
        raise BadSpecError(message)
    outcome = _local.fly(spec, record, watch, companion)
    if outcome.recording is not None and outcome.recording.problem:
        message = f"recording {record}: {outcome.recording.problem}"
        raise InfrastructureError(message)
    return outcome


def replay(outcome: Outcome) -> Replay:
    """Fly an injected flight again, struck at the same instruction, and say whether all was the same.

    :raises BadSpecError: if its outcome does not say at which instruction its fault struck.
    """
    return _local.replay(outcome)


def companion_of(host: str) -> Companion:
    """The companion computer of a host, over the stack that is up here.

    :raises BadSpecError: if there is none, or other code is installed there: flights would differ.
    """
    address = own_address()
    if address is None:
        up = stacks_up()
        if len(up) != 1:
            what = ", ".join(view.name for view in up) or "none"
            message = f"--companion: one stack is to be up here, which knows the way to {host}; up: {what}"
            raise BadSpecError(message)
        address = BusAddress(up[0].folder, up[0].namespace)
    companion = Companion(host, address)
    theirs = installation.Installation.model_validate_json(companion.installation)
    if difference := installation.own().difference(theirs):
        companion.close()
        message = f"--companion: {host} would fly otherwise: {difference}"
        raise BadSpecError(message)
    return companion


class _LocalFlights:
    """The fork server of this process and what flies on it; another one if it was lost."""

    def __init__(self) -> None:
        self._lock = RLock()
        self.server: ForkServer | None = None
        self._flyer: PairFlyer | None = None
        self._forked = False
        atexit.register(self.close)
        os.register_at_fork(after_in_child=self._leave_to_parent)

    def fly(
        self, spec: MissionSpec, record: Path | None, watch: Watch | None, companion: str | None
    ) -> Outcome:
        """Fly a mission, one at a time; golden twins are remembered unless somebody watches."""
        with self._lock:
            server = self._started()
            self._have_stages_run(server, companion)
            if watch is not None:
                return PairFlyer(server, watch).fly(spec, record)
            if self._flyer is None:
                self._flyer = PairFlyer(server)
            return self._flyer.fly(spec, record)

    def replay(self, outcome: Outcome) -> Replay:
        """Fly an injected flight again."""
        with self._lock:
            return fly_again(outcome, self._started())

    def _have_stages_run(self, server: ForkServer, host: str | None) -> None:
        """On the companion computer of that host, None for here."""
        known = server.companion
        if (known.host if known is not None else None) == host:
            return
        if known is not None:
            known.close()
        server.companion = None if host is None else companion_of(host)
        self._flyer = None

    def close(self) -> None:
        """End the fork server, and with it all that it has started."""
        with self._lock:
            if self.server is not None:
                if self.server.companion is not None:
                    self.server.companion.close()
                self.server.close()
            self.server = self._flyer = None

    def _leave_to_parent(self) -> None:
        """A copy of this process cannot fly: it has neither the server nor Zenoh's threads."""
        self._lock, self._forked = RLock(), self.server is not None
        self.server = self._flyer = None

    def _started(self) -> ForkServer:
        if self._forked:
            raise InfrastructureError(_FORKED)
        if self.server is not None and self.server.is_lost():
            self.close()
        if self.server is None:
            self.server = ForkServer()
        return self.server


_local = _LocalFlights()
