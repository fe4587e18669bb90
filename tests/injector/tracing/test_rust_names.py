"""Names of Rust in its newer mangling (v0): those of RFC 2603, and what is none."""

import string

import pytest

from injector.tracing.rust_names import rust_name
from injector.tracing.symbols import demangled, spellings


@pytest.mark.parametrize(
    ("symbol", "name"),
    [
        # The examples of the RFC.
        ("_RNvCs1234_7mycrate3foo", "mycrate::foo"),
        ("_RNvNtCs1234_7mycrate3foo3bar", "mycrate::foo::bar"),
        ("_RNvMs_Cs4Cv8Wi1oAIB_7mycrateNtB4_7Example3foo", "<mycrate::Example>::foo"),
        ("_RINvNtC3std3mem8align_ofdE", "std::mem::align_of::<f64>"),
        (
            "_RINvNtC3std3mem8align_ofNtNtC3std3mem12DiscriminantE",
            "std::mem::align_of::<std::mem::Discriminant>",
        ),
        ("_RNvC6_123foo3bar", "123foo::bar"),
        (
            "_RNqCs4fqI2P2rA04_11utf8_identsu30____7hkackfecea1cbdathfdh9hlq6y",
            "utf8_idents::საჭმელად_გემრიელი_სადილი",
        ),
        ("_RNCNCNgCs6DXkGYLi8lr_2cc5spawn00B5_", "cc::spawn::{closure#0}::{closure#0}"),
        (
            "_RINbNbCskIICzLVDPPb_5alloc5alloc8box_freeDINbNiB4_5boxed5FnBoxuEp6OutputuEL_ECs1iopQbuBiw2_3std",
            "alloc::alloc::box_free::<dyn alloc::boxed::FnBox<(), Output = ()>>",
        ),
        ("_RNvXs5_NtC4core3fmtRDNtB5_5DebugEL_B5_3fmt", "<&dyn core::fmt::Debug as core::fmt>::fmt"),
        # What types and constants there are.
        ("_RINvC1a1fTahEE", "a::f::<(i8, u8)>"),
        ("_RINvC1a1fTlEE", "a::f::<(i32,)>"),
        ("_RINvC1a1fAhj4_SePxOyE", "a::f::<[u8; 4], [str], *const i64, *mut u64>"),
        ("_RINvC1a1fKb1_Kc61_Kln2a_KpE", "a::f::<true, 'a', -42, _>"),
        ("_RINvC1a1fFUKCmEuE", 'a::f::<unsafe extern "C" fn(u32)>'),
        ("_RINvC1a1fFG_RL0_hEQaE", "a::f::<for<'a> fn(&'a u8) -> &mut i8>"),
        ("_RNSC1a6vtable", "a::{shim:vtable#0}"),
        ("_RNvC1a1f.llvm.8166", "a::f"),
    ],
)
def test_a_symbol_is_shown_as_rust_writes_it(symbol: str, name: str) -> None:
    assert rust_name(symbol) == demangled(symbol) == name


@pytest.mark.parametrize(
    "symbol",
    [
        "_R",
        "_Rust",
        "_Read",
        "_RNvC1a",
        "_RNvC9a1f",
        "_RNvC1a1f9",
        "_RNvB_1f",
        "_RNvC1aü",
        "_RINvC1a1fRL9_hE",
    ],
)
def test_what_is_no_such_symbol_stays_as_it_is(symbol: str) -> None:
    assert demangled(symbol) == symbol


def test_a_name_that_grows_without_end_is_given_up() -> None:
    text, previous = "INvC1a1fTaaE", 8
    digits = string.digits + string.ascii_lowercase + string.ascii_uppercase
    for _ in range(40):  # a pair of references to the pair before: in all 2 ** 41 types
        high, low = divmod(previous - 1, 62)
        reference = f"B{digits[high] if high else ''}{digits[low]}_"
        previous, text = len(text), f"{text}T{reference * 2}E"
    assert demangled(f"_R{text}E") == f"_R{text}E"


def test_a_function_is_asked_for_as_it_is_shown() -> None:
    assert "a::work::total::<u32>" in spellings(demangled("_RINvNtCs6xxl1lAjzDf_1a4work5totalmEB4_"))
