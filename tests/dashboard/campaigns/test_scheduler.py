"""Leases, stopping rule and the sharing of golden twins, with workers that answer at once or never."""

import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import pytest

from dashboard.campaigns.events import Flown, Lost, RunStarted
from dashboard.campaigns.executors import local
from dashboard.campaigns.executors.executor import ExecutorReport, ExecutorTask
from dashboard.campaigns.executors.local import LocalExecutor
from dashboard.campaigns.scheduler import Finished, Scheduler
from dashboard.campaigns.spec import Arm, CampaignSpec, Run, StoppingSpec, cells, runs
from dashboard.campaigns.state_machine import CampaignStates, RunState
from dashboard.campaigns.stopping import StoppingRule
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from services.models.outcome import NO_FLIGHT, Outcome


def answering(script: str) -> Callable[..., subprocess.Popen[bytes]]:
    def start(_: int, __: int | None, *, watched: bool) -> subprocess.Popen[bytes]:
        assert watched
        command = [sys.executable, "-c", script]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    return start


def arrival(*successes: bool) -> str:
    """A worker whose flights end in turn as told, over and over."""
    outcomes = [
        Outcome(
            spec=MissionSpec(),
            result="success" if success else "timeout",
            qof=NO_FLIGHT.model_copy(update={"success": success}),
            digest="",
            wall_s=0.0,
            nodes={},
            topics={},
        )
        for success in successes
    ]
    lines = [f'{{"outcome": {outcome.model_dump_json(by_alias=True)}}}' for outcome in outcomes]
    turn = f"{lines!r}[number % {len(lines)}]"
    return f"import sys\nfor number, _ in enumerate(sys.stdin): print({turn}, flush=True)"


def fly(campaign: CampaignSpec, lease_s: float = 60.0, slots: int = 2) -> tuple[Scheduler, list[Finished]]:
    planned = dict(enumerate(runs(campaign)))
    states = CampaignStates({run: RunState() for run in planned}, campaign.limits.attempts)
    rule = StoppingRule(campaign.stop, planned.values(), campaign.runs)
    with closing(LocalExecutor(slots, lease_s)) as executor:
        scheduler = Scheduler(states, planned, executor, rule, lease_s, lambda *_: None)
        return scheduler, list(scheduler.fly())


def test_every_run_ends_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "start_worker", answering(arrival(True)))
    campaign = CampaignSpec(name="x", runs=20, arms=(Arm(name="a"), Arm(name="b")))
    scheduler, finished = fly(campaign)
    assert scheduler.states.phase == "done"
    assert Counter((one.run.arm, one.run.index) for one in finished) == Counter(
        (arm, index) for arm in "ab" for index in range(20)
    )


def test_a_worker_not_heard_of_loses_its_runs_to_another(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    # Only the first worker is silent.
    mark = tmp_path / "silent"
    script = (
        f"import pathlib, time\nmark = pathlib.Path({str(mark)!r})\n"
        f"if not mark.exists():\n    mark.touch()\n    time.sleep(600)\n{arrival(True)}"
    )
    monkeypatch.setattr(local, "start_worker", answering(script))
    scheduler, finished = fly(CampaignSpec(name="x", runs=3, arms=(Arm(name="a"),)), lease_s=2.0, slots=1)
    assert len(finished) == 3
    assert scheduler.states.runs[0].attempts == 2


def test_a_campaign_stops_at_the_first_look_that_tells_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "start_worker", answering(arrival(True)))
    stop = StoppingSpec(margin=0.1, looks=(10, 30))
    scheduler, finished = fly(CampaignSpec(name="x", runs=60, arms=(Arm(name="a"),), stop=stop))
    assert len(finished) == 30
    assert scheduler.states.phase == "done"
    assert scheduler.states.count("cancelled") == 30


def test_failed_missions_keep_a_campaign_flying(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "start_worker", answering(arrival(True, False)))
    stop = StoppingSpec(margin=0.1, looks=(10, 30))
    _, finished = fly(CampaignSpec(name="x", runs=60, arms=(Arm(name="a"),), stop=stop), slots=1)
    assert len(finished) == 60


def rule_after(stop: StoppingSpec | None, successes: Mapping[str, Sequence[int]], runs_: int) -> StoppingRule:
    campaign = CampaignSpec(name="x", runs=runs_, arms=tuple(Arm(name=name) for name in successes))
    named = {cell.arm: cell for cell in cells(campaign)}
    rule = StoppingRule(stop, runs(campaign), runs_)
    for name, flights in successes.items():
        for number, success in enumerate(flights):
            rule.add(named[name], number, success=bool(success))
    return rule


def test_a_rare_rate_is_known_to_a_part_of_itself() -> None:
    # 10 of 1,000: +- 0.7 points at 97.5 % (two looks), which are 0.7 of it.
    flights = [0] * 10 + [1] * 990
    for relative, enough in ((0.8, True), (0.6, False)):
        stop = StoppingSpec(relative=relative, looks=(1000,))
        assert rule_after(stop, {"a": flights}, 2000).look() is enough
    # None of 1,000 says how much it is at most, and nothing of its size.
    assert not rule_after(StoppingSpec(relative=1.0, looks=(1000,)), {"a": [1] * 1000}, 2000).look()


def test_harm_is_that_of_faults_and_golden_cells_do_not_count() -> None:
    fault = FaultSpec(target="pid")
    campaign = CampaignSpec(name="x", runs=200, arms=(Arm(name="golden"), Arm(name="pid", fault=fault)))
    golden, pid = cells(campaign)
    for harmed, enough in ((40, True), (2, False)):
        rule = StoppingRule(StoppingSpec(relative=0.4, of="harm", looks=(100,)), runs(campaign), 200)
        for number in range(100):
            rule.add(golden, number, success=True)
            rule.add(pid, number, success=True, harm=number < harmed)
        assert rule.look() is enough
    unknown = StoppingRule(StoppingSpec(margin=0.4, of="harm", looks=(100,)), runs(campaign), 200)
    for number in range(100):
        unknown.add(pid, number, success=True, harm=None)
    assert not unknown.look()


def test_one_wide_cell_keeps_all_flying() -> None:
    stop = StoppingSpec(margin=0.1, looks=(50,))
    assert rule_after(stop, {"a": [1] * 50, "b": [1] * 50}, 200).look()
    doubtful = rule_after(stop, {"a": [1] * 50, "b": [0, 1] * 25}, 200)
    assert not doubtful.look()
    assert doubtful.released == 200
    assert doubtful.look()


def test_looks_share_the_error() -> None:
    # 93 of 100: +- 5.2 % at 95 %, +- 6.6 % at 98.3 % (three looks)
    flights = [1] * 93 + [0] * 7
    assert rule_after(StoppingSpec(margin=0.054, looks=(100,)), {"a": flights}, 200).look() is False
    assert rule_after(StoppingSpec(margin=0.07, looks=(100, 150)), {"a": flights}, 200).look() is True
    assert rule_after(StoppingSpec(margin=0.058, looks=(100, 150)), {"a": flights}, 200).look() is False


def test_flights_beyond_a_look_do_not_sway_it() -> None:
    # Resumed after the first look was not enough: the flights since then are not yet looked at.
    rule = rule_after(StoppingSpec(margin=0.1, looks=(20, 200)), {"a": [0, 1] * 10 + [1] * 100}, 400)
    assert rule.released == 20
    assert not rule.look()
    assert rule.released == 200


def test_runs_of_one_twin_go_to_one_worker_together(monkeypatch: pytest.MonkeyPatch) -> None:
    tasks: list[ExecutorTask] = []
    submit = LocalExecutor.submit

    def seen(executor: LocalExecutor, task: ExecutorTask) -> list[ExecutorReport]:
        tasks.append(task)
        return submit(executor, task)

    monkeypatch.setattr(LocalExecutor, "submit", seen)
    monkeypatch.setattr(local, "start_worker", answering(arrival(True)))
    faults = [None, FaultSpec(target="pid"), FaultSpec(target="octomap")]
    arms = tuple(Arm(name=str(number), fault=fault) for number, fault in enumerate(faults))
    fly(CampaignSpec(name="x", runs=8, arms=arms))
    twins = [[twin_of(spec) for _, spec in task.runs] for task in tasks]
    assert all(len(set(twin)) == 1 for twin in twins)
    assert [len(twin) for twin in twins] == [3] * 8


def twin_of(spec: MissionSpec) -> str:
    return Run("", 0, spec).twin.model_dump_json()


def test_what_cannot_be_written_is_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "start_worker", answering(arrival(True)))
    planned = dict(enumerate(runs(CampaignSpec(name="x", runs=5, arms=(Arm(name="a"),)))))
    states = CampaignStates({run: RunState() for run in planned}, 5)

    def write(_: CampaignStates, __: Iterable[int], outcomes: Mapping[int, Outcome]) -> None:
        if outcomes:
            raise OSError("full")

    finished: list[Finished] = []
    with closing(LocalExecutor(1, 60.0)) as executor:
        scheduler = Scheduler(
            states,
            planned,
            executor,
            StoppingRule(None, planned.values(), 5),
            60.0,
            write,
        )
        with pytest.raises(OSError, match="full"):
            finished.extend(scheduler.fly())
    assert finished == []


class TwoFaced:
    """It tells of the first lease that its worker is lost, and then that this has flown the run."""

    slots = fill = 1

    def __init__(self) -> None:
        self.leases: set[str] = set()
        self.told: list[list[ExecutorReport]] = []

    @property
    def idle(self) -> int:
        return 1 - len(self.leases)

    def submit(self, task: ExecutorTask) -> list[ExecutorReport]:
        (run, spec), lease = task.runs[0], task.lease
        first = not self.told
        flown = ExecutorReport(Flown(lease, run), ended(spec, success=not first))
        self.told.append([ExecutorReport(Lost(lease, "gone")), flown] if first else [flown])
        self.leases = {lease}
        return [ExecutorReport(RunStarted(lease, run))]

    def poll(self, timeout_s: float) -> list[ExecutorReport]:
        assert timeout_s > 0.0
        self.leases = set()
        return self.told[-1]

    def drop(self, lease: str) -> None:
        raise AssertionError(lease)

    def close(self) -> None:
        pass


def ended(spec: MissionSpec, *, success: bool) -> Outcome:
    return Outcome(
        spec=spec,
        result="success" if success else "timeout",
        qof=NO_FLIGHT.model_copy(update={"success": success}),
        digest="",
        wall_s=0.0,
        nodes={},
        topics={},
    )


def test_what_is_told_of_a_lost_lease_is_not_written() -> None:
    planned = dict(enumerate(runs(CampaignSpec(name="x", runs=1, arms=(Arm(name="a"),)))))
    states = CampaignStates({run: RunState() for run in planned}, 5)
    written: list[tuple[str, list[str]]] = []

    def write(states_: CampaignStates, changed: Iterable[int], outcomes: Mapping[int, Outcome]) -> None:
        assert set(outcomes) <= set(changed)
        written.append((states_.runs[0].phase, [one.result for one in outcomes.values()]))

    rule = StoppingRule(None, planned.values(), 1)
    finished = list(Scheduler(states, planned, TwoFaced(), rule, 60.0, write).fly())
    assert [one.outcome.result for one in finished if one.outcome is not None] == ["success"]
    assert [(phase, results) for phase, results in written if results] == [("done", ["success"])]
    assert (states.stale, states.runs[0].attempts) == (1, 2)
