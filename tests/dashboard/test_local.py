"""Runs on this machine's processors: a failure of ours is loud, whichever thread it meets."""

import subprocess
import sys

import pytest

from dashboard.campaigns import local
from dashboard.campaigns.spec import Run
from services.bus.mission import MissionSpec


def test_a_worker_that_talks_nonsense_ends_the_campaign(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(_: int) -> subprocess.Popen[str]:
        script = "import sys\nfor line in sys.stdin: print('{\"outcome\": {}}', flush=True)"
        return subprocess.Popen(
            [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    monkeypatch.setattr(local, "_start_worker", start)
    with pytest.raises(ValueError, match="Outcome"):
        list(local.fly_all([Run("golden", 0, MissionSpec())], 1))
