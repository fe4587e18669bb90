"""What publishers send arrives, however slow who hears it: real sessions, one of which dawdles."""

import re
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zenoh

from services.bus import session
from services.bus.session import BusAddress
from tests.conftest import wait_until

ROOT = Path(__file__).parents[3]
MESSAGES, SIZE = 3000, 4000


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """The supervisor's session and one of another process's kind, of one mission."""
    address = BusAddress(tmp_path, "mission")
    with (
        closing(session.open_session(address, "router", router=True)) as supervisor,
        closing(session.open_session(address, "sim")) as other,
    ):
        yield supervisor, other


def test_a_publisher_waits_for_who_hears_it_and_loses_nothing(
    ends: tuple[zenoh.Session, zenoh.Session],
) -> None:
    supervisor, other = ends
    arrived: list[int] = []

    def dawdle(sample: zenoh.Sample) -> None:
        time.sleep(0.0005)
        arrived.append(int(sample.payload.to_bytes()[:6]))

    heard = supervisor.declare_subscriber("strikes", dawdle)
    publisher = session.declare_publisher(other, "strikes")
    wait_until(lambda: "matching: true" in str(publisher.matching_status))
    for number in range(MESSAGES):
        publisher.put(f"{number:6}".encode() + bytes(SIZE))
    wait_until(lambda: len(arrived) >= MESSAGES)
    assert arrived == list(range(MESSAGES))
    heard.undeclare()  # type: ignore[no-untyped-call]


def test_each_publisher_is_declared_anew(ends: tuple[zenoh.Session, zenoh.Session]) -> None:
    """One that were kept would keep its session, and the service opens one for each flight."""
    _, other = ends
    assert session.declare_publisher(other, "strikes") is not session.declare_publisher(other, "strikes")


def test_nodes_publish_by_nothing_else() -> None:
    """Zenoh's own publishers drop what has no room."""
    found = {
        str(file.relative_to(ROOT))
        for room in ("services", "injector", "sim", "detector", "deploy/mission", "deploy/recording")
        for file in (ROOT / room).rglob("*.py")
        if re.search(r"(?<!session)\.declare_publisher\(|(?:bus|session)\.put\(", file.read_text())
    }
    assert found == {"services/bus/session.py"}
