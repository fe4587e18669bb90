"""Create the tables of campaigns, runs and results."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Create the tables of this version."""
    _campaigns()
    _runs()
    _results()


def _campaigns() -> None:
    op.create_table(
        "campaigns",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("name", sa.String(), nullable=False),
        sa.Column("spec", sa.Text(), nullable=False),
        sa.Column("phase", sa.String(), nullable=False),
        sa.Column("reason", sa.String(), nullable=False),
        sa.Column("wish", sa.String(), nullable=False),
        sa.Column("created", sa.String(), nullable=False),
        sa.CheckConstraint(
            "phase IN ('queued', 'running', 'paused', 'done', 'failed', 'cancelled')",
            name=op.f("ck_campaigns_phase"),
        ),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_campaigns")),
    )


def _runs() -> None:
    op.create_table(
        "runs",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("campaign_id", sa.Integer(), nullable=False),
        sa.Column("arm", sa.String(), nullable=False),
        sa.Column("world", sa.String(), nullable=False),
        sa.Column("fault", sa.String(), nullable=False),
        sa.Column("number", sa.Integer(), nullable=False),
        sa.Column("seed", sa.BigInteger(), nullable=False),
        sa.Column("spec", sa.Text(), nullable=False),
        sa.Column("phase", sa.String(), nullable=False),
        sa.Column("attempts", sa.Integer(), nullable=False),
        sa.Column("lease", sa.String(), nullable=False),
        sa.Column("error", sa.String(), nullable=False),
        sa.CheckConstraint(
            "phase IN ('queued', 'leased', 'running', 'done', 'failed', 'cancelled')",
            name=op.f("ck_runs_phase"),
        ),
        sa.ForeignKeyConstraint(["campaign_id"], ["campaigns.id"], name=op.f("fk_runs_campaign_id")),
        sa.PrimaryKeyConstraint("id", name=op.f("pk_runs")),
        sa.UniqueConstraint(
            "campaign_id",
            "arm",
            "world",
            "fault",
            "number",
            name=op.f("uq_runs_campaign_id_arm_world_fault_number"),
        ),
    )
    op.create_index("ix_runs_campaign_id_phase", "runs", ["campaign_id", "phase"])


def _results() -> None:
    op.create_table(
        "results",
        sa.Column("run_id", sa.Integer(), autoincrement=False, nullable=False),
        sa.Column("result", sa.String(), nullable=False),
        sa.Column("success", sa.Boolean(), nullable=False),
        sa.Column("flight_time_s", sa.Double(), nullable=False),
        sa.Column("distance_m", sa.Double(), nullable=False),
        sa.Column("energy_kj", sa.Double(), nullable=False),
        sa.Column("replans", sa.Integer(), nullable=False),
        sa.Column("min_clearance_m", sa.Double(), nullable=False),
        sa.Column("injection", sa.String(), nullable=False),
        sa.Column("node", sa.String(), nullable=False),
        sa.Column("node_result", sa.String(), nullable=False),
        sa.Column("twin_result", sa.String(), nullable=False),
        sa.Column("twin_success", sa.Boolean(), nullable=True),
        sa.Column("twin_flight_time_s", sa.Double(), nullable=True),
        sa.Column("twin_distance_m", sa.Double(), nullable=True),
        sa.Column("twin_energy_kj", sa.Double(), nullable=True),
        sa.Column("digest", sa.String(), nullable=False),
        sa.Column("wall_s", sa.Double(), nullable=False),
        sa.Column("outcome", sa.Text(), nullable=False),
        sa.ForeignKeyConstraint(["run_id"], ["runs.id"], name=op.f("fk_results_run_id")),
        sa.PrimaryKeyConstraint("run_id", name=op.f("pk_results")),
    )
    op.create_index("ix_results_result", "results", ["result"])
    op.create_index("ix_results_success_flight_time_s", "results", ["success", "flight_time_s"])
