"""The list of wrong changes fits the code, and what tries them tells killed from survived."""

from collections import Counter
from pathlib import Path

import pytest

from tests.mutants.changes import MUTANTS, Mutant
from tests.mutants.run import ROOT, MisfitError, Tree, run

SUBJECT = "def twice(number: int) -> int:\n    return number * 2 + 0\n"
TEST = "from subject import twice\n\ndef test_twice() -> None:\n    assert twice(3) == 6\n"


def test_each_change_fits_and_is_named_once() -> None:
    assert len(MUTANTS) >= 60
    assert [name for name, count in Counter(one.name for one in MUTANTS).items() if count > 1] == []
    found = {one.name: (ROOT / one.path).read_text().count(one.old) for one in MUTANTS}
    assert {name: count for name, count in found.items() if count != 1} == {}
    assert all((ROOT / test.partition("::")[0]).exists() for one in MUTANTS for test in one.tests)
    assert all(one.old != one.new for one in MUTANTS)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    folder = tmp_path / "tree"
    folder.mkdir()
    (folder / "subject.py").write_text(SUBJECT)
    (folder / "test_subject.py").write_text(TEST)
    return folder


def change(old: str, new: str) -> Mutant:
    return Mutant(f"{old} to {new}", "subject.py", old, new, ("test_subject.py",))


@pytest.mark.soak
def test_a_change_that_a_test_notices_is_killed_and_the_tree_stays_as_it_is(tree: Path) -> None:
    mutants = [change("* 2", "* 3"), change("+ 0", "- 0"), change("return number", "while True: number")]
    assert list(run(mutants, tree, jobs=2, limit_s=20.0).values()) == [True, False, True]
    assert (tree / "subject.py").read_text() == SUBJECT


def test_a_change_that_does_not_fit_is_an_error(tree: Path, tmp_path: Path) -> None:
    copy = Tree.copy(tree, tmp_path / "copy")
    with pytest.raises(MisfitError, match=r"in subject\.py 0 times"):
        copy.apply(change("* 4", "* 3"))
    with pytest.raises(MisfitError, match=r"in subject\.py 2 times"):
        copy.apply(change("number", "n"))


@pytest.mark.process
def test_tests_that_fail_without_a_change_kill_nothing(tree: Path) -> None:
    (tree / "subject.py").write_text(SUBJECT.replace("2", "5"))
    with pytest.raises(MisfitError, match="fail without any change"):
        run([change("* 5", "* 3")], tree)
