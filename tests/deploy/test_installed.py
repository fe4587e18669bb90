"""The main jobs from the wheel, outside the checkout: what it answers there is what it answers here."""

import json
import signal
import socket
from pathlib import Path
from zipfile import ZipFile

import pytest

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from tests.conftest import wait_until
from tests.deploy.installed import (
    PACKAGES,
    ROOT,
    Installed,
    build_wheel,
    download_and_install,
    link_and_install,
)

VERSIONS = ("3.11", "3.12", "3.13")
LINKED = "linked"
"""What ZenFI needs is this environment's; else it is downloaded for the Python that is named."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("copy"), tmp_path_factory.mktemp("wheels"))


@pytest.fixture(
    scope="module", params=[LINKED, *(pytest.param(version, marks=pytest.mark.soak) for version in VERSIONS)]
)
def installed(
    request: pytest.FixtureRequest, wheel: Path, tmp_path_factory: pytest.TempPathFactory
) -> Installed:
    made = Installed(tmp_path_factory.mktemp("environment"), tmp_path_factory.mktemp("elsewhere"))
    if request.param == LINKED:
        link_and_install(wheel, made)
    else:
        download_and_install(wheel, request.param, made)
    return made


def test_the_wheel_holds_every_file_of_the_product(wheel: Path) -> None:
    packed = {name for name in ZipFile(wheel).namelist() if ".dist-info/" not in name}
    files = (file for name in PACKAGES for file in (ROOT / name).rglob("*") if file.is_file())
    assert packed == {str(file.relative_to(ROOT)) for file in files if "__pycache__" not in file.parts}


def test_a_flight_is_that_from_the_checkout(installed: Installed, server: ForkServer) -> None:
    spec = MissionSpec(world="sparse", seed=7, fault=FaultSpec(target="octomap", seed=3))
    here = PairFlyer(server).fly(spec)
    assert here.injection is not None
    assert here.golden is not None

    files = installed.answer("python", "-c", "import services, sim; print(services.__file__, sim.__file__)")
    assert all(Path(file).is_relative_to(installed.packages) for file in files.split())
    fault = ("--fault", "instruction:octomap", "--fault-seed", 3)
    there = json.loads(installed.answer("zenfi", "fly", "--world", "sparse", "--seed", 7, *fault, "--json"))
    assert here.golden.result == there["golden"]["result"] == "success"
    assert here.golden.digest == there["golden"]["digest"]

    # Memory lies elsewhere in another installation; where a fault strikes and what comes of it do not change.
    for name in ("module", "build_id", "offset", "register", "bits"):
        assert there["injection"][name] == here.injection.model_dump(by_alias=True)[name]
    assert there["digest"] == here.digest


def test_a_record_of_the_checkout_replays(installed: Installed, server: ForkServer) -> None:
    here = PairFlyer(server).fly(
        MissionSpec(world="sparse", seed=7, fault=FaultSpec(target="octomap", seed=3))
    )
    (installed.folder / "flight.json").write_text(here.model_dump_json(by_alias=True))
    told = json.loads(installed.answer("zenfi", "replay", "flight.json", "--json"))
    assert told["answer"] in ("replayed", "relocated")


def test_the_readme_s_main_job(installed: Installed) -> None:
    assert "guarded" in installed.answer("zenfi", "campaign", "run", "demo", "--scale", 0.1)
    assert "replayed" in installed.answer("zenfi", "replay", "demo-1")


def test_a_detector_is_trained_and_flies(installed: Installed) -> None:
    recorded, model = installed.folder / "recorded", installed.folder / "model.json"
    installed.answer("zenfi", "train", "record", "--output", recorded, "--seeds", 1, "--world", "sparse")
    installed.answer("zenfi", "train", "gaussian", "--data", recorded, "--output", model)
    told = installed.answer("zenfi", "fly", "--seed", 7, "--detector", f"gaussian,model={model}", "--json")
    assert json.loads(told)["result"] == "success"


def test_kernels_are_struck_alone(installed: Installed) -> None:
    told = installed.answer("zenfi", "kernels", "run", "--kernel", "pid", "--injections", 50, "--json")
    assert told.count("\n") > 1


def test_any_process_is_struck(installed: Installed) -> None:
    endless = "while True: sum(range(1000))"
    with installed.start("python", "-c", endless) as program:
        try:
            told = installed.answer("zenfi", "inject", "--pid", program.pid, "--seed", 3, "--json")
        finally:
            program.kill()
    assert "register" in told


def test_a_service_flies(installed: Installed) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ask = (
        "import zenfi\n"
        f"with zenfi.connect('http://127.0.0.1:{port}') as service: print(service.fly(seed=7).digest)\n"
        "print(zenfi.fly(seed=7).digest)"
    )
    with installed.start("zenfi", "serve", "--port", port) as service:
        try:
            wait_until(lambda: _listens(port))
            there, here = installed.answer("python", "-c", ask).split()
        finally:
            service.send_signal(signal.SIGTERM)
    assert there == here
    assert service.returncode == 0


def _listens(port: int) -> bool:
    with socket.socket() as visitor:
        return visitor.connect_ex(("127.0.0.1", port)) == 0
