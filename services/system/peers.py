"""Whose program is at the other end of a connection on loopback, as the kernel knows it.

proc_pid_net(5): ``/proc/net/tcp`` lists the sockets of this network namespace with the user that made each.
Both ends of a connection on loopback are there. As with the peer credentials of a Unix socket, nobody can
claim to be somebody else, and browsers and curl need nothing for it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

Endpoint = tuple[str, int]
"""An IP address and a port."""


def peer_uid(peer: Endpoint, ours: Endpoint) -> int | None:
    """The user id of who made the socket at ``peer`` that is connected to ours; None if there is none.

    One that its process has closed is listed as root's (uid 0, inode 0), so it does not count.
    """
    wanted = _listed(peer), _listed(ours)
    table = "tcp6" if ":" in peer[0] else "tcp"
    return next((one.uid for one in _held(table) if (one.local, one.remote) == wanted), None)


def strangers(ours: Endpoint) -> set[int]:
    """The ids of the users, others than this process's, with a socket that is connected to ours."""
    at, us = _listed(ours), os.getuid()
    table = "tcp6" if ":" in ours[0] else "tcp"
    return {one.uid for one in _held(table) if one.remote == at and one.uid != us}


class _Connected(NamedTuple):
    local: str
    remote: str
    uid: int


def _held(table: str) -> Iterator[_Connected]:
    """The sockets that a process holds. Closed ones are listed as root's, and without an inode."""
    for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
        # sl local_address rem_address st tx:rx tr:tm->when retrnsmt uid timeout inode ...
        fields = line.split()
        if fields[9] != "0":
            yield _Connected(fields[1], fields[2], int(fields[7]))


def _listed(endpoint: Endpoint) -> str:
    """An endpoint as the table has it: 32-bit words of the address in the machine's byte order, the port."""
    host, port = endpoint
    packed = ip_address(host).packed
    words = (packed[at : at + 4] for at in range(0, len(packed), 4))
    return "".join(f"{int.from_bytes(word, sys.byteorder):08X}" for word in words) + f":{port:04X}"
