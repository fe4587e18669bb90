"""What harmed a flight beside its golden twin, and when."""

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Add the columns of this version; of flights from before, harm is not known."""
    op.add_column("results", sa.Column("harm", sa.String(), nullable=True))
    op.add_column("results", sa.Column("harmed_at_s", sa.Double(), nullable=True))
