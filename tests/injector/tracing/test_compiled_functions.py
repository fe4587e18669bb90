"""Code that numba compiled is told by function and offset, and found again by them."""

import os
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from injector.tracing.compiled_functions import CompiledFunction, CompiledFunctions
from injector.tracing.elf import CodeLocation, locate, place
from injector.tracing.process import MemoryMap


@njit
def doubled(values: np.ndarray) -> float:
    """Code to look for."""
    total = 0.0
    for value in values:
        total += 2.0 * value
    return total


@pytest.fixture(scope="module")
def functions() -> CompiledFunctions:
    doubled(np.ones(3))
    return CompiledFunctions()


@pytest.fixture(scope="module")
def found(functions: CompiledFunctions) -> CompiledFunction:
    symbol = f"{__name__}.doubled"
    entries = doubled.overloads.values()
    addresses = {one.library.get_pointer_to_function(one.fndesc.llvm_func_name) for one in entries}
    (start,) = addresses
    function = functions.at(start)
    assert function is not None
    assert (function.start, function.symbol) == (start, symbol)
    return function


def test_a_place_in_a_compiled_function_is_told_by_name_and_offset_and_found_again(
    functions: CompiledFunctions, found: CompiledFunction
) -> None:
    maps = MemoryMap(Path("/proc/self/maps").read_text())
    where = place(os.getpid(), maps, found.start + 3, functions)
    assert where == CodeLocation("numba", found.identity, 3, f"{__name__}.doubled")
    told = (where.module, where.build_id, where.offset)
    assert locate(os.getpid(), maps, *told, functions) == found.start + 3
    assert locate(os.getpid(), maps, *told) is None


def test_another_overload_is_another_function(functions: CompiledFunctions, found: CompiledFunction) -> None:
    doubled(np.ones(3, np.float32))
    entries = {one.fndesc.llvm_func_name for one in doubled.overloads.values()}
    assert len({CompiledFunction(0, name).identity for name in entries}) == 2
    assert {CompiledFunction(0, name).symbol for name in entries} == {found.symbol}
    assert functions.identified("numba", found.identity) == found
    assert functions.identified("libm.so.6", found.identity) is None


def test_what_is_no_compiled_code_is_none_of_the_functions(functions: CompiledFunctions) -> None:
    heap = id(object())
    library = next(one for one in MemoryMap(Path("/proc/self/maps").read_text()).code() if one.path)
    assert [functions.at(address) for address in (0, heap, library.start, 2**64 - 1)] == [None] * 4


def test_where_the_compiler_had_an_expression_does_not_count() -> None:
    names = [
        f"_ZN13_3cdynamic_3e33__numba_array_expr_0x7fffdb{end}90B4v167B72c8t" for end in ("dba3", "e12f")
    ]
    one, other = (CompiledFunction(0, name) for name in names)
    assert one.identity == other.identity != CompiledFunction(0, names[0].replace("v167", "v168")).identity


def test_a_local_functions_name_is_written_as_python_writes_it() -> None:
    name = "_ZN5numba2np8arrayobj12impl_np_full12_3clocals_3e4fullB2v8B42c8tJTI"
    assert CompiledFunction(0, name).symbol == "numba.np.arrayobj.impl_np_full.<locals>.full"
    assert CompiledFunction(0, "NRT_decref").symbol == "NRT_decref"
