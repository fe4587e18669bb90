"""Notebooks as they are kept, and as they come out now.

``python -m tests.notebooks [NAME..]`` executes those of ``docs/notebooks`` and keeps what comes out, and the
first picture of ``flight`` for the README.
"""

import base64
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "python-path.png"
FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"


def notebooks() -> list[Path]:
    """All of them, by name."""
    return sorted(FOLDER.glob("*.ipynb"))


def executed(path: Path, folder: Path) -> Any:
    """A notebook with what its cells put out when they run in ``folder``, with a store of their own."""
    notebook = nbformat.read(path, as_version=4)
    environment = {**os.environ, "ZENFI_HOME": str(folder / "store")}
    client = NotebookClient(notebook, timeout=None, resources={"metadata": {"path": str(folder)}})
    client.execute(env=environment)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # wall times
    return notebook


def shape(notebook: Any) -> list[list[tuple[str, tuple[str, ...]]]]:
    """Of each cell the kinds of what it put out: its type, and its forms."""
    return [
        [(one.output_type, tuple(sorted(one.get("data", {})))) for one in cell.outputs]
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


def first_picture(notebook: Any) -> str:
    """The first picture that a notebook shows, PNG in base64."""
    outputs = (one for cell in notebook.cells if cell.cell_type == "code" for one in cell.outputs)
    return next(str(one.data["image/png"]) for one in outputs if "image/png" in one.get("data", {}))


def main() -> None:
    """Execute notebooks and keep them."""
    wanted = sys.argv[1:]
    for path in notebooks():
        if not wanted or path.stem in wanted:
            with tempfile.TemporaryDirectory() as folder:
                notebook = executed(path, Path(folder))
            nbformat.write(notebook, path)
            if path.stem == "flight":
                PICTURE.write_bytes(base64.b64decode(first_picture(notebook)))


if __name__ == "__main__":
    main()
