"""The digests that all machines of a campaign must share, so that a flight is the same on each."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Iterator
from functools import cache
from importlib.metadata import version
from importlib.resources import files
from importlib.resources.abc import Traversable

from services.models.base import Strict
from services.models.mission import MissionSpec
from services.models.outcome import Outcome
from services.system import plug_ins

PACKAGES = ("eclipse-zenoh", "mujoco", "numba", "numpy", "ompl", "pyoctomap", "scipy")
"""What computes in a flight."""

_FOLDERS = ("services", "sim", "injector", "detector", "deploy")
_SUFFIXES = (".py", ".toml", ".json", ".npz")


class Installation(Strict):
    """One installation of zenfi; ``forms`` (of specification and outcome) and ``sources`` are digests."""

    zenfi: str
    forms: str
    sources: str
    machine: str
    python: str
    packages: dict[str, str]
    plug_ins: str = ""

    def difference(self, other: Installation) -> str:
        """The first thing in which another differs from this one, in words; empty if there is none."""
        ours, theirs = self._facts(), other._facts()
        differing = (name for name in ours if ours[name] != theirs.get(name))
        name = next(differing, "")
        return f"{name} is {theirs.get(name, 'missing')} there, {ours[name]} here" if name else ""

    def _facts(self) -> dict[str, str]:
        return {
            "zenfi": self.zenfi,
            "the form of specification and outcome": self.forms,
            "the machine": self.machine,
            "Python": self.python,
            **self.packages,
            "the plug-ins": self.plug_ins or "none",
            "zenfi's code": self.sources,
        }


@cache
def own() -> Installation:
    """The installation of this process."""
    forms = f"{MissionSpec.model_json_schema()}{Outcome.model_json_schema()}"
    return Installation(
        zenfi=version("zenfi"),
        forms=_digest([forms.encode()]),
        sources=_digest(part for folder in _FOLDERS for part in _contents(files(folder))),
        machine=platform.machine(),
        python=".".join(platform.python_version_tuple()[:2]),
        packages={name: version(name) for name in PACKAGES},
        plug_ins=plug_ins.digest(),
    )


def told() -> str:
    """The installation of this process, as JSON."""
    return own().model_dump_json()


def _contents(folder: Traversable) -> Iterator[bytes]:
    for entry in sorted(folder.iterdir(), key=lambda one: one.name):
        if entry.is_dir():
            yield from _contents(entry)
        elif entry.name.endswith(_SUFFIXES):
            yield entry.name.encode() + b"\0" + entry.read_bytes()


def _digest(parts: Iterable[bytes]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8) + part)
    return digest.hexdigest()[:12]
