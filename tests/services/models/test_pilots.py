"""The tables of guards and pilots say what the docs say, and only what exists can be switched."""

from pathlib import Path

import pytest

from services.models.mission import MissionSpec
from services.models.pilots import ALL_GUARDS, GUARDS, PILOTS, find_guard, find_pilot
from services.system.plug_ins import UnknownPlugInError
from services.system.shared_stats import MAX_GUARDS

PAGE = Path("docs/pilots.md")


def test_the_page_has_the_table_of_guards() -> None:
    rows = [
        f"| `{name}` | {', '.join(one.stages)} | {one.does} | {one.costs} |" for name, one in GUARDS.items()
    ]
    assert "\n".join(rows) in PAGE.read_text()


def test_every_guard_is_in_the_table_and_has_a_counter() -> None:
    assert set(GUARDS) == ALL_GUARDS
    assert len(GUARDS) <= MAX_GUARDS


def test_a_mission_has_its_pilots_guards_unless_it_names_its_own() -> None:
    assert MissionSpec().active_guards == ALL_GUARDS
    assert MissionSpec(pilot="baseline").active_guards == PILOTS["baseline"].guards == {"clip", "restart"}
    assert MissionSpec(pilot="baseline", guards=("finite",)).message_checks == {"finite"}
    assert MissionSpec(guards=()).active_guards == frozenset()


def test_what_is_no_guard_is_refused() -> None:
    with pytest.raises(UnknownPlugInError, match="unknown guard 'luck'; known: finite, range"):
        find_guard("luck")


def test_what_is_no_pilot_is_refused() -> None:
    with pytest.raises(UnknownPlugInError, match="unknown pilot 'ace'; known: guarded, baseline"):
        find_pilot("ace")
