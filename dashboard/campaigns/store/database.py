"""What the store asks of a database: connections, transactions, one lock a campaign, a quota."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

import sqlalchemy as sa

from deploy.errors import BadSpecError

REVISION = "0010"
"""The newest step in ``migrations/versions``."""


class StoreError(Exception):
    """The database cannot take another result; what was written before stands."""


class StoreFullError(StoreError):
    """There is no room for another result."""


class StoreLostError(StoreError):
    """The database is out of reach, and with it the lock of who was writing."""


class Database(ABC):
    """Connections to one database. ``place`` is what people call it: never with a password."""

    file: tuple[int, int] | None = None
    """Device and inode of the one file that it is, if it is one."""
    read_only = False
    """Whether it was opened only to be read."""

    def __init__(self, engine: sa.Engine, place: str) -> None:
        self.place = place
        self.engine = engine

    def close(self) -> None:
        """Close every connection to the database."""
        self.engine.dispose()

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        """A connection that only reads.

        :raises StoreLostError: if there is none.
        """
        with self._told(), self.engine.connect() as connection:
            yield connection

    @contextmanager
    def writing(self, campaign: int | None = None) -> Iterator[sa.Connection]:
        """A transaction; of the one that flies ``campaign``, it stands and falls with its lock.

        :raises StoreError: if nothing can be written; nothing of it is written then.
        """
        with self._told(), self._transaction(campaign) as connection:
            yield connection

    @abstractmethod
    def limit(self, disk_mb: int) -> None:
        """Let the database grow to ``disk_mb`` and no further."""

    @abstractmethod
    def lock(self, campaign: int) -> AbstractContextManager[bool]:
        """Hold a campaign's lock, if it was free; freed when this process ends, however it ends."""

    @abstractmethod
    def _transaction(self, campaign: int | None) -> AbstractContextManager[sa.Connection]: ...

    @abstractmethod
    def _meaning(self, error: sa.exc.DBAPIError) -> StoreError | None:
        """What an error of the driver means to the store, if anything."""

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except sa.exc.DBAPIError as error:
            meaning = self._meaning(error)
            if meaning is None:
                raise
            raise meaning from error
        except ConnectionError as error:  # a driver may pass on what the socket said
            message = f"{self.place}: {error.strerror or error}"
            raise StoreLostError(message) from error

    def refuse_read_only(self) -> None:
        """Refuse to change a store that was opened only to be read.

        :raises BadSpecError: if it was opened only to be read.
        """
        if self.read_only:
            message = f"store {self.place}: it may only be read: copy it (zenfi store backup) to change it"
            raise BadSpecError(message)

    def upgrade(self) -> None:
        """Bring the tables to the newest form; nobody else may do so meanwhile.

        :raises BadSpecError: if they are of a newer zenfi.
        """
        with self.engine.connect() as connection:
            if self._form(connection) != REVISION:
                connection.rollback()
                migrate(connection)

    def refuse_older(self) -> None:
        """Of a store that may only be read.

        :raises BadSpecError: if its tables are not of the newest form.
        """
        with self.engine.connect() as connection:
            if (found := self._form(connection)) != REVISION:
                message = (
                    f"store {self.place}: of an older form ({found}), and it may only be read: open a copy"
                )
                raise BadSpecError(message)

    def _form(self, connection: sa.Connection) -> str | None:
        """The form of the tables, None if there are none."""
        found = None
        if sa.inspect(connection).has_table("alembic_version"):
            found = connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar()
        if found is not None and found > REVISION:
            message = f"store {self.place}: written by a newer zenfi (form {found})"
            raise BadSpecError(message)
        return found


def migrate(connection: sa.Connection, revision: str = "head") -> None:
    """Bring the tables to a form, by default the newest."""
    # Slow to import, and needed once in a store's life.
    from alembic import command  # noqa: PLC0415
    from alembic.config import Config  # noqa: PLC0415

    config = Config()
    config.set_main_option("script_location", "dashboard.campaigns.store:migrations")
    config.set_main_option("path_separator", "os")
    config.attributes["connection"] = connection
    if connection.dialect.name == "sqlite":
        # Its driver begins no transaction for tables; one that is killed midway would leave half a step.
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    command.upgrade(config, revision)
    connection.commit()
