"""The part of a flight's time that its detector took."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """Add the column of this version; of flights from before, it is not known."""
    op.add_column("results", sa.Column("overhead", sa.Double(), nullable=True))
