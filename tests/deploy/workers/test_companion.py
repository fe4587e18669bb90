"""Missions whose stages run under another stack, reached over TLS: the same bytes, and nothing is left."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from deploy.compose.bus import host
from deploy.compose.control import ControlRequest, ask
from deploy.config.certificates import Machine, write_certificates
from deploy.errors import BadSpecError, DisturbedFlightError, InfrastructureError
from deploy.mission import far_processes
from deploy.mission.companion_orders import CompanionOrder, FlightTerms
from deploy.mission.far_processes import Companion
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.bus.session import BusAddress
from services.models.detection import DetectorSpec
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec
from services.models.outcome import Outcome, repeatable
from tests.bench.proofs import CHANCE
from tests.conftest import PATIENCE_S, descendants, node, wait_until
from tests.dashboard.command import ZENFI
from tests.deploy.compose.conftest import SLEEP, Laboratory
from tests.deploy.workers.slow_link import slow_link

SHORT = MissionSpec(seed=7, limits=Limits(mission_time_s=4.0))

DELAY_S = 0.005
"""Of a slow link, each way."""

CRASHING = FaultSpec(target="rrt_star", model="opcode", bits=4)


@dataclass
class TwoStacks:
    """A stack with a companion computer, one without, and the way from this one to that."""

    laboratory: Laboratory
    near: BusAddress = field(init=False)
    port: int = field(init=False)
    certificates: str = field(init=False)

    def __post_init__(self) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        endpoint = f"tls/127.0.0.1:{self.port}"
        machines = [Machine("far", ("127.0.0.1",)), Machine("near")]
        far, self.certificates = map(
            str, write_certificates(self.laboratory.folder / "certificates", machines, 30)
        )
        companion = {
            "command": [ZENFI, "companion"],
            "ready": {"announces": "companion", "within_s": PATIENCE_S},
            "restart": "always",
        }
        self.laboratory.up({"companion": companion}, name="far", bus={"listen": [endpoint], "tls": far})
        self.near = self.up("near", self.port)
        self.await_companion()

    def up(self, name: str, port: int) -> BusAddress:
        """Another stack on the near side, which reaches the far one at that port."""
        bus = {"connect": [f"tls/127.0.0.1:{port}"], "tls": self.certificates}
        view = self.laboratory.up({"x": {"command": SLEEP}}, name=name, bus=bus)
        return BusAddress(view.folder, view.namespace)

    @property
    def companion(self) -> int:
        """The pid of the companion computer's process, 0 while there is none."""
        view = ask(self.laboratory.folder / "zenfi" / "far", ControlRequest(do="tell"))
        (one,) = view.processes
        return one.pid or 0 if one.phase == "ready" else 0

    def await_companion(self, after: int = 0) -> None:
        """Wait until one takes orders, another one than that of the pid ``after``."""

        def ready() -> bool:
            time.sleep(0.1)  # a fork server is to start meanwhile
            return self.companion not in (0, after)

        wait_until(ready, PATIENCE_S)

    def stages(self) -> list[str]:
        """The processes of missions that run there."""
        return sorted(name for name in descendants(self.companion).values() if name.startswith("zenfi-"))


@pytest.fixture(scope="module")
def stacks() -> Iterator[TwoStacks]:
    # pytest's folders have paths too long for sockets.
    with tempfile.TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", name)
        laboratory = Laboratory(Path(name))
        try:
            yield TwoStacks(laboratory)
        finally:
            laboratory.clear()


@pytest.fixture
def far(stacks: TwoStacks, server: ForkServer) -> Iterator[Companion]:
    stacks.await_companion()
    server.companion = Companion(host(), stacks.near)
    yield server.companion
    server.companion.close()
    server.companion = None


def told(outcome: Outcome) -> dict[str, Any]:
    """All of an outcome that is not of the run alone."""
    found = outcome.model_dump(mode="json", exclude={"wall_s", "recovered_messages", "injection"})
    for one in found["nodes"].values():
        one.update(dict.fromkeys(CHANCE))
    record = outcome.injection
    return found | {"injection": None if record is None else repeatable(record)}


@pytest.mark.parametrize(
    "spec",
    [
        pytest.param(SHORT, id="golden"),
        pytest.param(
            SHORT.model_copy(update={"detector": DetectorSpec(scheme="gaussian")}),
            id="detector",
            marks=pytest.mark.soak,
        ),
        pytest.param(SHORT.model_copy(update={"fault": FaultSpec(target="pid", seed=3)}), id="injected"),
        pytest.param(SHORT.model_copy(update={"fault": CRASHING}), id="crash", marks=pytest.mark.soak),
    ],
)
def test_a_mission_on_two_stacks_has_the_outcome_of_one(
    spec: MissionSpec, server: ForkServer, stacks: TwoStacks
) -> None:
    server.companion = None
    on_one = PairFlyer(server).fly(spec)
    stacks.await_companion()
    server.companion = Companion(host(), stacks.near)
    try:
        on_two = PairFlyer(server).fly(spec)
    finally:
        server.companion.close()
        server.companion = None
    assert told(on_two) == told(on_one)
    if spec.fault is not None:
        assert on_two.injection is not None
        assert on_two.injection.status == "injected"
    assert (on_two.nodes["planning"].restarts > 0) == (spec.fault is CRASHING)
    assert stacks.stages() == []


@pytest.mark.soak
def test_a_link_that_delays_changes_no_flight(server: ForkServer, stacks: TwoStacks) -> None:
    server.companion = None
    on_one = PairFlyer(server).fly(SHORT)
    stacks.await_companion()
    with slow_link(stacks.port, DELAY_S) as link:
        server.companion = Companion(host(), stacks.up("slow", link.port))
        before = link.bytes_passed
        try:
            on_two = PairFlyer(server).fly(SHORT)
        finally:
            server.companion.close()
            server.companion = None
        assert link.bytes_passed - before > 100_000  # it has gone over that link
    assert told(on_two) == told(on_one)


def test_a_stage_that_somebody_kills_there_disturbs_the_flight(
    far: Companion, server: ForkServer, stacks: TwoStacks
) -> None:
    killer = threading.Thread(target=lambda: _kill_when_there(stacks.companion, "planning"))
    killer.start()
    with pytest.raises(DisturbedFlightError, match="planning was ended from outside"):
        PairFlyer(server).fly(MissionSpec(seed=1))
    killer.join()
    assert stacks.stages() == []
    assert far.order(CompanionOrder(do="hello")).installation == far.installation


def _kill_when_there(parent: int, name: str) -> None:
    found: list[int] = []

    def there() -> bool:
        found[:] = [pid for pid in (node(parent, name),) if pid is not None]
        return bool(found)

    wait_until(there, PATIENCE_S)
    with contextlib.suppress(ProcessLookupError):
        os.kill(found[0], signal.SIGKILL)


@pytest.mark.usefixtures("far")
def test_a_flight_whose_companion_is_killed_fails_and_the_next_one_flies(
    server: ForkServer, stacks: TwoStacks
) -> None:
    pid = stacks.companion
    family = descendants(pid)

    def kill() -> None:
        wait_until(lambda: node(pid, "control") is not None, PATIENCE_S)
        family.update(descendants(pid))
        os.kill(pid, signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with pytest.raises(InfrastructureError, match="is lost or does not answer"):
        PairFlyer(server).fly(MissionSpec(seed=1))
    killer.join()
    wait_until(lambda: not any(_is(one, name) for one, name in family.items()), PATIENCE_S)
    stacks.await_companion(after=pid)
    server.companion = Companion(host(), stacks.near)
    assert PairFlyer(server).fly(SHORT).result == "timeout"


def _is(pid: int, name: str) -> bool:
    """Whether a process of that pid and name lives."""
    try:
        told = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return f"({name}) Z" not in told and f"({name})" in told


def test_stages_end_with_a_mission_whose_host_is_killed_and_another_one_waits_for_that(
    far: Companion, stacks: TwoStacks
) -> None:
    fly = subprocess.Popen([ZENFI, "fly", "--companion", host(), "--seed", "1"], env=_at(stacks, "near"))
    wait_until(lambda: node(stacks.companion, "control") is not None, PATIENCE_S)
    with far.flight("other"), pytest.raises(InfrastructureError, match="one at a time"):
        far.order(CompanionOrder(do="open", terms=_terms("other")))
    fly.kill()
    fly.wait()
    wait_until(lambda: stacks.stages() == [], PATIENCE_S)
    with far.flight("other"):
        far.order(CompanionOrder(do="open", terms=_terms("other")))
        far.order(CompanionOrder(do="close"))


def _at(stacks: TwoStacks, name: str) -> dict[str, str]:
    """The environment of a process of that stack."""
    folder = stacks.laboratory.folder / "zenfi" / name
    return {**os.environ, "ZENFI_STACK": str(folder), "ZENFI_NAMESPACE": stacks.near.namespace}


def _terms(name: str) -> FlightTerms:
    return FlightTerms(namespace=f"zenfi/{name}", hang_cpu_s=1.0, traced="", armed=None)


@pytest.mark.soak
def test_a_mission_that_is_not_announced_is_not_begun(far: Companion) -> None:
    with pytest.raises(InfrastructureError, match="nobody would know of its end"):
        far.order(CompanionOrder(do="open", terms=_terms("silent")))


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"clock": "realtime"}, "use lockstep"),
        (
            {
                "stack": {
                    "name": "own",
                    "stages": {
                        "control": {
                            "command": [sys.executable, "-c", "0"],
                            "folder": "/",
                            "sha256": 64 * "0",
                            "latency": {"mean_ms": 1.0},
                        }
                    },
                }
            },
            "are not run for other hosts",
        ),
    ],
)
@pytest.mark.usefixtures("far")
def test_what_cannot_be_flown_on_two_hosts_is_refused(
    fields: dict[str, object], told: str, server: ForkServer
) -> None:
    spec = MissionSpec.model_validate({"seed": 1, **fields})
    with pytest.raises(BadSpecError, match=told):
        PairFlyer(server).fly(spec)


def test_a_companion_that_is_not_there_is_named(stacks: TwoStacks, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(far_processes, "FOUND_S", 0.5)
    with pytest.raises(BadSpecError, match="on nowhere there is none that this host's stack can reach"):
        Companion("nowhere", stacks.near)
