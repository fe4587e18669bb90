"""What is installed beside the packages that we import must not come into memory: users differ in it.

Python lists site-packages to find modules, runs what packages leave there for its beginning, and reads the
data of all packages to find those that extend others; and some packages import others if they are there.
Here a fork lists the folder and tells what is asked for, and what is optional is not found. Nothing else of
ours is imported here: this runs before anything can be found.
"""

from __future__ import annotations

import os
import site
import sys
from collections.abc import Callable, Iterator
from typing import Any

_LONGEST = 1 << 16
_OURS = "zenfi."

_OPTIONAL = frozenset(
    {"Cython", "cffi", "charset_normalizer", "colorama", "coverage", "cython", "scikits", "yaml"}
)
"""What packages that we import would import, too, if it was there."""


def add_all(finder: Callable[[str], Any]) -> None:
    """Do what Python's :mod:`site` does; modules of site-packages are found by ``finder`` of that folder."""
    listed = os.listdir

    def path_files(folder: str) -> list[str]:
        sys.path_importer_cache[folder] = finder(folder)
        return listed_by_a_fork(listed, folder, lambda name: _adds_modules(folder, name))

    os.listdir = path_files  # type: ignore[assignment]
    try:
        site.main()
    finally:
        os.listdir = listed
    sys.meta_path.insert(0, _InstalledPackages)


def listed_by_a_fork(
    listed: Callable[[str], list[str]], folder: str, wanted: Callable[[str], bool]
) -> list[str]:
    """The names in a folder that are wanted, in order."""
    told, tells = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.write(tells, "/".join(sorted(filter(wanted, listed(folder)))).encode())
        finally:
            os._exit(0)  # also if it may not read: the fork must never go on in our place
    os.waitpid(child, 0)
    os.close(tells)
    found = os.read(told, _LONGEST).decode()
    os.close(told)
    return found.split("/") if found else []


def _adds_modules(folder: str, name: str) -> bool:
    """Whether a file of site-packages adds modules: folders, or a package that is being worked on.

    Others run code that changes every Python, as that of setuptools does. Our own modules are found without
    theirs, which lists what lay in our folder when it was made.
    """
    if not name.endswith(".pth"):
        return False
    if name.startswith("__editable__"):
        return not name.startswith(f"__editable__.{_OURS[:-1]}-")
    with open(f"{folder}/{name}", encoding="utf-8", errors="replace") as file:  # noqa: PTH123 - no pathlib yet
        return not any(line.startswith(("import ", "import\t")) for line in file)


def offer_all_packages() -> None:
    """Have everything found that is installed, from now on."""
    _InstalledPackages.hidden = frozenset()


class _InstalledPackages:
    """Finds the data of an installed package for :mod:`importlib.metadata`, and hides optional modules."""

    hidden = _OPTIONAL

    @classmethod
    def find_spec(cls, name: str, _path: object = None, _target: object = None) -> None:
        """Leave the search for a module to the other finders.

        :raises ModuleNotFoundError: if it is hidden.
        """
        if name in cls.hidden:
            message = f"No module named {name!r}"
            raise ModuleNotFoundError(message, name=name)

    @staticmethod
    def find_distributions(context: Any) -> Iterator[Any]:
        """The package that the context names; who names none asks the other finders."""
        if context.name is None:
            return
        from importlib.metadata import PathDistribution  # noqa: PLC0415 - not before somebody asks
        from pathlib import Path  # noqa: PLC0415

        begin = context.name.replace("-", "_").lower() + "-"

        def is_asked_for(name: str) -> bool:
            return name.lower().startswith(begin) and name.endswith(".dist-info")

        for folder in filter(os.path.isdir, sys.path):
            for name in listed_by_a_fork(os.listdir, folder, is_asked_for):
                yield PathDistribution(Path(folder, name))


def offer_only_our_plug_ins() -> None:
    """Some (numba, pydantic) look for packages that extend them, and would read what every package offers."""
    import importlib.metadata  # noqa: PLC0415 - now it can be found

    every = importlib.metadata.entry_points

    def entry_points(**wanted: Any) -> Any:
        ours = str(wanted.get("group")).startswith(_OURS)
        return every(**wanted) if ours else importlib.metadata.EntryPoints(())

    importlib.metadata.entry_points = entry_points
