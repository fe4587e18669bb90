"""Where a process of :mod:`injector.pristine` begins: a script, ``start.py MODULE ARGUMENT ...``.

Python keeps a list of what lies in each folder that it imports from. Our packages' folder is that of a
checkout: a file more in it, and all that comes after lies elsewhere in memory. So it is not listed.
"""

from __future__ import annotations

import os
import runpy
import site
import sys
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location


class Folder:
    """Finds the packages in a folder by looking for each under its name."""

    def __init__(self, folder: str) -> None:
        self._folder = folder

    def find_spec(self, name: str, target: object = None) -> ModuleSpec | None:  # noqa: ARG002 - importlib's
        """The package of that name, if it lies here."""
        package = os.path.join(self._folder, name)  # noqa: PTH118 - pathlib is not imported yet
        initial = os.path.join(package, "__init__.py")  # noqa: PTH118
        if not os.path.isfile(initial):  # noqa: PTH113
            return None
        return spec_from_file_location(name, initial, submodule_search_locations=[package])


def main() -> None:
    """Run the module."""
    os.environ["PYTHONPATH"] = os.environ.pop("ZENFI_PATH")  # for what this process starts
    path = os.environ["PYTHONPATH"].split(os.pathsep)
    sys.path[:0] = path
    sys.path_importer_cache[path[0]] = Folder(path[0])
    site.main()
    from injector.keys import CONSTANT_RANDOM  # noqa: PLC0415 - now it can be found

    CONSTANT_RANDOM.begin()
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
