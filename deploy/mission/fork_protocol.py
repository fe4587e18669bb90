"""What a fork server's process (:mod:`deploy.mission.zygote`) and those who start it agree on."""

from __future__ import annotations

EXIT_BUG = 70
"""Exit status of a node that ended by an exception (sysexits.h: EX_SOFTWARE)."""

EXIT_REAPER = 71
"""What is reported of a process whose reaper failed, which is our own failure."""

EXIT_NONSENSE = 72
"""What is reported of a node that was killed since what it told its proxy made no sense."""

ZENOH_RUNTIME = (
    "(acc: (handover: app), net: (handover: app), tx: (handover: app), rx: (handover: app),"
    " app: (worker_threads: 2))"
)
"""Two threads of Zenoh in a proxy instead of six: a tenth less processor time for a flight."""

MESSAGE_SIZE = 1 << 20
"""Most bytes of a message between them."""

SIDE_SERVER = "fork-sidecars"
"""The name of the process that forks the sidecars."""


def server_argument(parent_pid: int) -> str:
    """The argument of the server's process, always as long."""
    return f"{parent_pid:010}"
