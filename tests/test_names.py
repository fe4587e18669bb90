"""Names: one public class name has one meaning in the whole project, and no picture comes back as a term."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = ("services", "sim", "injector", "detector", "deploy", "dashboard", "zenfi")

OLD_MODULES = {
    "services": "courier line model scout shown trial vitals",
    "sim": "survey",
    "injector": (
        "aarch64 acts any_process census clock copies decode foreign forks freeze gentle hunt inject keys"
        " own_pids preflight pristine program rehearsal restorer scope scout session site start strike survey"
        " sweep trigger ward way"
    ),
    "detector": "changed scheme watched",
    "deploy": (
        "announced answer courier crew dask_slot display family forkserver identity injections keeper life"
        " lives measure mould pairing present samples scratch settling shard sight tape watch"
    ),
    "dashboard": (
        "again conductor hub knock looking observing pilot records relatives steering strikes travel wished"
    ),
}
"""Module names of the past by floor: the word may be right on another one (a clock, a body's sweep)."""

OLD_CLASSES = (
    "Answer Courier Found Gate Here Hub Line Mould Passed Place Recording RefusedError Standing Started"
    " Strike Survey Sweep Tracees Vitals"
)
"""Class names that had several meanings, or were pictures."""


def modules() -> Iterator[Path]:
    """Every module of product code."""
    for floor in FLOORS:
        yield from sorted((ROOT / floor).rglob("*.py"))


def public_classes(path: Path) -> Iterator[str]:
    """The names of a module's public top-level classes."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node.name


def test_a_public_class_name_is_defined_once() -> None:
    places = defaultdict(list)
    for path in modules():
        for name in public_classes(path):
            places[name].append(str(path.relative_to(ROOT)))
    assert len(places) > 300
    assert {name: where for name, where in places.items() if len(where) > 1} == {}


@pytest.mark.parametrize("floor", FLOORS)
def test_no_module_bears_an_old_name(floor: str) -> None:
    old = set(OLD_MODULES.get(floor, "").split())
    names = {path.stem for path in modules() if path.relative_to(ROOT).parts[0] == floor}
    assert names & old == set()


def test_no_class_bears_an_old_name() -> None:
    assert {name for path in modules() for name in public_classes(path)} & set(OLD_CLASSES.split()) == set()
