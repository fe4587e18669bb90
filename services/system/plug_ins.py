"""Finds what other installed packages add: planners, guards, worlds, pilots, masks, signals and detectors.

Each is an entry point of the group ``zenfi.KIND``; its class is in :data:`KINDS`. Nothing is imported before
it is asked for. What comes along is declared in its own table and looked up there first.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

Own = TypeVar("Own")

OURS = "zenfi"
"""The package whose own entry points are no plug-ins."""


class UnknownPlugInError(ValueError):
    """No such plug-in is installed, or it cannot be used: one line that names it."""


class Kind(NamedTuple):
    """A kind of plug-in: what one is called, of which class an entry point must be, and which names are ours.

    ``own`` is a table of names, or a function of them; empty: what comes along is an entry point, too.
    ``subclass``: the entry point is a class itself, not an object.
    """

    singular: str
    of: str
    own: str = ""
    subclass: bool = False


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "detectors": Kind("detector", "detector.schemes.base:Scheme", subclass=True),
        "guards": Kind("guard", "services.models.plug_ins:MessageGuard", "services.models.pilots:GUARDS"),
        "masks": Kind(
            "mask",
            "services.models.faults.mask_histogram:MaskHistogram",
            "services.models.faults.specification:MASK_KINDS",
        ),
        "pilots": Kind("pilot", "services.models.pilots:Pilot", "services.models.pilots:PILOTS"),
        "planners": Kind("planner", "services.models.plug_ins:OmplPlanner", "services.kernels:KERNELS"),
        "signals": Kind(
            "signal", "services.models.plug_ins:Signal", "services.models.oracles.properties:SIGNALS"
        ),
        "worlds": Kind("world", "services.models.plug_ins:WorldGenerator", "sim.world:own_worlds"),
    }
)


class PlugIn(NamedTuple):
    """One plug-in as it is installed; ``problem`` says why it cannot be used, and is empty if it can."""

    kind: str
    name: str
    value: str
    package: str
    version: str
    problem: str


_NOT_CODE = frozenset({"", ".pyc", ".json", ".txt"})
"""Suffixes of what a package's installation writes, which differs from one to the next."""

_told: dict[tuple[str, str], EntryPoint] = {}


def tell(references: Mapping[str, str]) -> None:
    """Say, by ``KIND/NAME``, where the plug-ins of this process are, so that it need not look for them.

    What a node reads of the packages that are installed would be in its memory, in which users differ.
    """
    for place, value in references.items():
        kind, _, name = place.partition("/")
        _told[kind, name] = EntryPoint(name, value, f"zenfi.{kind}")


@cache
def _installed(kind: str) -> Mapping[str, tuple[EntryPoint, ...]]:
    """The entry points of a kind by name, sorted; of more than one nobody knows which is meant."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for point in sorted(entry_points(group=f"zenfi.{kind}"), key=lambda point: (point.name, point.value)):
        found[point.name] = (*found.get(point.name, ()), point)
    return MappingProxyType(found)


def names(kind: str) -> list[str]:
    """The names of the installed plug-ins of a kind, sorted."""
    return list(_installed(kind))


def is_installed(kind: str, name: str) -> bool:
    """Whether a plug-in of that name is there; it is not imported."""
    return (kind, name) in _told or name in _installed(kind)


def find(kind: str, name: str, own: Mapping[str, Own]) -> Own:
    """What has that name: in the table of ours, else a plug-in.

    :raises UnknownPlugInError: if there is neither, naming all that are, or the plug-in cannot be used.
    """
    if name in own:
        return own[name]
    if not is_installed(kind, name):
        raise UnknownPlugInError(unknown(kind, name, own))
    added: Own = load(kind, name)
    return added


def unknown(kind: str, name: str, own: Iterable[str]) -> str:
    """What is said of a name that nobody has: which names there are, ``own`` and installed."""
    return f"unknown {KINDS[kind].singular} {name!r}; known: {', '.join((*own, *names(kind)))}"


def reference(kind: str, name: str) -> str:
    """Where a plug-in is: ``module:name``.

    :raises UnknownPlugInError: if there is none of that name, or more than one.
    """
    return _point(kind, name).value


def load(kind: str, name: str) -> Any:
    """A plug-in, imported, of the class that :data:`KINDS` says.

    :raises UnknownPlugInError: if there is none of that name, or it cannot be used.
    """
    point = _point(kind, name)
    what = f"{KINDS[kind].singular} {name!r} ({point.value})"
    try:
        found = point.load()
    except Exception as error:
        message = f"{what} cannot be imported: {error}"
        raise UnknownPlugInError(message) from error
    of, subclass = KINDS[kind].of, KINDS[kind].subclass
    wanted = resolve_name(of)
    if not (isinstance(found, type) and issubclass(found, wanted) if subclass else isinstance(found, wanted)):
        article = "subclass of" if subclass else "object of class"
        message = f"{what} is no {article} {of.replace(':', '.')}"
        raise UnknownPlugInError(message)
    return found


def _point(kind: str, name: str) -> EntryPoint:
    if (kind, name) in _told:
        return _told[kind, name]
    points = _installed(kind).get(name, ())
    singular = KINDS[kind].singular
    if not points:
        message = f"unknown {singular} {name!r}; installed: {', '.join(names(kind)) or 'none'}"
        raise UnknownPlugInError(message)
    if len(points) > 1:
        message = f"{singular} {name!r} is in {' and in '.join(map(_package, points))}: uninstall all but one"
        raise UnknownPlugInError(message)
    return points[0]


def _package(point: EntryPoint) -> str:
    return "?" if point.dist is None else str(point.dist.name)


def listing() -> list[PlugIn]:
    """Every plug-in that is installed, those that come along among them, each imported to see if it works."""
    return [
        PlugIn(
            KINDS[kind].singular,
            name,
            point.value,
            _package(point),
            "?" if point.dist is None else point.dist.version,
            _problem(kind, name),
        )
        for kind in KINDS
        for name, points in _installed(kind).items()
        for point in points
    ]


def _problem(kind: str, name: str) -> str:
    own = resolve_name(KINDS[kind].own) if KINDS[kind].own else ()
    if name in (own() if callable(own) else own):
        return f"zenfi has a {KINDS[kind].singular} of that name, which is used instead"
    try:
        load(kind, name)
    except UnknownPlugInError as error:
        return str(error)
    return ""


@cache
def digest() -> str:
    """A digest of all plug-ins of other packages: of names, versions and files; empty if none is installed.

    What is known of flights holds for one such digest only. All files of a package count but compiled ones.
    Of one that is installed editable, the module that the entry point names counts.
    """
    parts = list(_parts())
    told = hashlib.sha256()
    for part in parts:
        told.update(len(part).to_bytes(8) + part)
    return told.hexdigest()[:12] if parts else ""


def _parts() -> Iterator[bytes]:
    for kind in KINDS:
        for points in _installed(kind).values():
            for point in points:
                if _package(point) != OURS:
                    version = "" if point.dist is None else point.dist.version
                    yield f"{kind} {point.name} {point.value} {_package(point)} {version}".encode()
                    yield from (file.read_bytes() for file in _files(point))


def _files(point: EntryPoint) -> list[Path]:
    """The files of a plug-in's package, in order, and its module, which may lie elsewhere."""
    listed = [] if point.dist is None else point.dist.files or []
    found = {Path(str(file.locate())) for file in listed if file.suffix not in _NOT_CODE}
    with suppress(ImportError, ValueError):
        module = find_spec(point.module)
        if module is not None and module.origin is not None:
            found.add(Path(module.origin))
    return sorted(file for file in found if file.is_file())
