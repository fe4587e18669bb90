"""Dependencies with reason and licence: ``python3 launch.py dependencies`` writes ``docs/dependencies.md``.

Requirements and reasons stand in ``pyproject.toml``, versions in ``constraints.txt``; what a package needs
and its licence are what its metadata say in this environment.
"""

from __future__ import annotations

import itertools
import sys
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from release.licences import is_accepted, licence_of

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "dependencies.md"
LOCK = ROOT / "constraints.txt"

OWN = "zenfi"
PIP = "pip"
"""Is there before anything is installed, so that no version of it is locked."""

FOR_GRAPHICS_CARDS = ("nvidia-", "cuda-")
"""What torch brings along where its build is one for graphics cards, which follows from the index alone."""

TESTS = "test"
EVERY_INSTALLATION = "all"

HEAD = """# Dependencies

Written by `python3 launch.py dependencies` and `python3 launch.py lock`: change `pyproject.toml` instead.

Reasons stand there in `tool.zenfi.dependencies`, versions in `constraints.txt`. Licences are what the
metadata of packages say (SPDX; `BSD` where they do not say which), or what `tool.zenfi.licences` states.

A test refuses a dependency without a reason, and one whose licence, direct or not, is unknown, GPL or AGPL.
Licences that leave our own as it is are accepted, the LGPL among them for libraries used as they come.

*With* says what brings a package along: `all` installations, an extra (`pip install zenfi[dask]`), or `test`,
which stands for tests and tools only.
"""

BUNDLED = """
## In wheels of others

Wheels bring libraries along under licences of their own, of which metadata do not always tell:

- numpy and scipy: libgfortran, GPL-3.0 with GCC's runtime library exception, which leaves its users free.
- mujoco: Eigen, MPL-2.0, of which some files are LGPL-2.1; its wheel has the list.
- pyzmq: libzmq, MPL-2.0.
- torch: builds for graphics cards, PyPI's for Linux among them, bring along packages of NVIDIA's (some GB,
  under licences of its own). Nothing here uses them; a build for processors alone spares them.
"""


@dataclass(frozen=True, slots=True)
class Package:
    """A package that we need, directly (``reason`` says why) or because another one needs it."""

    name: str
    version: str
    licence: str
    used: str
    reason: str = ""


class Dependencies:
    """Everything that ``pyproject.toml`` requires, and what that needs, as far as it is installed here."""

    def __init__(self, pyproject: Mapping[str, Any], lock: str) -> None:
        project, ours = pyproject["project"], pyproject["tool"][OWN]
        self._reasons: Mapping[str, str] = ours["dependencies"]
        self._stated: Mapping[str, str] = ours["licences"]
        extras = project["optional-dependencies"]
        self._groups = {"": list(map(Requirement, project["dependencies"]))}
        self._groups |= {name: list(map(Requirement, lines)) for name, lines in extras.items()}
        pinned = (line.partition("==") for line in lock.splitlines() if not line.startswith("#"))
        self._locked: dict[str, str] = {canonicalize_name(name): version for name, _, version in pinned}

    @classmethod
    def ours(cls) -> Dependencies:
        """Those of this checkout."""
        return cls(tomllib.loads((ROOT / "pyproject.toml").read_text()), LOCK.read_text())

    @cached_property
    def direct(self) -> dict[str, list[Requirement]]:
        """What we ask for ourselves, by name."""
        found: dict[str, list[Requirement]] = {}
        for one in itertools.chain(*self._groups.values()):
            if one.name != OWN:
                found.setdefault(canonicalize_name(one.name), []).append(one)
        return dict(sorted(found.items()))

    @cached_property
    def packages(self) -> list[Package]:
        """Every package, direct ones first."""
        others = sorted({name for found in self._found.values() for name, _ in found} - set(self.direct))
        return [self._package(name) for name in (*self.direct, *others)]

    def needs(self, name: str) -> list[str]:
        """The packages that an installed one needs here, by its metadata."""
        extras = {extra for found in self._found.values() for one, extra in found if one == name}
        named = {canonicalize_name(one.name) for extra in extras for one in _required(name, extra)}
        return sorted(one for one in named if not one.startswith(FOR_GRAPHICS_CARDS))

    def complaints(self) -> list[str]:
        """What is wrong, a line each that says the remedy."""
        reasons, licences = (f"[tool.zenfi.{one}] in pyproject.toml" for one in ("dependencies", "licences"))
        names = {one.name for one in self.packages}
        found = [
            f"{one}: say in {reasons} why it is needed" for one in self.direct if not self._reasons.get(one)
        ]
        found += [
            f"{one}: not required: remove it from {reasons}"
            for one in self._reasons
            if one not in self.direct
        ]
        found += [
            f"{one}: not required: remove it from {licences}" for one in self._stated if one not in names
        ]
        for one in self.packages:
            if not one.licence:
                found.append(f"{one.name}: tells no licence: state it in {licences}")
            elif not is_accepted(one.licence):
                found.append(f"{one.name}: its licence is not accepted: {one.licence}")
        return found

    def unlocked(self) -> list[str]:
        """Packages that are not installed here in the version that the lock has."""
        return [one.name for one in self.packages if _installed(one.name) not in (one.version, "")]

    @cached_property
    def _found(self) -> dict[str, set[tuple[str, str]]]:
        return {group: self._closure(requirements) for group, requirements in self._groups.items()}

    def _closure(self, requirements: Iterable[Requirement]) -> set[tuple[str, str]]:
        """What requirements bring along: names of packages, each without and with the extras asked of it."""
        found: set[tuple[str, str]] = set()
        waiting = [one for one in requirements if one.marker is None or one.marker.evaluate()]
        while waiting:
            one = waiting.pop()
            if one.name == PIP or canonicalize_name(one.name).startswith(FOR_GRAPHICS_CARDS):
                continue
            if one.name == OWN:
                waiting += itertools.chain(*(self._groups[extra] for extra in one.extras))
                continue
            for extra in ("", *one.extras):
                if (key := (canonicalize_name(one.name), extra)) not in found:
                    found.add(key)
                    waiting += _required(*key)
        return found

    def _package(self, name: str) -> Package:
        groups = [group for group, found in self._found.items() if (name, "") in found]
        groups += [group for group, asked in self._groups.items() if any(_is(name, one) for one in asked)]
        if "" in groups:
            places = {str(one.marker) for one in self.direct.get(name, ()) if one.marker is not None}
            used = EVERY_INSTALLATION + "".join(f", where {one}" for one in places)
        else:
            extras = sorted(set(groups) - {TESTS})
            used = f"extra {', '.join(extras)}" if extras else TESTS
        licence = self._stated.get(name) or _licence(name)
        return Package(name, self._locked.get(name, ""), licence, used, self._reasons.get(name, ""))


def _is(name: str, requirement: Requirement) -> bool:
    return canonicalize_name(requirement.name) == name


def _installed(name: str) -> str:
    """The version of a package that is installed, without the name of one index's build; else nothing."""
    try:
        return distribution(name).version.partition("+")[0]
    except PackageNotFoundError:
        return ""


@cache
def _licence(name: str) -> str:
    try:
        return licence_of(distribution(name))
    except PackageNotFoundError:
        return ""


@cache
def _required(name: str, extra: str) -> list[Requirement]:
    """What an installed package requires here, with one of its extras."""
    try:
        lines = distribution(name).requires or []
    except PackageNotFoundError:
        return []
    found = map(Requirement, lines)
    return [one for one in found if one.marker is None or one.marker.evaluate({"extra": extra})]


def page(dependencies: Dependencies) -> str:
    """The page of all dependencies."""
    direct = [one for one in dependencies.packages if one.reason]
    others = [one for one in dependencies.packages if not one.reason]
    return "".join(
        (
            HEAD,
            "\n## Ours\n\n",
            _table(["package", "version", "licence", "with", "why this one"], direct),
            "\n## What they need\n\n",
            _table(["package", "version", "licence", "with"], others),
            BUNDLED,
        )
    )


def _table(columns: Sequence[str], packages: Iterable[Package]) -> str:
    lines = [columns, ["---"] * len(columns)]
    lines += [[one.name, one.version, one.licence, one.used, one.reason][: len(columns)] for one in packages]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def main() -> int:
    """Write the page; status 1 with a line for each thing that is wrong, and the page left as it is."""
    dependencies = Dependencies.ours()
    complaints = dependencies.complaints()
    complaints += [
        f"{one}: not the lock's version: launch.py --locked dependencies" for one in dependencies.unlocked()
    ]
    if complaints:
        sys.stderr.write("".join(f"{one}\n" for one in complaints))
        return 1
    PAGE.write_text(page(dependencies))
    return 0


if __name__ == "__main__":
    sys.exit(main())
