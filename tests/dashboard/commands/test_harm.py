"""``zenfi harm`` keeps each fault that harmed a mission once, and what it keeps harms again."""

import json
from pathlib import Path

from dashboard.campaigns.results.harmful_faults import HarmfulFault, distinct, read_collection
from tests.dashboard.command import refusal, zenfi


def test_harmful_faults_are_kept_with_what_came_of_them(collected: tuple[Path, Path]) -> None:
    for one in read_collection(collected[1]):
        assert (one.campaign, one.target, one.cause) == ("harmed-1", "command.velocity", "data")
        assert one.kinds == ["property_violated"]
        assert one.first_topic == "command"
        assert one.left_at_s is not None
        assert one.left_at_s < one.harmed_at_s <= 8.0
        assert one.outcome.spec.fault is not None


def test_what_is_collected_again_is_not_new(collected: tuple[Path, Path]) -> None:
    folder, file = collected
    before = file.read_bytes()
    answer = zenfi("harm", "collect", "harmed-1", "--store", folder, "--output", file)
    assert "2 faults, 0 of them new; 2 harmful flights" in answer.stdout
    assert file.read_bytes() == before


def test_a_fault_is_the_same_whoever_judges_it_and_another_in_other_bits(
    collected: tuple[Path, Path],
) -> None:
    one, other = read_collection(collected[1])
    judged = one.outcome.spec.model_copy(update={"properties": ()})
    alike = one.model_copy(update={"run": 99, "outcome": one.outcome.model_copy(update={"spec": judged})})
    assert distinct([one, other, alike]) == [one, other]
    assert one.outcome.spec.fault is not None
    fault = one.outcome.spec.fault.model_copy(update={"bit_numbers": (62,)})
    spec = one.outcome.spec.model_copy(update={"fault": fault})
    unlike = one.model_copy(update={"outcome": one.outcome.model_copy(update={"spec": spec})})
    assert distinct([one, unlike]) == [one, unlike]


def test_a_node_that_died_is_the_cause(collected: tuple[Path, Path]) -> None:
    text = collected[1].read_text().splitlines()[0]
    assert HarmfulFault.model_validate_json(text).cause == "data"
    answer = zenfi("harm", "show", collected[1])
    (row,) = [line.split() for line in answer.stdout.splitlines() if line.split()[:1] == ["command.velocity"]]
    assert row[1:8] == ["2", "2", "0", "0", "0", "2", "0"]


def test_what_was_collected_harms_again(collected: tuple[Path, Path]) -> None:
    answer = zenfi("replay", collected[1], "--json")
    assert [json.loads(line)["answer"] for line in answer.stdout.splitlines()] == ["replayed"] * 2


def test_bad_input_is_told_in_a_line_and_nothing_is_lost(
    collected: tuple[Path, Path], tmp_path: Path
) -> None:
    folder, file = collected
    before = file.read_bytes()
    assert "no-such-1" in refusal("harm", "collect", "no-such-1", "--store", folder, "--output", file)
    assert file.read_bytes() == before
    (tmp_path / "diary").write_text("a diary\n")
    assert "no collection" in refusal("harm", "show", tmp_path / "diary")
    assert "makes one" in refusal("harm", "show", tmp_path / "absent")
