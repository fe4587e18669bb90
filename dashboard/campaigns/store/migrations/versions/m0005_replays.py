"""Whether a run, flown again, was the same."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add the column of this version."""
    op.add_column("results", sa.Column("replay", sa.String(), nullable=False, server_default=""))
