"""Pids and tids that are the same in every flight: nodes run in pid namespaces of their own.

A mutex has its owner's tid in memory, and registers have it while it is locked: drawn by the kernel, it would
be another number in each process. In a namespace that its proxy, pid 1, has to itself a node is pid 2.
Whatever runs in a namespace dies with its pid 1. From outside all goes by the pids that it has there, and
:func:`services.system.process_stat.listed_pid` tells those inside. See pid_namespaces(7).
"""

from __future__ import annotations

import os
from pathlib import Path

from injector.reproducible.forked_question import answered_by_a_fork
from services.system.libc import checked, libc
from services.system.lifeline import die_with_parent

CALLER = "fork-nodes"
"""The name of a process that forks on behalf of another one, see :func:`begin`."""

NOWHERE = -1
"""In the place of the descriptor that :func:`begin` gives: there are no own pids."""

_NEWUSER = 0x10000000
NEWPID = 0x20000000
_PR_SET_NAME = 15
_CAP_SYS_PTRACE, _CAP_SYS_ADMIN = 19, 21


def begin() -> int:
    """Give what is forked from now on pids of its own; returns a descriptor for it.

    To be passed to :func:`injector.reproducible.fork_loop.fork_on_order`.

    ``NOWHERE`` if that is not allowed. Root makes namespaces as it likes, and whoever may not, within a user
    namespace. This process waits from here on, dies with the one that goes on in its place, and the other
    way round. It has one thread.
    """
    return _begin() if is_allowed() else NOWHERE


def _begin() -> int:
    _go_on_in_a_fork(in_user_namespace=not answered_by_a_fork(_is_privileged))
    home = os.open("/proc/self/ns/pid", os.O_RDONLY | os.O_CLOEXEC)
    # Nothing is done for the first time when a process is forked: all are to begin with the same memory.
    checked(libc.unshare(0))
    checked(libc.setns(home, NEWPID))
    return home


def is_allowed() -> bool:
    """Whether pids can be had so here, found out by doing it; only a process of one thread may ask."""
    return answered_by_a_fork(_tried)


def _tried() -> bool:
    """Whether a process can be pid 2 of a namespace; this one is good for nothing afterwards."""
    _begin()
    checked(libc.unshare(NEWPID))
    first = os.fork()
    if not first:
        second = os.fork()
        if not second:
            os._exit(os.EX_OK if os.getpid() == 2 else os.EX_NOPERM)
        os._exit(os.waitstatus_to_exitcode(os.waitpid(second, 0)[1]))
    return os.waitpid(first, 0)[1] == 0


def _is_privileged() -> bool:
    """Whether our parent may make namespaces, and trace into them.

    Nobody there can name a tracer outside (Yama).
    """
    status = Path(f"/proc/{os.getppid()}/status").read_text()
    effective = int(status.partition("CapEff:")[2].split(maxsplit=1)[0], 16)
    return bool(effective >> _CAP_SYS_ADMIN & effective >> _CAP_SYS_PTRACE & 1)


def _go_on_in_a_fork(*, in_user_namespace: bool) -> None:
    """Go on in a fork, in a user namespace if need be: the user outside may do there whatever root may.

    Root does all that others do, so that nodes have the same memory, whoever the user is.

    :raises OSError: if that is forbidden; of root, who would lose its power over the files of others.
    """
    if in_user_namespace and not os.getuid():
        raise PermissionError("root without its capabilities has no use for a user namespace")
    checked(libc.unshare(_NEWUSER if in_user_namespace else 0))
    if not answered_by_a_fork(_keep_ids_of_parent if in_user_namespace else lambda: True):
        raise PermissionError("the ids of a user namespace cannot be set")
    checked(libc.unshare(NEWPID))
    pid = os.fork()
    if pid:
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        os._exit(status if status >= 0 else os.EX_SOFTWARE)
    die_with_parent()
    libc.prctl(_PR_SET_NAME, CALLER.encode())


def _keep_ids_of_parent() -> bool:
    """Give our parent, in the user namespace that it has just made, the ids that it has outside."""
    user, group, parent = os.getuid(), os.getgid(), Path(f"/proc/{os.getppid()}")
    (parent / "setgroups").write_text("deny")
    (parent / "uid_map").write_text(f"{user} {user} 1")
    (parent / "gid_map").write_text(f"{group} {group} 1")
    return True


if __name__ == "__main__":
    os._exit(os.EX_OK if is_allowed() else os.EX_NOPERM)
