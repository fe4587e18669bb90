"""Tables: columns of numbers, arrays and objects, and the same for pandas, polars and Arrow."""

import sys

import numpy as np
import pytest

from dashboard.analysis.table import Table, column
from deploy.errors import BadSpecError

TABLE = Table(
    number=column([1.5, 2, 3.0]),
    flag=column([True, False, True]),
    array=column([np.arange(3), np.arange(3), np.ones(3)]),
    missing=column([1.0, None, 2.0]),
    text=column(["a", "", "c"]),
    lists=column([[1, 2], [3, 4], [5, 6]]),
)


def test_columns_have_the_form_of_what_is_in_them() -> None:
    assert TABLE.rows == 3
    assert TABLE["number"].dtype == np.float64
    assert TABLE["flag"].dtype == np.bool_
    assert TABLE["array"].shape == (3, 3)
    assert TABLE["missing"].tolist() == [1.0, None, 2.0]
    assert TABLE["lists"].tolist() == [[1, 2], [3, 4], [5, 6]]
    assert Table().rows == 0


def test_rows_become_columns_and_what_a_row_lacks_is_none() -> None:
    table = Table.of(["a", "b"], [{"a": 1, "b": "x"}, {"a": 2}])
    assert table["a"].tolist() == [1, 2]
    assert table["b"].tolist() == ["x", None]


def test_it_is_the_same_elsewhere() -> None:
    frame = TABLE.pandas()
    assert list(frame.columns) == list(TABLE)
    assert frame["array"].tolist() == [[0, 1, 2], [0, 1, 2], [1, 1, 1]]
    assert frame["missing"].isna().tolist() == [False, True, False]
    assert TABLE.polars().rows() == [
        (1.5, True, [0, 1, 2], 1.0, "a", [1, 2]),
        (2.0, False, [0, 1, 2], None, "", [3, 4]),
        (3.0, True, [1, 1, 1], 2.0, "c", [5, 6]),
    ]
    assert TABLE.arrow().num_rows == 3
    assert TABLE.arrow().column("lists").to_pylist() == [[1, 2], [3, 4], [5, 6]]


def test_what_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for package, extra in (("pandas", "pandas"), ("polars", "polars"), ("pyarrow", "parquet")):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(
            BadSpecError, match=rf"{package} is not installed: pip install 'zenfi\[{extra}\]'"
        ):
            getattr(TABLE, "arrow" if package == "pyarrow" else package)()
