"""A campaign as a table with a row per run, or per cell, for other programs: CSV or Parquet."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import fields
from itertools import islice
from pathlib import Path
from typing import Any, get_args, get_type_hints

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.results.detection_effects import EFFECTS
from dashboard.campaigns.results.summary import CellSummary
from dashboard.campaigns.spec import Cell
from deploy.errors import BadSpecError
from services.models.outcome import NodeResult

Columns = Mapping[str, type]

GROUP_ROWS = 5000
"""Rows of a Parquet file that are in memory together: a row group."""

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


def rows(records: Iterable[FlightRecord]) -> Iterable[dict[str, object]]:
    """One flat row per run; a run without a result has None in its columns."""
    for record in records:
        row: dict[str, object] = dict(record.cell._asdict())
        row |= {name: getattr(record, name) for name in _RUN if name not in row}
        yield row | {name: getattr(record.result, name, None) for name in _RESULT}


SUMMARY: dict[str, type] = {
    **{
        name: _plain(field.annotation)
        for name, field in CellSummary.model_fields.items()
        if name not in ("results", "effects")
    },
    **dict.fromkeys((*get_args(NodeResult), *EFFECTS), int),
}
"""The same of the table of cells; what became of nodes and what detectors made of faults has columns each."""


def write(records: Iterable[FlightRecord], path: Path) -> None:
    """Write a table of runs as its file's ending says; the file is there whole or not at all.

    :raises BadSpecError: if the ending says nothing, or the file cannot be written.
    """
    _write(COLUMNS, rows(records), path)


def write_summary(lines: Iterable[CellSummary], path: Path) -> None:
    """Write a table of cells likewise.

    :raises BadSpecError: as above.
    """
    _write(SUMMARY, (_cell(line) for line in lines), path)


def _cell(line: CellSummary) -> dict[str, object]:
    counts: dict[str, object] = {name: line.results.get(name, 0) for name in get_args(NodeResult)}
    counts |= {word: line.effects.get(word) for word in EFFECTS}
    return line.model_dump(exclude={"results", "effects"}) | counts


def _write(columns: Columns, table: Iterable[dict[str, object]], path: Path) -> None:
    writers = {".csv": _csv, ".parquet": _parquet}
    if path.suffix not in writers:
        message = f"{path}: the ending says what to write: {' or '.join(writers)}"
        raise BadSpecError(message)
    draft = path.with_name(f".{path.name}.part")
    try:
        writers[path.suffix](columns, table, draft)
        draft.replace(path)
    except OSError as error:
        message = f"{path}: {error.strerror}"
        raise BadSpecError(message) from error
    finally:
        draft.unlink(missing_ok=True)


def _csv(columns: Columns, table: Iterable[dict[str, object]], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(table)


def _parquet(columns: Columns, table: Iterable[dict[str, object]], path: Path) -> None:
    try:
        import pyarrow as pa  # noqa: PLC0415 - 50 MB that only this needs
        from pyarrow import parquet  # noqa: PLC0415
    except ImportError as error:
        message = "Parquet needs pyarrow: pip install 'zenfi[parquet]', or write .csv"
        raise BadSpecError(message) from error
    types = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    schema = pa.schema([(name, types[kind]) for name, kind in columns.items()])
    left = iter(table)
    with parquet.ParquetWriter(path, schema) as writer:
        while group := list(islice(left, GROUP_ROWS)):
            writer.write_table(pa.Table.from_pylist(group, schema=schema))
