"""Dependencies: each has a reason and a licence that leaves ours as it is, and the page says so."""

import tomllib
from email.message import Message
from importlib.metadata import Distribution
from pathlib import Path
from typing import Any

import pytest
from packaging.utils import canonicalize_name

from release.dependencies import BUNDLED, HEAD, LOCK, PAGE, ROOT, Dependencies, page
from release.licences import is_accepted, licence_of

PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture(scope="module")
def ours() -> Dependencies:
    return Dependencies.ours()


def test_each_dependency_has_a_reason_and_an_accepted_licence(ours: Dependencies) -> None:
    assert ours.complaints() == []


def rows(text: str) -> dict[str, list[str]]:
    """The columns of the page's tables by name of package: version, licence, with what, why."""
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return {name: columns for name, *columns in lines if name not in ("package", "---")}


def test_the_page_is_what_is_generated(ours: Dependencies) -> None:
    written, generated, newer = rows(PAGE.read_text()), rows(page(ours)), ours.unlocked()
    assert set(ours.direct) <= set(written)
    assert PAGE.read_text().startswith(HEAD)
    assert PAGE.read_text().endswith(BUNDLED)
    # What is newer here than in the lock may have another licence by now, and bring others along.
    same = [name for name in generated if name in written and name not in newer]
    compared = [0, 1, 3] if newer else [0, 1, 2, 3]
    for name in same:
        columns = [[one[n] for n in compared if n < len(one)] for one in (written[name], generated[name])]
        assert columns[0] == columns[1], f"{name}: python3 launch.py --locked dependencies"


def test_the_page_has_the_versions_of_the_lock_and_no_others() -> None:
    versions = {name: columns[0] for name, columns in rows(PAGE.read_text()).items()}
    pinned = (line.split("==") for line in LOCK.read_text().splitlines() if not line.startswith("#"))
    assert versions == {canonicalize_name(name): version for name, version in pinned}


def changed(what: str, **entries: str | None) -> Dependencies:
    """Ours, had a table of ``pyproject.toml`` these entries (None: not that one)."""
    given = {**PYPROJECT["tool"]["zenfi"], what: {**PYPROJECT["tool"]["zenfi"][what], **entries}}
    given[what] = {name: value for name, value in given[what].items() if value is not None}
    return Dependencies({**PYPROJECT, "tool": {"zenfi": given}}, LOCK.read_text())


@pytest.mark.parametrize(
    ("dependencies", "told"),
    [
        (
            changed("dependencies", numpy=None),
            "numpy: say in [tool.zenfi.dependencies] in pyproject.toml why",
        ),
        (changed("dependencies", nothing="no reason"), "nothing: not required: remove it"),
        (changed("licences", nothing="MIT"), "nothing: not required: remove it"),
        (changed("licences", apsw=None), "apsw: tells no licence: state it in"),
        (changed("licences", anyio="GPL-3.0-only"), "anyio: its licence is not accepted: GPL-3.0-only"),
    ],
)
def test_what_is_wrong_is_told_in_a_line(dependencies: Dependencies, told: str) -> None:
    (complaint,) = dependencies.complaints()
    assert complaint.startswith(told)


def test_what_a_dependency_brings_along_is_judged_too(ours: Dependencies) -> None:
    found = {one.name: one for one in ours.packages}
    assert found["starlette"].used == "all"
    assert found["llvmlite"].used == "all"
    assert found["dask"].used == "extra dask, docs"
    assert found["iniconfig"].used == "test"
    assert found["capstone"].used == 'all, where platform_machine == "aarch64"'
    assert "llvmlite" in ours.needs("numba")


class Described(Distribution):
    """A package of which only these metadata are known."""

    def __init__(self, fields: dict[str, Any]) -> None:
        self._fields = fields

    def read_text(self, filename: str) -> str | None:
        message = Message()
        for name, value in self._fields.items():
            for one in value if isinstance(value, list) else [value]:
                message[name] = one
        return message.as_string() if filename == "METADATA" else None

    def locate_file(self, path: Any) -> Any:
        return Path(path)


@pytest.mark.parametrize(
    ("fields", "licence"),
    [
        ({"License-Expression": "MIT OR GPL-2.0-only", "License": "whatever"}, "MIT OR GPL-2.0-only"),
        ({"License": "MIT License"}, "MIT"),
        ({"License": "GPLv3", "Classifier": ["License :: OSI Approved :: MIT License"]}, "GPLv3"),
        ({"License": "UNKNOWN", "Classifier": ["License :: OSI Approved :: BSD License"]}, "BSD"),
        (
            {"Classifier": [f"License :: OSI Approved :: {one}" for one in ("MIT License", "BSD License")]},
            "BSD AND MIT",
        ),
        ({"Classifier": ["License :: OSI Approved", "Topic :: Software Development"]}, ""),
        ({}, ""),
    ],
)
def test_a_licence_is_what_the_metadata_say(fields: dict[str, Any], licence: str) -> None:
    assert licence_of(Described({"Name": "x", **fields})) == licence


@pytest.mark.parametrize(
    ("expression", "accepted"),
    [
        ("MIT", True),
        ("MPL-2.0 AND (Apache-2.0 OR MIT)", True),
        ("Apache-2.0 WITH LLVM-exception", True),
        ("LGPL-2.1-or-later", True),
        ("MIT OR GPL-3.0-only", True),
        ("MIT AND GPL-3.0-only", False),
        ("GPL-3.0-or-later WITH GCC-exception-3.1", False),
        ("AGPL-3.0-only", False),
        ("GNU General Public License (GPL)", False),
        ("Proprietary", False),
        ("", False),
    ],
)
def test_accepted_is_what_leaves_our_licence_as_it_is(expression: str, accepted: bool) -> None:
    assert is_accepted(expression) is accepted
