"""What /proc tells of processes."""

import os

import pytest

from services.system.process_stat import listed_pid


def test_outside_of_a_namespace_a_process_is_listed_under_its_pid() -> None:
    pid = os.fork()
    if not pid:
        os._exit(0)
    assert listed_pid(pid) == pid  # also once it has ended
    os.waitpid(pid, 0)
    with pytest.raises(ProcessLookupError):
        listed_pid(pid)
