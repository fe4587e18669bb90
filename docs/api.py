"""Build the API reference from docstrings: ``python3 launch.py docs``, or ``python docs/api.py FOLDER``."""

import importlib
import pkgutil
import re
import sys
import warnings
from pathlib import Path

import pdoc

ROOT = Path(__file__).parents[1]
PACKAGES = ("services", "sim", "injector", "detector", "deploy", "dashboard", "zenfi")
NOT_IMPORTED = ("__main__", "migrations")
"""Parts of names of modules that act when they are imported."""

PRIVATE = re.compile(r'<a href="#_[^"]*">(.*?)</a>')
"""A link to a private base class, which has no entry of its own."""


def modules() -> list[str]:
    """Names of all modules of ours that can be imported without anything else happening."""
    found = list(PACKAGES)
    for package in PACKAGES:
        where = [str(ROOT / package)]
        found += [
            one.name
            for one in pkgutil.walk_packages(where, f"{package}.")
            if not any(part in one.name for part in NOT_IMPORTED)
        ]
    return found


def build(folder: Path) -> int:
    """Write a page for each module into ``folder``; how many."""
    names = modules()
    # pdoc imports with subprocesses switched off, which some packages start when they are imported.
    for name in names:
        importlib.import_module(name)
    hidden = [f"!{package}.*{part}" for package in PACKAGES for part in NOT_IMPORTED]
    # Annotations that only type checkers import are shown as they are written.
    warnings.filterwarnings("ignore", message="Error parsing type annotation")
    pdoc.render.configure(docformat="restructuredtext", footer_text="ZenFI", show_source=False, search=True)
    pdoc.pdoc(*PACKAGES, *hidden, output_directory=folder)
    for page in folder.rglob("*.html"):
        page.write_text(PRIVATE.sub(r"\1", page.read_text()))
    return len(names)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    to = Path(sys.argv[1])
    sys.stdout.write(f"{build(to)} modules: {to / 'index.html'}\n")
