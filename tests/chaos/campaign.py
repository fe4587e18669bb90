"""A campaign under chaos, run by run beside the same campaign that nothing disturbed."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal
from unittest import mock

import numpy as np
import sqlalchemy as sa
from mcap.reader import make_reader

from dashboard.campaigns.executors.spec import DaskSpec
from dashboard.campaigns.flight_record import FlightRecord
from dashboard.campaigns.spec import CampaignSpec
from dashboard.campaigns.store.schema import OutcomeRow, ResultRow
from dashboard.campaigns.store.store import Store
from services.models.outcome import Outcome
from services.runtime import rng
from tests.chaos.deployment import PATIENCE_S, Deployment, Standing, StoreKind, deployed
from tests.chaos.disturbances import DISK, FILES, Chaos, Disturbance, Places, small_disk
from tests.chaos.processes import adopting, bury, left_over, segments
from tests.dashboard.command import ZENFI

Verdict = Literal["equal", "not flown", "differing", "lost"]

OF_A_RUN = {"wall_s", "proof"}
"""What of a result tells of the run and not of the flight."""

DISK_MB = 400
SOON, EACH = 1, 0.5
"""So many disturbances as soon as there is something to disturb, and for each run that has ended."""

CLASSES = {
    "node": 3,
    "proxy": 3,
    "reaper": 1,
    "injector": 3,
    "striker": 2,
    "detector": 2,
    "fork server": 1,
    "worker": 1,
    "campaign process": 1,
    "service": 1,
    "PostgreSQL server": 1,
    "PostgreSQL session": 1,
}
"""How often a class of process is drawn."""

DASK_CLASSES = {"Dask scheduler": 1, "Dask worker": 3}


def specification(runs: int, *, seeds: int = 2, recorded: bool = True) -> CampaignSpec:
    """A campaign of short struck flights in an easy world, of which a golden twin serves many."""
    arms = [
        {"name": "golden"},
        {"name": "control", "fault": {"target": "pid"}},
        {"name": "perception", "fault": {"target": "point_cloud"}},
        {"name": "source", "fault": {"level": "source", "target": "trajectory.vx"}},
        {"name": "watched", "fault": {"target": "pid"}, "mission": {"detector": {"scheme": "gaussian"}}},
    ]
    return CampaignSpec.model_validate(
        {
            "name": "chaos",
            "runs": max(seeds, round((runs - seeds) / (len(arms) - 1))),
            "seeds": seeds,
            "worlds": ["sparse"],
            "mission": {"limits": {"mission_time_s": 1.0}},
            "limits": {"attempts": 50, "lease_s": 60.0},
            "recording": {"keep": "sample" if recorded else "none", "sample": 0.3},
            "arms": arms,
        }
    )


@dataclass
class Report:
    """What became of a campaign's runs, of the disturbances, and what is left over."""

    verdicts: dict[int, Verdict]
    disturbances: list[Disturbance]
    differences: list[str]
    left: list[str]
    resumed: Counter[str]
    starts: Mapping[str, int]
    attempts: int
    wall_s: float
    errors: Counter[str] = field(default_factory=Counter)

    def count(self, verdict: Verdict, runs: Iterable[int] | None = None) -> int:
        """How many runs, or how many of ``runs``, came out so."""
        wanted = self.verdicts if runs is None else set(runs) & self.verdicts.keys()
        return sum(self.verdicts[run] == verdict for run in wanted)


def undisturbed(spec: CampaignSpec, folder: Path) -> list[FlightRecord]:
    """The records of a campaign that nothing disturbs."""
    path = folder / "spec.json"
    path.write_text(spec.model_dump_json(exclude_unset=True))
    command = [ZENFI, "campaign", "run", str(path), "--store", str(folder / "calm")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    with closing(Store(folder / "calm")) as store:
        return list(store.records(store.find("1")))


def told(record: FlightRecord) -> dict[str, object]:
    """What must not depend on who flew a run, when, and how often it was disturbed."""
    assert record.result is not None
    result = {name: value for name, value in asdict(record.result).items() if name not in OF_A_RUN}
    return {"cell": record.cell, "number": record.number, "seed": record.seed, **result}


def verdict(calm: FlightRecord, hard: FlightRecord | None) -> Verdict:
    """What became of a run, beside the same that nothing disturbed."""
    if hard is None or (hard.phase == "done") != (hard.result is not None):
        return "lost"
    if hard.result is None:
        return "not flown" if hard.phase == "failed" and hard.error else "lost"
    return "equal" if told(calm) == told(hard) else "differing"


def fly_under_chaos(
    spec: CampaignSpec,
    calm: Sequence[FlightRecord],
    seed: int,
    kind: StoreKind,
    *,
    dask: bool = False,
    hold_s: float = 20.0,
    disturbances: int | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Report:
    """Fly a campaign while all that flies it is disturbed, until it has ended; as root alone.

    At most ``disturbances`` of them, by default about one for two runs; each lasts for ``hold_s``.
    """
    begin_s = time.monotonic()
    with adopting(), tempfile.TemporaryDirectory(prefix="zenfi-chaos-") as name:
        folder, before = Path(name), segments()
        folder.chmod(0o711)
        with small_disk(folder / "disk", DISK_MB) as disk, deployed(folder, disk, kind, dask=dask) as one:
            places = Places(disk, one.store, folder / "tmp")
            gone = () if dask else (DISK, *(FILES if kind == "sqlite" else FILES[1:]))
            chaos = Chaos(places, DASK_CLASSES if dask else CLASSES, seed, hold_s, gone)
            asked = spec.model_copy(update={"executor": DaskSpec(address=one.cluster)}) if dask else spec
            try:
                label = _created(one, asked)
                most = disturbances if disturbances is not None else len(calm)
                _fly(one, label, chaos, rng.generator(seed, "moments of chaos"), most, tell)
            finally:
                chaos.close()
            hard, differences = _kept(one, label)
        bury([])
        left = left_over(folder, before)
    by_key = {(record.cell, record.number): record for record in hard}
    verdicts: dict[int, Verdict] = {}
    for ours in calm:
        theirs = by_key.get((ours.cell, ours.number))
        verdicts[theirs.id if theirs is not None else -ours.id] = found = verdict(ours, theirs)
        if found in ("differing", "lost"):
            differences.append(f"{found}: {ours} became {theirs}")
    return Report(
        verdicts,
        chaos.done,
        differences,
        left,
        one.resumed,
        {name: daemon.starts for name, daemon in one.daemons.items()},
        sum(record.attempts for record in hard),
        time.monotonic() - begin_s,
        Counter(record.error for record in hard if record.error),
    )


def _created(one: Deployment, spec: CampaignSpec) -> str:
    """The label of a campaign that is in the store, by the service if there is one."""
    if one.cluster:
        with closing(Store(one.where)) as store:
            return store.create(spec).label
    body = {"spec": spec.model_dump(mode="json", exclude_unset=True)}
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        one.keep_up()
        answer = one.request("POST", "/api/v1/campaigns", json=body, headers={"Idempotency-Key": "chaos"})
        if answer is not None:
            assert answer.is_success or answer.status_code == 503, answer.text
            if answer.is_success:
                return str(answer.json()["campaign"])
        time.sleep(0.5)
    raise TimeoutError("the service does not take the campaign")


def _fly(
    one: Deployment,
    label: str,
    chaos: Chaos,
    draw: np.random.Generator,
    most: int,
    tell: Callable[[str], None],
) -> None:
    """Disturb, keep up and operate until the campaign has ended or does not go on."""
    engine = sa.create_engine(one.readable, poolclass=sa.NullPool, connect_args={"timeout": 5.0})
    standing, begin_s = Standing(), time.monotonic()
    next_s = heard_s = begin_s
    while standing.phase not in ("done", "failed", "cancelled"):
        one.keep_up()
        bury(one.own)
        before, standing = standing, one.look(engine, standing)
        now = time.monotonic()
        if standing.ended != before.ended:
            heard_s = now
        if now > heard_s + PATIENCE_S * 2:
            raise TimeoutError(f"{label} does not go on: {standing}")
        due = len(chaos.done) < min(most, SOON + EACH * len(standing.ended)) and standing.running
        if due and now >= next_s:
            disturbance = chaos.another(standing.running, standing.ended)
            if disturbance is not None:
                what = f"{disturbance.kind} {disturbance.what}"
                tell(f"{now - begin_s:7.1f} s {len(standing.ended):4} ended; {what}")
            next_s = now + float(draw.uniform(0.1, 2.0))
        one.operate(label, standing, disturbed=chaos.under_way > 0)
        time.sleep(0.1)


def _kept(one: Deployment, label: str) -> tuple[list[FlightRecord], list[str]]:
    """The records in the store, and what is lost of the files of those that have some."""
    home = {"ZENFI_HOME": str(one.home)}  # which the store of a database server asks for
    with mock.patch.dict(os.environ, home), closing(Store(one.where)) as store:
        found = store.find(label)
        records, folder = list(store.records(found)), store.artefacts(found)
        with store.reading() as connection:
            query = sa.select(OutcomeRow.run_id, OutcomeRow.outcome).join(
                ResultRow, ResultRow.run_id == OutcomeRow.run_id
            )
            rows = connection.execute(query.where(ResultRow.artefact == "kept"))
            kept = {row.run_id: row.outcome for row in rows}
    return records, [
        f"lost: {what}" for run, outcome in kept.items() for what in _missing(folder, run, outcome)
    ]


def _missing(folder: Path, run: int, outcome: str) -> list[str]:
    """What is not in a campaign's folder of a run's files, though the store has it that they are kept."""
    told, recording = folder / f"run-{run}.json", folder / f"run-{run}.mcap"
    missing = [] if told.exists() and told.read_text() == outcome + "\n" else [str(told)]
    if Outcome.model_validate_json(outcome).recording is None:
        return missing
    if not recording.exists():
        return [*missing, str(recording)]
    with recording.open("rb") as stream:
        return (
            missing if make_reader(stream).get_summary() is not None else [*missing, f"{recording}: its end"]
        )
