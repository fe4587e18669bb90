"""Where a process of :mod:`injector.reproducible.launch` begins: a script, ``start.py MODULE ARGUMENT ...``.

Python keeps a list of what lies in each folder that it imports from. Our packages' folder is that of a
checkout: a file more in it, and all that comes after lies elsewhere in memory. So it is not listed, nor is
site-packages (:mod:`injector.reproducible.installed_packages`): all sorts of modules lie there.
"""

from __future__ import annotations

import os
import runpy
import sys
from importlib.machinery import BYTECODE_SUFFIXES, EXTENSION_SUFFIXES, SOURCE_SUFFIXES, ModuleSpec
from importlib.util import spec_from_file_location

# pathlib is not imported yet, and need not be.
# ruff: noqa: PTH112, PTH113, PTH118, PTH120

_SUFFIXES = EXTENSION_SUFFIXES + SOURCE_SUFFIXES + BYTECODE_SUFFIXES
"""In the order in which Python tries them."""


STANDARD = (113, 114, 115)
"""Descriptors of the standard streams until all is imported: what they are changes what libraries reserve."""


class ImportFolder:
    """Finds what Python would find in a folder, by looking for each name instead of listing the folder."""

    def __init__(self, folder: str) -> None:
        self._folder = folder

    def find_spec(self, name: str, target: object = None) -> ModuleSpec | None:  # noqa: ARG002 - importlib's
        """The package, the module or the part of a namespace package of that name, if it lies here."""
        place = os.path.join(self._folder, name)
        is_folder = os.path.isdir(place)
        for suffix in _SUFFIXES if is_folder else ():
            initial = os.path.join(place, f"__init__{suffix}")
            if os.path.isfile(initial):
                return spec_from_file_location(name, initial, submodule_search_locations=[place])
        for suffix in _SUFFIXES:
            if os.path.isfile(place + suffix):
                return spec_from_file_location(name, place + suffix)
        if not is_folder:
            return None
        namespace = ModuleSpec(name, None)
        namespace.submodule_search_locations = [place]
        return namespace


def give_back_standard_streams() -> None:
    """Undo what :mod:`injector.reproducible.launch` did; nothing happens the second time."""
    for descriptor, aside in enumerate(STANDARD):
        try:
            os.dup2(aside, descriptor)
        except OSError:
            return
        os.close(aside)


def main() -> None:
    """Run the module that the first argument names, once its imports are found without listing our folder."""
    os.environ["PYTHONPATH"] = os.environ.pop("ZENFI_PATH")  # for what this process starts
    own = os.path.dirname(os.path.dirname(os.path.dirname(__file__)))
    named = os.environ["PYTHONPATH"].split(os.pathsep)
    sys.path[:0] = [folder for folder in named if folder and folder != own]
    # After the standard library, so that no file in it takes the place of a module there.
    sys.path.append(own)
    sys.path_importer_cache[own] = ImportFolder(own)
    from injector.reproducible import installed_packages  # noqa: PLC0415 - found now

    installed_packages.add_all(ImportFolder)
    from injector.reproducible.fixed_libc import FIXED_LIBC  # noqa: PLC0415 - now it can be found

    FIXED_LIBC.begin()
    installed_packages.offer_only_our_plug_ins()  # behind that: it imports what draws numbers
    del sys.argv[0]
    try:
        runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
    except BaseException:
        give_back_standard_streams()
        raise


if __name__ == "__main__":
    main()
