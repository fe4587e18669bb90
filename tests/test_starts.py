"""How processes of ours are started: whatever lies in the folder where they are is no code of ours."""

import ast
from collections.abc import Iterator

from tests.test_names import ROOT, modules


def started() -> Iterator[tuple[str, str]]:
    """Each list in product code that begins with our own Python: where it is, and the next argument."""
    for path in modules():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.List) and node.elts and ast.unparse(node.elts[0]) == "sys.executable":
                yield f"{path.relative_to(ROOT)}:{node.lineno}", ast.unparse(node.elts[1])


def test_no_python_of_ours_imports_from_the_folder_where_it_is_started() -> None:
    found = dict(started())
    assert len(found) > 5
    assert {where: first for where, first in found.items() if first not in ("'-P'", "'-I'", "*_REAPER")} == {}
