"""Recorded flights that several tests look into."""

from pathlib import Path

import pytest

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec

GOLDEN = MissionSpec(seed=7)
FAULTY = GOLDEN.model_copy(
    update={"fault": FaultSpec(level="source", target="trajectory.x", field="exponent", seed=1)}
)


@pytest.fixture(scope="session")
def flights(server: ForkServer, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A golden flight and one with a fault, each recorded twice."""
    folder = tmp_path_factory.mktemp("flights")
    found = {}
    for again in ("", "-again"):
        pairs = PairFlyer(server)  # knows nothing of the first time
        for name, spec in (("golden", GOLDEN), ("faulty", FAULTY)):
            found[name + again] = folder / f"{name}{again}.mcap"
            pairs.fly(spec, found[name + again], {"campaign": "tests-1", "run": "7"})
    return found
