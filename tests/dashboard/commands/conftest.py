"""A collection of harmful faults, made once for all tests that ask for one."""

import json
from pathlib import Path

import pytest

from tests.dashboard.command import zenfi

SPEC = """
name = "harmed"
runs = 2
[mission]
seed = 7
limits = { mission_time_s = 8.0 }
properties = ["always deviation <= 0.01"]
[[arms]]
name = "harmless"
fault = { level = "source", target = "command.velocity", model = "none" }
[[arms]]
name = "reversed"
[arms.fault]
level = "source"
target = "command.velocity"
components = "all"
recurrence = "permanent"
bit_numbers = [63]
"""


@pytest.fixture(scope="session")
def collected(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A store with a campaign of two flights that went astray, and the collection of it."""
    folder = tmp_path_factory.mktemp("harmed")
    (folder / "harmed.toml").write_text(SPEC)
    answer = zenfi("campaign", "run", folder / "harmed.toml", "--store", folder, "--slots", 1, "--json")
    assert answer.returncode == 0, answer.stderr
    file = folder / "harmful.jsonl"
    answer = zenfi("harm", "collect", "harmed-1", "--store", folder, "--output", file, "--json")
    assert answer.returncode == 0, answer.stderr
    assert json.loads(answer.stdout) == {"harmful": 2, "new": 2, "faults": 2}
    return folder, file
