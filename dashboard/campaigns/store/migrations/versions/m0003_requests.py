"""The request that made a campaign, and an index for pages of runs."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the columns of this version."""
    op.add_column("campaigns", sa.Column("request", sa.String(), nullable=True))
    op.create_index("ix_campaigns_request", "campaigns", ["request"], unique=True)
    op.create_index("ix_runs_campaign_id_id", "runs", ["campaign_id", "id"])
