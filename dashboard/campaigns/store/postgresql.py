"""The store in a PostgreSQL database, named by a URL: advisory locks, a quota on its size.

The lock of who flies a campaign belongs to a session of the server, and so do its transactions: if the
server loses one, the other is gone too, and nobody writes without the lock.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import ssl
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any
from urllib.parse import unquote

import sqlalchemy as sa

from dashboard.campaigns.store.database import Database, StoreError, StoreFullError, StoreLostError
from deploy.errors import BadSpecError

FORM = "postgresql://USER@HOST/DATABASE, or postgresql://USER@/DATABASE?host=FOLDER of a socket"
PORT = 5432
ANSWER_S = 60.0
"""Wall time that the server has for any answer."""

LOCKS = 0x7A656E66
"""First half of our advisory locks; the second is a campaign's number, 0 for changes of form."""

_NUMERIC = 1700
"""The type's number in the server's catalogue, pg_type."""

_FULL = "53100"
_LOST = ("08", "57P")
"""SQLSTATE: disk full; connection exceptions, the operator's intervention."""


def parse(url: str) -> sa.URL:
    """Parse and check the URL of a store.

    :raises BadSpecError: if it is none; the password is not repeated.
    """
    try:
        parsed = sa.make_url(url)
    except (sa.exc.ArgumentError, ValueError):
        parsed = None
    if parsed is None or parsed.drivername not in ("postgresql", "postgresql+pg8000"):
        message = f"--store: expected a folder, or {FORM}"
        raise BadSpecError(message)
    unknown = sorted(set(parsed.query) - {"host", "sslmode", "sslrootcert"})
    if unknown or not parsed.database or not (parsed.host or "host" in parsed.query):
        what = f"unknown {unknown[0]!r}" if unknown else "no host or no database"
        message = f"--store: {what} in {shown(parsed)}; expected {FORM}"
        raise BadSpecError(message)
    return parsed


def shown(url: sa.URL) -> str:
    """The URL without its password, to be shown."""
    return unquote(url.render_as_string(hide_password=True))


def connect_arguments(url: sa.URL) -> dict[str, Any]:
    """What the driver is told: a socket's folder; encryption and a known certificate outside this machine.

    :raises BadSpecError: if ``sslmode`` is something else, or the certificate cannot be read.
    """
    arguments: dict[str, Any] = {"timeout": ANSWER_S, "application_name": "zenfi"}
    folder = url.query.get("host")
    if folder is not None:
        return {**arguments, "unix_sock": f"{folder}/.s.PGSQL.{url.port or PORT}"}
    mode = url.query.get("sslmode", "disable" if _is_here(url.host or "") else "verify-full")
    if mode not in ("disable", "verify-full"):
        message = f"--store: sslmode: expected disable or verify-full, got {mode!r}"
        raise BadSpecError(message)
    if mode == "verify-full":
        certificate = str(url.query["sslrootcert"]) if "sslrootcert" in url.query else None
        try:
            arguments["ssl_context"] = ssl.create_default_context(cafile=certificate)
        except OSError as error:
            message = f"--store: sslrootcert: {certificate}: {error.strerror or error}"
            raise BadSpecError(message) from error
    return arguments


def _is_here(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class PostgresqlDatabase(Database):
    """Connections to one database of a server. The password is the URL's or ``PGPASSWORD``.

    :raises BadSpecError: if the URL names no store, or one of a newer zenfi.
    """

    def __init__(self, url: sa.URL) -> None:
        plain = url.set(drivername="postgresql+pg8000", query={})
        if plain.password is None:
            plain = plain.set(password=os.environ.get("PGPASSWORD"))
        try:
            engine = sa.create_engine(plain, connect_args=connect_arguments(url))
        except ModuleNotFoundError as error:
            message = "a store on PostgreSQL needs its driver: pip install 'zenfi[postgresql]'"
            raise BadSpecError(message) from error
        super().__init__(engine, shown(url))
        # A lost connection is told by our errors, in one line; the pool would print its traceback.
        logging.getLogger("sqlalchemy.pool").addHandler(logging.NullHandler())
        # A campaign's runs come by the thousand: several rows a statement, not one.
        engine.dialect.use_insertmanyvalues_wo_returning = True
        # Means and sums of integers come as numeric: Decimals to the driver, floats from SQLite.
        sa.event.listen(engine, "connect", lambda one, _: one.register_in_adapter(_NUMERIC, float))
        sa.event.listen(
            engine, "checkout", lambda one, record, _: _ask_whether_there(engine.dialect, one, record.info)
        )
        sa.event.listen(engine, "handle_error", _notice_loss)
        self._max_bytes = 0
        self._held: dict[int, sa.Connection] = {}
        try:
            self.identity = self._prepare()
        except sa.exc.DBAPIError as error:
            self.close()
            message = f"store {self.place}: {_words(error)}"
            raise BadSpecError(message) from error
        except BadSpecError:
            self.close()
            raise

    def limit(self, disk_mb: int) -> None:
        """Let the database grow to ``disk_mb`` and no further."""
        self._max_bytes = disk_mb * 1_000_000

    @contextmanager
    def lock(self, campaign: int) -> Iterator[bool]:
        """Hold a campaign's lock, if it was free; transactions for this campaign then use its session."""
        with self._told(), self.engine.connect() as connection:
            got = bool(connection.execute(_TRY, {"campaign": campaign}).scalar())
            connection.commit()
            if not got:
                yield False
                return
            self._held[campaign] = connection
            try:
                yield True
            finally:
                del self._held[campaign]
                self._free(connection, campaign)

    def _free(self, connection: sa.Connection, campaign: int) -> None:
        """Give a campaign's lock back; if its session is lost, the server has already."""
        if connection.invalidated:
            return
        with suppress(StoreLostError), self._told():
            connection.execute(_RELEASE, {"campaign": campaign})
            connection.commit()

    @contextmanager
    def _transaction(self, campaign: int | None) -> Iterator[sa.Connection]:
        held = self._held.get(campaign) if campaign is not None else None
        if held is not None and held.invalidated:
            message = f"{self.place}: the session that held the campaign's lock is gone"
            raise StoreLostError(message)
        if held is None:
            with self.engine.begin() as connection:
                self._check_size(connection)
                yield connection
        else:
            with held.begin():
                self._check_size(held)
                yield held

    def _check_size(self, connection: sa.Connection) -> None:
        if not self._max_bytes:
            return
        size = int(connection.execute(_SIZE).scalar_one())
        if size > self._max_bytes:
            message = f"{self.place}: full: {size / 1e6:.1f} of {self._max_bytes / 1e6:.1f} MB"
            raise StoreFullError(message)

    def _meaning(self, error: sa.exc.DBAPIError) -> StoreError | None:
        code = _told_by_server(error).get("C", "")
        message = f"{self.place}: {_words(error)}"
        if code == _FULL:
            return StoreFullError(message)
        if isinstance(error, sa.exc.InterfaceError) or code.startswith(_LOST) or error.connection_invalidated:
            return StoreLostError(message)
        return None

    def _prepare(self) -> str:
        """Bring the tables to the newest form, one process at a time; who this database is."""
        with self.engine.connect() as connection:
            connection.execute(_WAIT)
            connection.commit()
            try:
                self.upgrade()
            finally:
                connection.execute(_FREE)
                connection.commit()
            return "-".join(str(part) for part in connection.execute(_IDENTITY).one())


_TRY = sa.text(f"SELECT pg_try_advisory_lock({LOCKS}, :campaign)")
_RELEASE = sa.text(f"SELECT pg_advisory_unlock({LOCKS}, :campaign)")
_WAIT = sa.text(f"SELECT pg_advisory_lock({LOCKS}, 0)")
_FREE = sa.text(f"SELECT pg_advisory_unlock({LOCKS}, 0)")
_SIZE = sa.text("SELECT pg_database_size(current_database())")
_IDENTITY = sa.text(
    "SELECT system_identifier, oid FROM pg_control_system(), pg_database WHERE datname = current_database()"
)


def _ask_whether_there(dialect: sa.Dialect, connection: Any, about: dict[str, bool]) -> None:
    """Have the pool take another connection, should the server have ended this one.

    One that is new (nothing is noted ``about`` it) is not asked: it has just answered. SQLAlchemy's own
    ``pool_pre_ping`` fails where the driver passes on what the socket says.
    """
    if not about:
        about["was used"] = True
        return
    try:
        connection.cursor().execute("SELECT 1")
        connection.rollback()
    except (dialect.loaded_dbapi.Error, ConnectionError) as error:
        raise sa.exc.DisconnectionError from error


def _notice_loss(context: sa.ExceptionContext) -> None:
    """SQLAlchemy would keep a connection of which the socket, and not the driver, says that it is lost."""
    if isinstance(context.original_exception, ConnectionError):
        context.is_disconnect = True


def _chain(error: sa.exc.DBAPIError) -> Iterator[BaseException]:
    """The driver's error and what led to it: it may hide the server's words behind a broken pipe."""
    link: BaseException | None = error.orig
    while link is not None:
        yield link
        link = link.__context__


def _told_by_server(error: sa.exc.DBAPIError) -> dict[str, str]:
    """The fields of the server's answer, by their letters in the protocol."""
    answers = (link.args[0] for link in _chain(error) if link.args and isinstance(link.args[0], dict))
    return next(answers, {})


def _words(error: sa.exc.DBAPIError) -> str:
    """What is wrong, in the words of who knows best: the server, the kernel, the driver."""
    refused = (link.strerror for link in _chain(error) if isinstance(link, OSError) and link.strerror)
    return _told_by_server(error).get("M") or next(refused, str(error.orig))
