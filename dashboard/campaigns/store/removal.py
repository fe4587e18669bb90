"""Deletion of a campaign, safe against being killed at any point.

First its row is marked, in one transaction: from then on nobody is shown it, and nobody can fly it. Then
its files go, then its runs and results; whatever is left of that goes with the next deletion.
"""

from __future__ import annotations

import contextlib
import errno
from datetime import UTC, datetime
from pathlib import Path

import sqlalchemy as sa

from dashboard.campaigns.store.database import Database
from dashboard.campaigns.store.schema import CampaignRow, OutcomeRow, ResultRow, RunRow

_NO_FOLDER = (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG)


def hide(database: Database, campaign: int) -> None:
    """Mark a campaign as deleted; the request that made it may make another. The caller holds its lock."""
    marked = {"deleted": datetime.now(UTC).isoformat(timespec="seconds"), "request": None}
    with database.writing(campaign) as connection:
        connection.execute(sa.update(CampaignRow).where(CampaignRow.id == campaign).values(marked))


def is_hidden(database: Database, campaign: int) -> bool:
    """Whether a campaign was deleted."""
    with database.reading() as connection:
        query = sa.select(CampaignRow.deleted).where(CampaignRow.id == campaign)
        return bool(connection.execute(query).scalar())


def left_over(database: Database) -> list[tuple[int, str, str]]:
    """Number, name and specification of what was marked and not removed yet."""
    query = sa.select(CampaignRow.id, CampaignRow.name, CampaignRow.spec)
    with database.reading() as connection:
        rows = connection.execute(query.where(CampaignRow.deleted != "", CampaignRow.spec != ""))
        return [(row.id, row.name, row.spec) for row in rows]


def remove(database: Database, campaign: int, folder: Path) -> None:
    """Remove the files in ``folder`` and the rows of a campaign that is marked.

    :raises OSError: if a file cannot be removed; the rows stay then.
    """
    try:
        for path in folder.iterdir():
            if not path.is_dir() or path.is_symlink():
                path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # somebody put a folder there
            folder.rmdir()
    except OSError as error:
        if error.errno not in _NO_FOLDER:
            raise
    theirs = sa.select(RunRow.id).where(RunRow.campaign_id == campaign)
    with database.writing() as connection:
        connection.execute(sa.delete(OutcomeRow).where(OutcomeRow.run_id.in_(theirs)))
        connection.execute(sa.delete(ResultRow).where(ResultRow.run_id.in_(theirs)))
        connection.execute(sa.delete(RunRow).where(RunRow.campaign_id == campaign))
        connection.execute(sa.update(CampaignRow).where(CampaignRow.id == campaign).values(spec="", wish=""))
