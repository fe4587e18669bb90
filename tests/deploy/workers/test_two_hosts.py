"""The simulator on one host, the stages and the injector on another: flights as on one, strangers nowhere."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy.config.certificates import Machine, write_certificates
from deploy.config.link_security import AUTHORITY, tls_settings
from tests.conftest import PATIENCE_S, wait_until
from tests.dashboard.command import ZENFI
from tests.deploy.workers.hosts import Host, two_hosts, why_not

pytestmark = pytest.mark.soak

GROUND, DRONE = "10.77.0.1", "10.77.0.2"
PORT = 7447

FLY = """
import json, sys
from zenfi.missions import fly
from services.models.outcome import repeatable
companion = sys.argv[1] or None
for seed, fault in json.loads(sys.argv[2]):
    one = fly(seed=seed, fault=fault, fault_seed=seed, companion=companion)
    struck = one.injection and repeatable(one.injection).model_dump(mode="json")
    print(json.dumps([one.digest, one.result, struck, one.fixed_pids]), flush=True)
"""
"""Flies missions, without a companion computer if it is named by nothing."""

STACK = """
name = "{name}"
logs = "{folder}/logs"
[bus]
{way} = ["tls/{drone}:{port}"]
tls = "{certificates}"
[processes.{process}]
command = {command}
ready = {{ {ready} }}
"""

JOIN = """
import json, sys, zenoh
config = zenoh.Config()
for key, value in json.loads(sys.argv[1]).items():
    config.insert_json5(key, json.dumps(value))
try:
    zenoh.open(config)
except zenoh.ZError:
    print("refused")
"""

INJECTED_FROM = 10
"""Seeds below have golden flights."""

KERNELS = ("rrt_star", "pid", "octomap", "collision_check", "trajectory")


def up(host: Host, certificates: Path, process: str, command: list[str], ready: str) -> None:
    """Have a stack run on a host."""
    text = STACK.format(
        name=host.name,
        folder=host.folder,
        way="listen" if host.address == DRONE else "connect",
        drone=DRONE,
        port=PORT,
        certificates=certificates,
        process=process,
        command=json.dumps(command),
        ready=ready,
    )
    file = host.folder / "stack.toml"
    host.must(sys.executable, "-c", f"import pathlib; pathlib.Path({str(file)!r}).write_text({text!r})")
    host.must(ZENFI, "up", "-d", "--file", str(file))


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certificates")
    write_certificates(folder, [Machine("ground"), Machine("drone", (DRONE,))], 30)
    return folder


@pytest.fixture(scope="module")
def hosts(certificates: Path) -> Iterator[tuple[Host, Host]]:
    if reason := why_not():
        pytest.skip(reason)
    with two_hosts(("ground", GROUND), ("drone", DRONE)) as (ground, drone):
        companion = [ZENFI, "companion"]
        up(drone, certificates / "drone", "companion", companion, 'announces = "companion", within_s = 3600')
        up(ground, certificates / "ground", "idle", ["sleep", "infinity"], "")
        yield ground, drone


def flown(host: Host, companion: str, flights: list[tuple[int, str | None]]) -> list[object]:
    done = host.must(sys.executable, "-c", FLY, companion, json.dumps(flights))
    return [json.loads(line) for line in done.splitlines()]


@pytest.mark.parametrize("first", [0, 5, 10, 15])
def test_flights_on_two_hosts_are_those_of_one(first: int, hosts: tuple[Host, Host]) -> None:
    ground, _ = hosts
    flights = [
        (seed, f"instruction:{KERNELS[seed % 5]}" if seed >= INJECTED_FROM else None)
        for seed in range(first, first + 5)
    ]
    on_two = flown(ground, "drone", flights)
    assert on_two == flown(ground, "", flights)
    assert len(on_two) == len(flights)


def test_a_stranger_on_the_network_is_not_let_in(
    hosts: tuple[Host, Host], certificates: Path, tmp_path: Path
) -> None:
    ground, _ = hosts
    (foreign,) = write_certificates(tmp_path, [Machine("ground")], 30)
    ours = certificates / "ground" / AUTHORITY
    base = {
        "mode": "client",
        "connect/endpoints": [f"tls/{DRONE}:{PORT}"],
        "connect/timeout_ms": 3000,
        "scouting/multicast/enabled": False,
    }
    wrong = {**base, **tls_settings(foreign), "transport/link/tls/root_ca_certificate": str(ours)}
    none = {**base, "transport/link/tls/root_ca_certificate": str(ours)}
    plain = {**base, "connect/endpoints": [f"tcp/{DRONE}:{PORT}"]}
    right = {**base, **tls_settings(certificates / "ground")}
    told = [ground.must(sys.executable, "-c", JOIN, json.dumps(one)) for one in (wrong, none, plain, right)]
    assert told == ["refused\n", "refused\n", "refused\n", ""]


def test_nothing_is_left_on_the_drone(hosts: tuple[Host, Host]) -> None:
    _, drone = hosts
    wait_until(lambda: "zenfi-perception" not in drone.must("sh", "-c", "cat /proc/[0-9]*/comm"), PATIENCE_S)
    left = drone.must("sh", "-c", f"ls {drone.folder}").split()
    assert [name for name in left if name.startswith("zenfi-") and not name.startswith("zenfi-stacks")] == []
