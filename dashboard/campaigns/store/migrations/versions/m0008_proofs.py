"""By what an outcome was proven, if it was not flown."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Add the column of this version; all outcomes from before were flown."""
    op.add_column("results", sa.Column("proof", sa.String(), nullable=False, server_default=""))
