"""Campaigns of tests live in a store of their own."""

from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that ``zenfi`` takes for its store."""
    monkeypatch.setenv("ZENFI_HOME", str(tmp_path / "home"))
    return tmp_path / "home"
