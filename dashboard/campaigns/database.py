"""The SQLite file of the store: opened in WAL mode, brought up to date, kept within its quota."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from deploy.check import BadSpecError

REVISION = "0001"
"""The newest step in ``migrations/versions``."""

PAGE_BYTES = 4096
PRAGMAS = (
    "journal_mode=WAL",
    # A crash of the machine may take the last results with it; they are flown again.
    "synchronous=NORMAL",
    "foreign_keys=ON",
    "busy_timeout=30000",
)
_FULL = ("database or disk is full", "disk I/O error")


class StoreFullError(Exception):
    """There is no room for another result; what was written before stands."""


class Database:
    """Connections to one file.

    :raises BadSpecError: if it is no store, or one of a newer zenfi.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._max_pages = 0
        self._engine = sa.create_engine(f"sqlite:///{path}")
        sa.event.listen(self._engine, "connect", self._configure)
        try:
            self._upgrade()
        except sa.exc.DBAPIError as error:
            message = f"store {path}: {error.orig}"
            raise BadSpecError(message) from error

    def close(self) -> None:
        """Close every connection."""
        self._engine.dispose()

    def reading(self) -> AbstractContextManager[sa.Connection]:
        """A connection that only reads."""
        return self._engine.connect()

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """A transaction.

        :raises StoreFullError: if the disk or the quota is full; nothing of it is written then.
        """
        try:
            with self._engine.begin() as connection:
                yield connection
        except sa.exc.OperationalError as error:
            if not any(words in str(error.orig) for words in _FULL):
                raise
            message = f"{self._path}: {error.orig}"
            raise StoreFullError(message) from error

    def limit(self, disk_mb: int) -> None:
        """Let the file grow to ``disk_mb`` and no further."""
        self._max_pages = disk_mb * 1_000_000 // PAGE_BYTES
        self._engine.dispose()  # the limit is each connection's own

    def _configure(self, connection: Any, _: object) -> None:
        for pragma in PRAGMAS:
            connection.execute(f"PRAGMA {pragma}")
        if self._max_pages:
            connection.execute(f"PRAGMA max_page_count={self._max_pages}")

    def _upgrade(self) -> None:
        # Two processes may meet at a store that is not made yet.
        with self._path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            with self._engine.connect() as connection:
                found = None
                if sa.inspect(connection).has_table("alembic_version"):
                    found = connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar()
                if found is not None and found > REVISION:
                    message = f"store {self._path}: written by a newer zenfi (form {found})"
                    raise BadSpecError(message)
                if found != REVISION:
                    connection.rollback()
                    migrate(connection)


def migrate(connection: sa.Connection) -> None:
    """Bring the tables to the newest form."""
    # Slow to import, and needed once in a store's life.
    from alembic import command  # noqa: PLC0415
    from alembic.config import Config  # noqa: PLC0415

    config = Config()
    config.set_main_option("script_location", "dashboard.campaigns:migrations")
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    command.upgrade(config, "head")
    connection.commit()
