"""Two hosts on one machine: namespaces with a cable between them, as much alone as two computers."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from services.system.lifeline import die_with_parent
from tests.conftest import PATIENCE_S, wait_until

TOOLS = ("unshare", "nsenter", "ip", "mount", "hostname")
UNSHARE = [str(shutil.which("unshare")), "--net", "--mount", "--uts", "--ipc", "--pid", "--fork"]


def why_not() -> str:
    """Why there can be no two hosts on this machine; empty if there can."""
    if os.geteuid() != 0:
        return "network namespaces with a cable between them need root"
    if missing := [name for name in TOOLS if shutil.which(name) is None]:
        return f"not installed: {', '.join(missing)}"
    tried = subprocess.run([*UNSHARE, "true"], capture_output=True, check=False)
    return f"the kernel refuses namespaces: {tried.stderr.decode().strip()}" if tried.returncode else ""


class Host:
    """A host: network, host name, processes, temporary files and boot of its own; the packages are shared.

    All that runs on it dies with it, and it with who made it.
    """

    def __init__(self, name: str, address: str, folder: Path) -> None:
        self.name, self.address, self.folder = name, address, folder
        own = os.getpid()
        self._first = subprocess.Popen(
            [*UNSHARE, "--kill-child", "--mount-proc", "sleep", "infinity"],
            preexec_fn=lambda: die_with_parent(own),  # noqa: PLW1509 - no other thread runs yet
        )
        wait_until(lambda: self.init != 0, PATIENCE_S)
        # A folder of the same path has other files on each host: no socket is there for both.
        self.must("mount", "-t", "tmpfs", "none", str(folder))
        boot = folder / "boot_id"
        self.must("sh", "-c", f"echo {uuid.uuid4()} > {boot}")
        self.must("mount", "--bind", str(boot), "/proc/sys/kernel/random/boot_id")
        self.must("hostname", name)
        self.must("ip", "link", "set", "lo", "up")

    @property
    def init(self) -> int:
        """The pid of its first process, by our count; 0 before it has begun."""
        with suppress(OSError):
            children = Path(f"/proc/{self._first.pid}/task/{self._first.pid}/children").read_text().split()
            if children and Path(f"/proc/{children[0]}/comm").read_text() == "sleep\n":
                return int(children[0])
        return 0

    def command(self, *words: str) -> list[str]:
        """The command that runs another one on it."""
        return ["nsenter", "--target", str(self.init), "--all", "--", *words]

    @property
    def environment(self) -> dict[str, str]:
        """What a process on it begins with."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith("ZENFI_")}
        return {**kept, "XDG_RUNTIME_DIR": str(self.folder), "TMPDIR": str(self.folder)}

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run a command on it to its end."""
        return subprocess.run(
            self.command(*words),
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=2 * PATIENCE_S,
        )

    def must(self, *words: str) -> str:
        """What a command that succeeds on it prints."""
        done = self.run(*words)
        assert done.returncode == 0, f"{words}: {done.stderr}"
        return done.stdout

    def close(self) -> None:
        """Kill all that runs on it; its network, mounts and files go with that."""
        self._first.kill()
        self._first.wait()


@contextmanager
def two_hosts(first: tuple[str, str], second: tuple[str, str]) -> Iterator[tuple[Host, Host]]:
    """Two hosts by name and address, with a cable between them."""
    with ExitStack() as held:
        # pytest's folders have paths too long for sockets.
        folder = Path(held.enter_context(tempfile.TemporaryDirectory()))
        hosts = []
        for name, address in (first, second):
            host = Host(name, address, folder)
            held.callback(host.close)
            hosts.append(host)
        ends = [f"{host.name}-end"[:15] for host in hosts]
        near, far = (str(host.init) for host in hosts)
        cable = ["ip", "link", "add", ends[0], "netns", near, "type", "veth", "peer", "name", ends[1]]
        subprocess.run([*cable, "netns", far], check=True)
        for host, end in zip(hosts, ends, strict=True):
            host.must("ip", "addr", "add", f"{host.address}/24", "dev", end)
            host.must("ip", "link", "set", end, "up")
        yield hosts[0], hosts[1]
