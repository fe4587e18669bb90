"""Whose files are kept, what they may weigh, and that everything else is counted."""

import json
from pathlib import Path

import pytest

from dashboard.analysis.recordings_reader import open_run
from dashboard.campaigns.recording import ArtefactRecorder, FileState
from dashboard.campaigns.spec import Arm, CampaignSpec, RecordingPolicy, Run, runs
from dashboard.campaigns.store.database import StoreFullError
from dashboard.campaigns.store.store import Store
from services.models.faults.specification import FaultSpec
from services.models.outcome import Outcome
from tests.dashboard.campaigns.store.test_store import SPEC, flown, outcome
from tests.dashboard.command import zenfi

FLIP = Arm(name="flip", fault=FaultSpec(target="pid"))


def planned(count: int) -> dict[int, Run]:
    campaign = CampaignSpec(name="x", runs=count, arms=(Arm(name="golden"), FLIP))
    return dict(enumerate(runs(campaign), start=1))


def ended(success: bool) -> Outcome:
    one = outcome()
    return one.model_copy(update={"qof": one.qof.model_copy(update={"success": success})})


def test_without_a_policy_no_run_has_files(tmp_path: Path) -> None:
    assert ArtefactRecorder(RecordingPolicy(), tmp_path, 0).file(planned(2), {1: ended(False)}) == {}
    assert list(tmp_path.iterdir()) == []


def test_failures_are_kept_and_the_rest_is_dropped_and_counted(tmp_path: Path) -> None:
    for run in (1, 2, 12):  # what a flight has left
        (tmp_path / f"run-{run}.mcap").write_bytes(bytes(1000))
    recorder = ArtefactRecorder(RecordingPolicy(keep="failures"), tmp_path, 0)
    filed = recorder.file(planned(2), {1: ended(True), 2: ended(False)})
    assert filed[1] == FileState("dropped")
    assert (filed[2].fate, filed[2].size) == ("kept", 1000 + (tmp_path / "run-2.json").stat().st_size)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run-12.mcap", "run-2.json", "run-2.mcap"]
    assert json.loads((tmp_path / "run-2.json").read_text())["result"] == "timeout"


def test_a_sample_keeps_pairs_and_is_the_same_each_time(tmp_path: Path) -> None:
    policy, every = RecordingPolicy(keep="sample", sample=0.3), planned(400)
    flights = dict.fromkeys(every, ended(True))
    kept = [
        {
            run
            for run, one in ArtefactRecorder(policy, tmp_path, seed).file(every, flights).items()
            if one.fate == "kept"
        }
        for seed in (5, 5, 6)
    ]
    assert kept[0] == kept[1] != kept[2]
    assert 0.2 < len(kept[0]) / len(every) < 0.4
    numbers = {
        arm: {every[run].index for run in kept[0] if every[run].arm == arm} for arm in ("golden", "flip")
    }
    assert numbers["golden"] == numbers["flip"]


def test_beyond_the_quota_nothing_is_kept_and_that_is_counted(tmp_path: Path) -> None:
    policy = RecordingPolicy(keep="all", disk_mb=1)
    (tmp_path / "run-1.mcap").write_bytes(bytes(700_000))
    (tmp_path / "run-2.mcap").write_bytes(bytes(700_000))
    flights = {1: ended(True), 2: ended(True), 3: ended(True)}
    filed = ArtefactRecorder(policy, tmp_path, 0).file(planned(2), flights)
    assert [filed[run].fate for run in flights] == ["kept", "over quota", "kept"]
    assert not (tmp_path / "run-2.mcap").exists()
    used = filed[1].size + filed[3].size
    assert (
        ArtefactRecorder(policy, tmp_path, 0, used + 300_000).file(planned(2), {4: ended(True)})[4].fate
        == "over quota"
    )


def test_a_disk_that_is_full_pauses_and_leaves_no_half_file(tmp_path: Path) -> None:
    (tmp_path / "run-1.json").symlink_to("/dev/full")
    with pytest.raises(StoreFullError, match="No space left"):
        ArtefactRecorder(RecordingPolicy(keep="all"), tmp_path, 0).file(planned(1), {1: ended(True)})
    assert list(tmp_path.iterdir()) == []


def test_what_became_of_files_is_stored_with_the_result(store: Store) -> None:
    campaign = store.create(SPEC)
    first, second, *_ = store.planned(campaign)
    assert store.file_counts(campaign) == {}
    states = flown(store, campaign, first)
    states._change([second], phase="done")
    store.write(campaign, states, [second], {second: outcome()}, {second: FileState("kept", 3_000_000_000)})
    assert store.file_counts(campaign) == {"kept": (1, 3_000_000_000)}


@pytest.mark.soak
def test_a_campaign_keeps_the_files_that_it_was_asked_for_and_shows_the_rest(
    tmp_path: Path, home: Path
) -> None:
    path = tmp_path / "short.toml"
    path.write_text(
        'name = "short"\nruns = 3\nmission = { limits = { mission_time_s = 0.4 } }\n'
        'recording = { keep = "sample", sample = 0.5 }\narms = [{ name = "golden" }]\n'
    )
    assert zenfi("campaign", "run", path).returncode == 0
    shown = json.loads(zenfi("campaign", "show", "short-1", "--json").stdout.splitlines()[0])
    kept = sorted((home / "artefacts" / "short-1").glob("run-*.json"))
    assert 0 < len(kept) < 3
    files = list((home / "artefacts" / "short-1").glob("run-*"))
    assert shown["files"] == {
        "kept": {"runs": len(kept), "bytes": sum(file.stat().st_size for file in files)},
        "dropped": {"runs": 3 - len(kept), "bytes": 0},
    }
    assert all(Outcome.model_validate_json(file.read_text()).result == "timeout" for file in kept)
    assert sorted(file for file in files if file.suffix == ".mcap") == [
        file.with_suffix(".mcap") for file in kept
    ]
    for file in kept:
        recording = open_run(file.with_suffix(".mcap"))
        assert recording.complete
        assert (recording.about["campaign"], recording.about["run"]) == ("short-1", file.stem[4:])
    told = zenfi("campaign", "show", "short-1").stderr
    assert f"{3 - len(kept)} dropped" in told
    assert f"{len(kept)} kept" in told
