"""The tables of the store. Changes need a step in ``migrations/versions``; a test compares the two."""

from __future__ import annotations

from sqlalchemy import BigInteger, CheckConstraint, ForeignKey, Index, MetaData, Text, UniqueConstraint, text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

_RUN_PHASES = "phase IN ('queued', 'leased', 'running', 'done', 'failed', 'cancelled')"
_CAMPAIGN_PHASES = "phase IN ('queued', 'running', 'paused', 'done', 'failed', 'cancelled')"


def _of_those_that_have(column: str) -> Index:
    """An index of the rows whose text is not empty."""
    there = text(f"{column} != ''")
    return Index(f"ix_results_{column}", column, sqlite_where=there, postgresql_where=there)


class Base(DeclarativeBase):
    """Every constraint has a name, so that a migration can speak of it."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class CampaignRow(Base):
    """A campaign; ``wish`` is its desired state, ``request`` the key of what created it.

    One that was ``deleted`` (when) is shown to nobody. Its row stays, so that no other gets its number.
    """

    __tablename__ = "campaigns"
    __table_args__ = (CheckConstraint(_CAMPAIGN_PHASES, name="phase"), Index(None, "request", unique=True))

    id: Mapped[int] = mapped_column(primary_key=True)
    name: Mapped[str]
    spec: Mapped[str] = mapped_column(Text)
    phase: Mapped[str]
    reason: Mapped[str] = mapped_column(default="")
    wish: Mapped[str] = mapped_column(default="")
    created: Mapped[str]
    deleted: Mapped[str] = mapped_column(default="", server_default="")
    request: Mapped[str | None]


class RunRow(Base):
    """A run: what to fly and where it stands.

    ``changed`` is the write of its campaign in which the run last changed, counted from 0, its planning.
    """

    __tablename__ = "runs"
    __table_args__ = (
        CheckConstraint(_RUN_PHASES, name="phase"),
        UniqueConstraint("campaign_id", "arm", "world", "fault", "number"),
        Index(None, "campaign_id", "phase"),
        Index(None, "campaign_id", "id"),
        Index(None, "campaign_id", "changed"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    campaign_id: Mapped[int] = mapped_column(ForeignKey("campaigns.id"))
    arm: Mapped[str]
    world: Mapped[str]
    fault: Mapped[str]
    number: Mapped[int]
    seed: Mapped[int] = mapped_column(BigInteger)
    spec: Mapped[str] = mapped_column(Text)
    phase: Mapped[str]
    attempts: Mapped[int]
    lease: Mapped[str]
    error: Mapped[str]
    changed: Mapped[int] = mapped_column(default=0, server_default="0")


class ResultRow(Base):
    """The one result of a run: the primary key is the run, so there cannot be two.

    ``replay`` is the answer when it was last flown again, empty if it never was.
    """

    __tablename__ = "results"
    __table_args__ = (
        Index(None, "result"),
        Index(None, "success", "flight_time_s"),
        # Few have files, fewer were flown again.
        _of_those_that_have("artefact"),
        _of_those_that_have("replay"),
    )

    run_id: Mapped[int] = mapped_column(ForeignKey("runs.id"), primary_key=True, autoincrement=False)
    result: Mapped[str]
    success: Mapped[bool]
    flight_time_s: Mapped[float]
    distance_m: Mapped[float]
    energy_kj: Mapped[float]
    replans: Mapped[int]
    min_clearance_m: Mapped[float]
    injection: Mapped[str]
    node: Mapped[str]
    node_result: Mapped[str]
    twin_result: Mapped[str]
    twin_success: Mapped[bool | None]
    twin_flight_time_s: Mapped[float | None]
    twin_distance_m: Mapped[float | None]
    twin_energy_kj: Mapped[float | None]
    twin_digest: Mapped[str] = mapped_column(default="", server_default="")
    alarms: Mapped[int | None]
    recomputed: Mapped[int] = mapped_column(default=0, server_default="0")
    overhead: Mapped[float | None]
    harm: Mapped[str | None]
    harmed_at_s: Mapped[float | None]
    proof: Mapped[str] = mapped_column(default="", server_default="")
    digest: Mapped[str]
    wall_s: Mapped[float]
    artefact: Mapped[str] = mapped_column(default="", server_default="")
    artefact_bytes: Mapped[int] = mapped_column(BigInteger, default=0, server_default="0")
    replay: Mapped[str] = mapped_column(default="", server_default="")


class OutcomeRow(Base):
    """The whole outcome of a run that has a result. Results are read by the thousand, outcomes one by one."""

    __tablename__ = "outcomes"

    run_id: Mapped[int] = mapped_column(ForeignKey("runs.id"), primary_key=True, autoincrement=False)
    outcome: Mapped[str] = mapped_column(Text)
