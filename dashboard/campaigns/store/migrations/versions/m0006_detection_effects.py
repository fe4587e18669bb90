"""What a detector made of a fault: the twin's digest, alarms, recomputed outputs."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Add the columns of this version; of flights from before, it is not known what the detector made."""
    op.add_column("results", sa.Column("twin_digest", sa.String(), nullable=False, server_default=""))
    op.add_column("results", sa.Column("alarms", sa.Integer(), nullable=True))
    op.add_column("results", sa.Column("recomputed", sa.Integer(), nullable=False, server_default="0"))
