"""Stores to test with: a folder with SQLite, and a database of a real PostgreSQL server; none at home."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from dashboard.campaigns.store.store import Store
from tests.fixtures import postgresql


@pytest.fixture(scope="session")
def server_() -> Iterator[postgresql.Server | None]:
    programs = postgresql.binaries()
    if programs is None:
        yield None
    else:
        with postgresql.serve(programs) as running:
            yield running


@pytest.fixture
def postgresql_server(server_: postgresql.Server | None) -> postgresql.Server:
    """A real server, started for this test run."""
    if server_ is None:
        pytest.skip("no PostgreSQL server here: apt-get install postgresql")
    return server_


@pytest.fixture(params=["sqlite", "postgresql"])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """What ``--store`` is given: each test runs once on either database."""
    if request.param == "sqlite":
        return str(tmp_path / "store")
    running: postgresql.Server = request.getfixturevalue("postgresql_server")
    return running.database()


@pytest.fixture
def store(where: str) -> Iterator[Store]:
    """An open store."""
    with closing(Store(where)) as opened:
        yield opened


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that ``zenfi`` takes for its store."""
    monkeypatch.setenv("ZENFI_HOME", str(tmp_path / "home"))
    return tmp_path / "home"
