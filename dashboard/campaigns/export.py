"""A campaign as a table with a row per run, for other programs: CSV or Parquet."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from dashboard.campaigns.records import Record, Result
from dashboard.campaigns.spec import Cell
from deploy.check import BadSpecError

_RUN: dict[str, type] = {
    **dict.fromkeys(Cell._fields, str),
    "number": int,
    "seed": int,
    "phase": str,
    "attempts": int,
    "error": str,
}


def _plain(annotation: Any) -> type:
    """The type of a column, whether or not it may be empty."""
    given = get_args(annotation)
    return given[0] if given else annotation  # type: ignore[no-any-return]


_RESULT: dict[str, type] = {
    column.name: _plain(get_type_hints(Result)[column.name]) for column in fields(Result)
}
COLUMNS = {**_RUN, **_RESULT}
"""Name and type of every column."""


def rows(records: Iterable[Record]) -> Iterable[dict[str, object]]:
    """One flat row per run; a run without a result has None in its columns."""
    for record in records:
        row: dict[str, object] = dict(record.cell._asdict())
        row |= {name: getattr(record, name) for name in _RUN if name not in row}
        yield row | {name: getattr(record.result, name, None) for name in _RESULT}


def write(records: Iterable[Record], path: Path) -> None:
    """Write a table as its file's ending says; the file is there whole or not at all.

    :raises BadSpecError: if the ending says nothing, or the file cannot be written.
    """
    writers = {".csv": _csv, ".parquet": _parquet}
    if path.suffix not in writers:
        message = f"{path}: the ending says what to write: {' or '.join(writers)}"
        raise BadSpecError(message)
    draft = path.with_name(f".{path.name}.part")
    try:
        writers[path.suffix](records, draft)
        draft.replace(path)
    except OSError as error:
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error
    finally:
        draft.unlink(missing_ok=True)


def _csv(records: Iterable[Record], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows(records))


def _parquet(records: Iterable[Record], path: Path) -> None:
    try:
        import pyarrow as pa  # noqa: PLC0415 - 50 MB that only this needs
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        message = "Parquet needs pyarrow: pip install 'zenfi[parquet]', or write .csv"
        raise BadSpecError(message) from error
    types = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    schema = pa.schema([(name, types[kind]) for name, kind in COLUMNS.items()])
    parquet.write_table(pa.Table.from_pylist(list(rows(records)), schema=schema), path)
