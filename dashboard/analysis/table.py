"""Tables: columns by name as NumPy arrays, and the same for pandas, polars and Arrow.

>>> table = open_run("run-7.mcap").table("odometry")
>>> table["pose.pose.position.x"].mean(), table.pandas().describe()
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dashboard.analysis.extras import installed

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    import pyarrow as pa

Column = NDArray[Any]


class Table(dict[str, Column]):
    """Columns by name, all of the same length (n).

    A number is a column (n,), an array whose size is always the same one of shape (n, size). Strings, what
    may be missing (None), other arrays and lists are columns of objects.
    """

    @classmethod
    def of(cls, columns: Iterable[str], rows: Iterable[Mapping[str, object]]) -> Table:
        """A table of rows by the names of ``columns``; what a row has not is None."""
        kept = list(rows)
        return cls({name: column([row.get(name) for row in kept]) for name in columns})

    @property
    def rows(self) -> int:
        """The number of rows, which is the same in every column."""
        return len(next(iter(self.values()), ()))

    def pandas(self) -> pd.DataFrame:
        """The same for pandas; an array is a list in its cell.

        :raises BadSpecError: if pandas is not installed.
        """
        frame: pd.DataFrame = installed("pandas", "pandas").DataFrame(self._plain_columns())
        return frame

    def polars(self) -> pl.DataFrame:
        """The same for polars; an array is a list in its cell.

        :raises BadSpecError: if polars is not installed.
        """
        frame: pl.DataFrame = installed("polars", "polars").DataFrame(self._plain_columns(), strict=False)
        return frame

    def arrow(self) -> pa.Table:
        """The same for Arrow; an array is a list in its cell.

        :raises BadSpecError: if pyarrow is not installed.
        """
        pyarrow = installed("pyarrow", "parquet")
        table: pa.Table = pyarrow.table({name: pyarrow.array(list(one)) for name, one in self.items()})
        return table

    def _plain_columns(self) -> dict[str, Any]:
        return {
            name: one.tolist() if one.ndim > 1 or one.dtype == object else one for name, one in self.items()
        }


def column(values: list[Any]) -> Column:
    """A column of values: numbers as numbers, arrays of one size as one array, all else as objects."""
    kinds = {type(value) for value in values}
    if kinds <= {bool} or kinds <= {int, float}:
        return np.array(values)
    if kinds <= {np.ndarray} and len({value.shape for value in values}) == 1:
        return np.stack(values)
    if all(isinstance(value, np.generic) for value in values):
        return np.array(values)
    found = np.empty(len(values), dtype=object)
    for place, value in enumerate(values):  # assigned together, lists of one length would be taken for rows
        found[place] = value
    return found
