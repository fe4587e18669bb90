"""The fork server's own process."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from deploy.forkserver import ForkServer
from deploy.stack import Process


def test_two_servers_never_compile_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their randomness is the same, and so are the names of the files that numba writes first."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    stack = {"slow": Process("slow", "tests.fixtures.nodes.warms")}
    with ThreadPoolExecutor() as pool:
        for server in pool.map(lambda _: ForkServer(stack), range(3)):
            server.close()
    noted = [line.split(maxsplit=1) for line in (tmp_path / "warming").read_text().splitlines()]
    assert len({pid for pid, _ in noted}) == 3
    for (pid, begins), (same, is_done) in zip(noted[::2], noted[1::2], strict=True):
        assert (pid, begins, is_done) == (same, "begins", "is done")
