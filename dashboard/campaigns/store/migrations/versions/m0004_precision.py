"""Stored sites have ``precision`` where they had ``rung``, records of injections where they had ``mode``.

Records have ``probes`` where they had ``scouts``.
"""

import json
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"

_BATCH = 500
"""Rows that are held in memory at a time."""


def upgrade() -> None:
    """Rename the keys in all stored specifications and outcomes."""
    _rewrite("campaigns", "id", "spec", _campaign)
    _rewrite("runs", "id", "spec", _mission)
    _rewrite("results", "run_id", "outcome", _outcome)


def _rewrite(table: str, key: str, column: str, rename: Callable[[Any], Any]) -> None:
    """Rename keys in every document of one column; those that have none of them stay as they are."""
    rows = sa.table(table, sa.column(key, sa.Integer), sa.column(column, sa.Text))
    number, text = rows.c[key], rows.c[column]
    old = sa.or_(text.contains('"rung"'), text.contains('"mode"'))
    page = sa.select(number, text).where(number > sa.bindparam("last"), old).order_by(number).limit(_BATCH)
    change = sa.update(rows).where(number == sa.bindparam("row")).values({column: sa.bindparam("document")})
    connection, last = op.get_bind(), -1
    while found := connection.execute(page, {"last": last}).all():
        last = found[-1][0]
        connection.execute(
            change, [{"row": row, "document": _renamed(before, rename)} for row, before in found]
        )


def _renamed(text: str, rename: Callable[[Any], Any]) -> str:
    return json.dumps(rename(json.loads(text)), ensure_ascii=False, separators=(",", ":"))


def _campaign(spec: Any) -> Any:
    """The faults of a campaign, and those of its arms."""
    for conditions in ("arms", "faults"):
        spec = _at(spec, conditions, lambda several: [_mission(one) for one in several])
    return spec


def _mission(spec: Any) -> Any:
    """The fault of a mission, an arm or a condition."""
    return _at(spec, "fault", _triggered)


def _outcome(outcome: Any) -> Any:
    return _at(_at(outcome, "spec", _mission), "injection", _record)


def _record(record: Any) -> Any:
    return _named(_triggered(record), {"mode": "precision", "scouts": "probes"})


def _triggered(fault: Any) -> Any:
    """What has a trigger: a fault, or the record of an injection."""
    return _at(fault, "trigger", lambda trigger: _at(trigger, "site", _site))


def _site(site: Any) -> Any:
    return _named(site, {"rung": "precision"})


def _at(document: Any, name: str, change: Callable[[Any], Any]) -> Any:
    """A document with what is below one of its names changed, if there is anything."""
    return document if document.get(name) is None else {**document, name: change(document[name])}


def _named(document: Any, names: dict[str, str]) -> Any:
    """A document that has new names in the place of old ones."""
    return {names.get(name, name): value for name, value in document.items()}
