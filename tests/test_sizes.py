"""Sizes: a folder holds one idea, a file fits in the head, a class does one thing."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.test_names import ROOT, modules

MODULES_IN_A_FOLDER = 14
LINES_OF_A_FILE = 400
LINES_OF_A_CLASS = 250
METHODS_OF_A_CLASS = 20

DATA = {Path("dashboard/campaigns/store/migrations/versions")}
"""Folders of data that is written as Python: a migration for each change of the schema."""


def classes() -> Iterator[tuple[str, ast.ClassDef]]:
    """Every class of product code, nested ones too, with the place that a message names."""
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                yield f"{path.relative_to(ROOT)}: {node.name}", node


def methods(node: ast.ClassDef) -> int:
    """How many functions a class defines; the overloads of one are one."""
    return len({part.name for part in node.body if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef)})


def test_no_folder_holds_too_many_modules() -> None:
    parents = (path.relative_to(ROOT).parent for path in modules() if path.name != "__init__.py")
    held = Counter(parent for parent in parents if parent not in DATA)
    assert {str(where): count for where, count in held.items() if count > MODULES_IN_A_FOLDER} == {}


def test_no_file_is_too_long() -> None:
    lines = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in modules()}
    assert len(lines) > 250
    assert {path: count for path, count in lines.items() if count > LINES_OF_A_FILE} == {}


def test_no_class_is_too_long() -> None:
    lines = {where: (node.end_lineno or node.lineno) - node.lineno + 1 for where, node in classes()}
    assert {where: count for where, count in lines.items() if count > LINES_OF_A_CLASS} == {}


def test_no_class_has_too_many_methods() -> None:
    counts = {where: methods(node) for where, node in classes()}
    assert {where: count for where, count in counts.items() if count > METHODS_OF_A_CLASS} == {}
