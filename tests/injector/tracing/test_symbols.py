"""Names of functions: how C++ and Rust write them, and how somebody may ask for them."""

import pytest

from injector.tracing.symbols import demangled, spellings


def rust(*parts: str) -> str:
    """The symbol of a path of Rust, mangled the legacy way."""
    whole = [*parts, "h0123456789abcdef"]
    return "_ZN" + "".join(f"{len(one)}{one}" for one in whole) + "E"


@pytest.mark.parametrize(
    ("symbol", "name"),
    [
        ("main", "main"),
        ("_ZN4grid6insertEdi", "grid::insert(double, int)"),
        (rust("core", "fmt", "write"), "core::fmt::write"),
        (
            rust("_$LT$std..io..error..Error$u20$as$u20$core..fmt..Display$GT$", "fmt"),
            "<std::io::error::Error as core::fmt::Display>::fmt",
        ),
        (rust("core", "ptr", "drop_in_place$LT$$RF$u8$C$$BP$u8$GT$"), "core::ptr::drop_in_place<&u8,*u8>"),
        ("_Znothing", "_Znothing"),
    ],
)
def test_a_symbol_is_shown_as_its_language_writes_it(symbol: str, name: str) -> None:
    assert demangled(symbol) == name


@pytest.mark.parametrize(
    ("symbol", "asked"),
    [
        (
            "_ZSt4swapIiEvRT_S1_",
            {"void std::swap<int>(int&,int&)", "std::swap<int>(int&,int&)", "std::swap<int>"},
        ),
        ("_ZN4grid6insertEdi", {"grid::insert(double,int)", "grid::insert"}),
        (rust("core", "fmt", "write"), {"core::fmt::write"}),
    ],
)
def test_a_function_is_found_with_and_without_return_type_and_parameters(
    symbol: str, asked: set[str]
) -> None:
    assert spellings(demangled(symbol)) == asked
