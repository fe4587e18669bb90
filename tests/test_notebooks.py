"""The notebooks of the documents run, and show what they showed when they were kept."""

from pathlib import Path

import nbformat
import pytest

from tests.notebooks import executed, notebooks, shape

pytestmark = pytest.mark.process


@pytest.mark.parametrize("path", notebooks(), ids=lambda path: path.stem)
def test_a_notebook_puts_out_what_it_did(path: Path, tmp_path: Path) -> None:
    kept = nbformat.read(path, as_version=4)
    assert any(cell.outputs for cell in kept.cells if cell.cell_type == "code")
    assert shape(executed(path, tmp_path)) == shape(kept)


def test_there_are_three() -> None:
    assert [path.stem for path in notebooks()] == ["campaign", "flight", "kernel"]
