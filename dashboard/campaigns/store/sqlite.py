"""The store in one SQLite file: WAL, locks that are files, a quota in pages.

What may not be written to is opened to be read: an archive, a snapshot, a colleague's store.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import sqlalchemy as sa

from dashboard.campaigns.store.database import Database, StoreError, StoreFullError, StoreLostError
from deploy.errors import BadSpecError

PAGE_BYTES = 4096
PRAGMAS = (
    "journal_mode=WAL",
    # A crash of the machine may take the last results with it; they are flown again.
    "synchronous=NORMAL",
    "foreign_keys=ON",
    "busy_timeout=30000",
)
_FULL = ("database or disk is full", "disk I/O error")


class SqliteDatabase(Database):
    """Connections to one file, with the locks beside it.

    :raises BadSpecError: if it is no store, or one of a newer zenfi.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._max_pages = 0
        self.read_only = path.exists() and not (os.access(path, os.W_OK) and os.access(path.parent, os.W_OK))
        super().__init__(sa.create_engine(_url(path, read_only=self.read_only)), str(path))
        sa.event.listen(self.engine, "connect", self._configure)
        try:
            if self.read_only:
                self.refuse_older()
                self.file = _identity(path)
                return
            # Two processes may meet at a store that is not made yet.
            _make(path.with_suffix(".lock"))
            with path.with_suffix(".lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                _refuse_half_a_store(path)
                _make(path)
                self.upgrade()
                self.file = _identity(path)
        except (sa.exc.DBAPIError, OSError) as error:
            self.close()
            message = f"store {path}: {error.strerror if isinstance(error, OSError) else error.orig}"
            raise BadSpecError(message) from error
        except BadSpecError:
            self.close()
            raise

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """A connection that only reads."""
        self._refuse_another_file()
        with super().reading() as connection:
            yield connection

    @contextmanager
    def writing(self, campaign: int | None = None) -> Iterator[sa.Connection]:
        """A transaction; what was written into a file that nobody will find again was not written."""
        self.refuse_read_only()
        self._refuse_another_file()
        with super().writing(campaign) as connection:
            yield connection
        self._refuse_another_file()

    def _refuse_another_file(self) -> None:
        """Raise StoreLostError unless the store's path still names the file that we opened."""
        if _identity(self._path) != self.file:
            raise self._lost()

    def _lost(self) -> StoreLostError:
        message = (
            f"store {self.place}: the file was removed or replaced while it was in use: put it back, or "
            "start anew"
        )
        return StoreLostError(message)

    def limit(self, disk_mb: int) -> None:
        """Let the file grow to ``disk_mb`` and no further."""
        self._max_pages = disk_mb * 1_000_000 // PAGE_BYTES
        self.engine.dispose()  # the limit is each connection's own

    @contextmanager
    def lock(self, campaign: int) -> Iterator[bool]:
        """Hold a campaign's lock, if it was free."""
        path = self._path.with_name(f"{campaign}.lock")
        try:
            flags = os.O_RDONLY if self.read_only else os.O_CREAT | os.O_RDWR
            descriptor = os.open(path, flags | os.O_CLOEXEC, 0o600)
        except FileNotFoundError:  # of one that may only be read: it was never flown
            yield True
            return
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
            else:
                yield True
        finally:
            os.close(descriptor)

    def _transaction(self, campaign: int | None) -> AbstractContextManager[sa.Connection]:  # noqa: ARG002
        return self.engine.begin()

    def _meaning(self, error: sa.exc.DBAPIError) -> StoreError | None:
        if _identity(self._path) != self.file:  # since we looked
            return self._lost()
        if not any(words in str(error.orig) for words in _FULL):
            return None
        message = f"{self.place}: {error.orig}"
        return StoreFullError(message)

    def _configure(self, connection: Any, _: object) -> None:
        for pragma in PRAGMAS:
            if not (self.read_only and pragma.startswith("journal_mode")):
                connection.execute(f"PRAGMA {pragma}")
        if self._max_pages:
            connection.execute(f"PRAGMA max_page_count={self._max_pages}")


def _url(path: Path, *, read_only: bool) -> str:
    """Where to open a file. Of one that is gone a connection is to fail, not to make an empty one.

    SQLite's notes of who reads are beside it, if somebody has it open.
    """
    alone = "&immutable=1" if read_only and not path.with_name(f"{path.name}-wal").exists() else ""
    return f"sqlite:///file:{quote(str(path))}?mode={'ro' if read_only else 'rw'}{alone}&uri=true"


def _make(path: Path) -> None:
    """Make a file for the user alone; SQLite makes those beside a store as the store is.

    One that is there is not opened: to close a file ends the locks that SQLite has on it in this process.
    """
    with contextlib.suppress(FileExistsError):
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o600))


def _refuse_half_a_store(path: Path) -> None:
    """Refuse to make a store beside what was written last to one whose file is elsewhere.

    SQLite would take that for the new file's, and remove it.

    :raises BadSpecError: if only that is there.
    """
    log = path.with_name(f"{path.name}-wal")
    if log.exists() and not path.exists():
        message = (
            f"store {path}: the file is gone, but not {log.name}, what was written last: put it back, "
            "or remove that, too"
        )
        raise BadSpecError(message)


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of a file, if it is there."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_dev, found.st_ino
