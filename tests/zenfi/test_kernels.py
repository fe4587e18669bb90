"""``zenfi.kernels``: a study of a kernel alone, as the command makes it."""

import json

import pytest

import zenfi
from tests.dashboard.command import zenfi as command


def test_a_study_is_the_commands() -> None:
    study = zenfi.kernels.run("pid", 40, seed=3, fault="bits=2", progress=False)
    told = command(
        *("kernels", "run", "--kernel", "pid", "--injections", 40, "--seed", 3, "--fault", "bits=2", "--json")
    )
    *runs, last = [json.loads(line) for line in told.stdout.splitlines()]
    assert [run["result"] for run in runs] == [run.result for run in study.runs]
    assert last["summary"][0]["shares"] == study.summary.model_dump()["shares"]
    frame = study.table().pandas()
    assert len(frame) == 40
    assert (frame["register"] == [run["injection"]["register"] for run in runs]).all()
    assert sum(count for _, count, _ in study.by("register")) == study.summary.injected


def test_unknown_kernels_and_divisions_are_refused() -> None:
    with pytest.raises(zenfi.BadSpecError, match="nonsense"):
        zenfi.kernels.run("nonsense", 1)
    with pytest.raises(zenfi.BadSpecError, match="known are"):
        zenfi.kernels.run("pid", 1, progress=False).by("nonsense")
