"""Compare the ids of the tests of two trees, what is gone and what is new: ``ids.py BEFORE AFTER``."""

import subprocess
import sys


def ids(folder: str) -> set[str]:
    """The ids of all tests, of every tier."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider"]
    said = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout
    return {line for line in said.splitlines() if "::" in line}


if __name__ == "__main__":
    before, after = (ids(folder) for folder in sys.argv[1:3])
    print(f"{len(before)} before, {len(after)} after")
    for title, found in (("gone", before - after), ("new", after - before)):
        print(f"{title}: {len(found)}", *sorted(found), sep="\n  ")
