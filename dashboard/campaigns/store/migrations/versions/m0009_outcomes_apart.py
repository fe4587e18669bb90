"""Outcomes in a table of their own, so that results are read without them; the write that changed a run."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    """Move the outcomes; of runs from before, all changed in write 0."""
    op.create_table(
        "outcomes",
        sa.Column("run_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("outcome", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["run_id"], ["runs.id"], name=op.f("fk_outcomes_run_id")),
        sa.PrimaryKeyConstraint("run_id", name=op.f("pk_outcomes")),
    )
    op.execute(sa.text("INSERT INTO outcomes (run_id, outcome) SELECT run_id, outcome FROM results"))
    op.drop_column("results", "outcome")
    op.add_column("runs", sa.Column("changed", sa.Integer(), nullable=False, server_default="0"))
    op.create_index("ix_runs_campaign_id_changed", "runs", ["campaign_id", "changed"])
    for column in ("artefact", "replay"):
        there = sa.text(f"{column} != ''")
        op.create_index(
            f"ix_results_{column}", "results", [column], sqlite_where=there, postgresql_where=there
        )
