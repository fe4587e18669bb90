"""Campaigns that were deleted; what became of a run's files."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add the columns of this version."""
    op.add_column("campaigns", sa.Column("deleted", sa.String(), nullable=False, server_default=""))
    op.add_column("results", sa.Column("artefact", sa.String(), nullable=False, server_default=""))
    op.add_column("results", sa.Column("artefact_bytes", sa.BigInteger(), nullable=False, server_default="0"))
