"""Whose program is at the other end of a connection on loopback, as the kernel knows it.

proc_pid_net(5): ``/proc/net/tcp`` lists the sockets of this network namespace with the user that made each.
Both ends of a connection on loopback are there. As with the peer credentials of a Unix socket, nobody can
claim to be somebody else, and browsers and curl need nothing for it.
"""

from __future__ import annotations

import sys
from ipaddress import ip_address
from pathlib import Path

Endpoint = tuple[str, int]
"""An IP address and a port."""

_ESTABLISHED = "01"


def peer_uid(peer: Endpoint, ours: Endpoint) -> int | None:
    """The user id of who made the socket at ``peer`` that is connected to ours; None if there is none.

    One that its process has closed is listed as root's (uid 0, inode 0), so it does not count.
    """
    table = Path("/proc/net/tcp6" if ":" in peer[0] else "/proc/net/tcp")
    wanted = [_listed(peer), _listed(ours), _ESTABLISHED]
    for line in table.read_text().splitlines()[1:]:
        # sl local_address rem_address st tx:rx tr:tm->when retrnsmt uid timeout inode ...
        fields = line.split()
        if fields[1:4] == wanted and fields[9] != "0":
            return int(fields[7])
    return None


def _listed(endpoint: Endpoint) -> str:
    """An endpoint as the table has it: 32-bit words of the address in the machine's byte order, the port."""
    host, port = endpoint
    packed = ip_address(host).packed
    words = (packed[at : at + 4] for at in range(0, len(packed), 4))
    return "".join(f"{int.from_bytes(word, sys.byteorder):08X}" for word in words) + f":{port:04X}"
