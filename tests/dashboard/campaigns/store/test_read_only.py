"""A store that may not be written to is read, and says so to who would change it."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from dashboard.campaigns.results.summary import summary
from dashboard.campaigns.store.listing import line
from dashboard.campaigns.store.store import Store
from deploy.errors import BadSpecError
from tests.dashboard.campaigns.store.test_migrations import WRITTEN, written
from tests.dashboard.campaigns.store.test_store import SPEC, flown
from tests.fixtures.another_user import as_nobody


@pytest.fixture
def archive() -> Iterator[Path]:
    """A folder that others may read, and nobody but root may write to."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "archive"
        yield folder
        _modes(folder, 0o755, 0o644)


def _modes(folder: Path, of_folders: int, of_files: int) -> None:
    folder.parent.chmod(0o755)
    for path in (folder, *folder.rglob("*")):
        path.chmod(of_folders if path.is_dir() else of_files)


def found(folder: Path, look: Callable[[], list[str]]) -> list[str]:
    """What is found in the folder by a user who may only read it."""
    _modes(folder, 0o555, 0o444)
    return as_nobody(look) if os.geteuid() == 0 else look()


def test_it_is_read_as_any_other(archive: Path) -> None:
    with closing(Store(archive)) as store:
        flown(store, store.create(SPEC), 1)
        expected = [
            line(store, store.find("1")).model_dump_json(),
            *map(str, summary(store, store.find("1"))),
        ]
    before = sorted(one.name for one in archive.iterdir())

    def look() -> list[str]:
        with closing(Store(archive)) as store:
            one = store.find("x-1")
            return [line(store, one).model_dump_json(), *map(str, summary(store, one))]

    assert found(archive, look) == expected
    assert sorted(one.name for one in archive.iterdir()) == before


def test_who_would_change_it_is_told(archive: Path) -> None:
    with closing(Store(archive)) as store:
        store.create(SPEC)

    def look() -> list[str]:
        told = []
        with closing(Store(archive)) as store:
            one = store.find("1")
            for change in (
                lambda: store.create(SPEC),
                lambda: store.set_desired_state(one, "pause"),
                lambda: store.delete(one),
                lambda: store.artefacts(one),
                store.database.refuse_read_only,
            ):
                try:
                    change()
                except BadSpecError as error:
                    told.append(str(error).rpartition(": ")[2])
        return told

    assert found(archive, look) == ["copy it (zenfi store backup) to change it"] * 5


def test_an_older_form_is_read_from_a_copy(archive: Path) -> None:
    written(WRITTEN[0], archive)

    def look() -> list[str]:
        try:
            Store(archive)
        except BadSpecError as error:
            return [str(error).partition(": ")[2]]
        return []

    (archive / "artefacts").mkdir()
    assert found(archive, look) == ["of an older form (0001), and it may only be read: open a copy"]
    copy = archive.parent / "copy"
    _modes(archive, 0o755, 0o644)
    shutil.copytree(archive, copy)
    with closing(Store(copy)) as store:
        assert store.find("x-1").label == "x-1"


def test_it_is_read_while_another_user_flies(archive: Path) -> None:
    with closing(Store(archive)) as store:
        campaign = store.create(SPEC)

        def look() -> list[str]:
            with closing(Store(archive)) as theirs:
                return [str(theirs.progress(theirs.find("1"))["done"])]

        assert found(archive, look) == ["0"]
        flown(store, campaign, 1)
        assert found(archive, look) == ["1"]
