"""Finding a function of a process by its name, as the linker has it or as C++ has it."""

from __future__ import annotations

import ctypes
import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from injector.tracing.elf import functions
from injector.tracing.process import MemoryMap, MemoryMapping
from injector.tracing.rust_names import rust_name
from services.system.libc import libc

SHOWN = 6
"""How many candidates a refusal shows."""

_IDENTIFIER = re.compile(r"[A-Za-z_]\w*")

_CLONE = re.compile(r"(\.(part|isra|constprop|cold|localalias|lto_priv|llvm|clone|actor|destroy)(\.\d+)*)+$")
_COLD = ".cold"
_THUNKS = ("_ZTh", "_ZTv", "_ZTc")
_ABI_TAG = re.compile(r"\[abi:\w+\]")

_RUST_HASH = re.compile(r"::h[0-9a-f]{16}$")
_RUST_SIGNS = {"LT": "<", "GT": ">", "RF": "&", "BP": "*", "C": ",", "LP": "(", "RP": ")", "SP": "@"}
_RUST_SIGN = re.compile(rf"\$({'|'.join(_RUST_SIGNS)}|u[0-9a-f]+)\$")


class SymbolError(Exception):
    """No function, or no library, or not just one: one line that names those that are like it."""


@dataclass(frozen=True, slots=True)
class LoadedFunction:
    """A function that a loaded file defines: where it begins, its symbol, and the path of the file."""

    address: int
    symbol: str
    path: str

    @property
    def full_name(self) -> str:
        """Its whole name: that of C++ or Rust where it is one of theirs. Variants of a function share it."""
        return full_name(self.symbol)

    @property
    def file(self) -> str:
        """The name of the file that defines it, without its folder."""
        return _file_name(self.path)


def function_at(pid: int, maps: MemoryMap, name: str, module: str = "") -> tuple[int, str]:
    """Address and mangled name of the one loaded function that is called so.

    ``name`` is mangled or not, with parameters or without; ``module`` narrows it to one library.

    :raises SymbolError: if there is none, or it has more than one address.
    """
    found = variants_of(pid, maps, name, module)
    if len(found) == 1:
        return found[0].address, found[0].symbol
    several = sorted(f"{one.symbol} in {one.file}" for one in found)
    message = f"symbol {name!r} is {len(found)} pieces of code: give one mangled: {some_of(several)}"
    raise SymbolError(message)


def variants_of(pid: int, maps: MemoryMap, name: str, module: str = "") -> list[LoadedFunction]:
    """All places at which the one function begins that is called so, in the order of loaded files.

    These are what a compiler makes of one function (constructors and destructors that begin at several
    places, clones for some arguments), and the copies that several files define; one for each address.
    ``name`` is mangled or not, with parameters or without; a mangled one is of that variant alone.
    ``module`` narrows it to one library.

    :raises SymbolError: if there is none, or functions of several full names are called so.
    """
    matching, every = _matching(pid, maps, name, module)
    by_name: dict[str, list[LoadedFunction]] = {}
    for one in matching:
        by_name.setdefault(one.full_name, []).append(one)
    in_full = {plain(full): one for full, one in by_name.items()}.get(plain(name))
    if in_full and len({one.path for one in matching}) == 1:
        return in_full
    if len(by_name) == 1:
        return matching
    if matching:
        found = sorted(_shown(full, several) for full, several in by_name.items())
        message = f"symbol {name!r} is {len(found)} functions: give one in full: {some_of(found)}"
        raise SymbolError(message)
    where = f" in {module}" if module else ""
    if not every:
        message = f"symbol {name!r}: no names are left{where} (stripped); use --module"
        raise SymbolError(message)
    near = _near(name, {one.symbol for one in every})
    message = f"symbol {name!r} not found{where}" + (f"; similar: {some_of(near)}" if near else "")
    raise SymbolError(message)


def copies_elsewhere(pid: int, maps: MemoryMap, function: Sequence[LoadedFunction]) -> list[LoadedFunction]:
    """What other files define by the symbols of a function, and may run in its place.

    Of a symbol of C++ that is so if it has external linkage; else if both files offer it to others.
    """
    own = {one.path for one in function}
    pieces = [one for one in maps.code() if one.path]
    offered = {(one.path, symbol) for one in pieces for symbol, _ in functions(pid, one, exported=True)}
    shared = {one.symbol for one in function if _is_external(one.symbol) or (one.path, one.symbol) in offered}
    return [
        LoadedFunction(address, symbol, one.path)
        for one in pieces
        if one.path not in own
        for symbol, address in dict(functions(pid, one)).items()
        if symbol in shared and (_is_external(symbol) or (one.path, symbol) in offered)
    ]


def _is_external(symbol: str) -> bool:
    """Whether a symbol of C++ stands for the same function in whatever file."""
    return symbol.startswith("_Z") and not symbol.startswith("_ZL") and "_GLOBAL__N_" not in symbol


def _shown(full: str, several: list[LoadedFunction]) -> str:
    """A full name to choose; mangled ones and files where they tell apart what has the same name."""
    symbols = sorted({one.symbol for one in several})
    files = ", ".join(sorted({one.file for one in several}))
    return f"{full} ({', '.join(symbols)} in {files})" if symbols != [full] else f"{full} (in {files})"


def functions_named(pid: int, maps: MemoryMap, name: str, module: str = "") -> dict[int, str]:
    """Addresses and mangled names of all loaded functions that are called so (see :func:`function_at`).

    :raises SymbolError: if there is none.
    """
    matching, _ = _matching(pid, maps, name, module)
    if not matching:
        variants_of(pid, maps, name, module)
    return {one.address: one.symbol for one in matching}


def _matching(
    pid: int, maps: MemoryMap, name: str, module: str
) -> tuple[list[LoadedFunction], list[LoadedFunction]]:
    """The functions that are called so, one for each address; and all that were looked at.

    Neither parts of a function to which nobody calls (``.cold``) nor thunks, which lead to one, are in
    question, unless they are named by their symbol.
    """
    pieces = module_code(maps, module) if module else [one for one in maps.code() if one.path]
    every = [
        LoadedFunction(address, symbol, one.path) for one in pieces for symbol, address in functions(pid, one)
    ]
    wanted = plain(name)
    parts = _IDENTIFIER.findall(re.split("[<(\\[]", wanted)[0])
    part = parts[-1] if parts and "operator" not in parts else ""
    matching: dict[int, LoadedFunction] = {}
    for one in every:
        if one.symbol == name or (part in one.symbol and _is_called(one.symbol, name, wanted)):
            matching.setdefault(one.address, one)
    return list(matching.values()), every


def _is_called(symbol: str, name: str, wanted: str) -> bool:
    """Whether a function may be meant by a name other than its very symbol; ``wanted`` is that in plain."""
    if _COLD in symbol or symbol.startswith(_THUNKS):
        return False
    of_one = _CLONE.sub("", symbol)
    if of_one == name or name.startswith(("_Z", "_R")):
        return of_one == name
    return symbol.startswith(("_Z", "_R")) and wanted in spellings(full_name(symbol))


def _spelled_part(wanted: str) -> str:
    """A part of a name that its symbol has, too, so that others need not be demangled; empty: none is known.

    That is the function's own name. Enclosing ones may be abbreviated, operators and lambdas are.
    """
    bare = _without_parameters(_ABI_TAG.sub("", wanted))
    depth, end = 0, len(bare)
    while end and (depth or bare[end - 1] == ">"):
        depth += {">": 1, "<": -1}.get(bare[end - 1], 0)
        end -= 1
    parts = _IDENTIFIER.findall(bare[:end].rpartition("::")[2])
    return "" if not parts or "operator" in bare or "{" in bare else parts[-1]


def module_code(maps: MemoryMap, name: str) -> list[MemoryMapping]:
    """The executable pieces of a loaded file, by its name or the beginning of it, or its path.

    :raises SymbolError: if no such file is loaded, or several are.
    """
    loaded = {one.path: _file_name(one.path) for one in maps.code() if one.path}
    exact = [path for path, file in loaded.items() if name in (path, file)]
    found = exact or [path for path, file in loaded.items() if file.startswith(name)]
    if len(found) == 1:
        return [one for one in maps.code() if one.path == found[0]]
    what = f"is {len(found)} files: {some_of(found)}" if found else "is not loaded"
    message = f"module {name!r} {what}" + ("" if found else f"; loaded: {', '.join(loaded.values())}")
    raise SymbolError(message)


def _file_name(path: str) -> str:
    return Path(path).name.removesuffix(" (deleted)")


def full_name(symbol: str) -> str:
    """The whole name of a function, whatever variant of it a symbol is of."""
    return demangled(_CLONE.sub("", symbol))


def plain(name: str) -> str:
    """A C++ name without blanks that mean nothing."""
    return re.sub(r"\s*([,*&()<>])\s*", r"\1", " ".join(name.split()))


def spellings(name: str) -> set[str]:
    """What somebody may write for a demangled name: with return type, parameters and ABI tags or without."""
    found = set()
    for whole in {plain(name), plain(_ABI_TAG.sub("", name))}:
        bare = _without_parameters(whole)
        found |= {whole, whole[whole.index(bare) :], bare}
    return found


def _without_parameters(name: str) -> str:
    """``f<g(int)>(double) const`` is ``f<g(int)>``; the return type of templates goes, too."""
    depth, begin = 0, len(name)
    for at, letter in enumerate(name):
        depth += {"<": 1, ">": -1}.get(letter, 0)
        if letter == "(" and depth == 0 and not name.startswith("(anonymous namespace)", at) and at:
            begin = at
            break
    head, depth = name[:begin], 0
    for at in range(len(head) - 1, -1, -1):
        depth += {">": 1, "<": -1}.get(head[at], 0)
        if head[at] == " " and depth == 0 and not head[:at].endswith("operator"):
            return head[at + 1 :]
    return head


@cache
def _demangler() -> Any:
    """``abi::__cxa_demangle`` of the C++ library; None where there is none."""
    try:
        function = ctypes.CDLL("libstdc++.so.6").__cxa_demangle
    except (OSError, AttributeError):
        return None
    function.restype = ctypes.c_void_p
    function.argtypes = [ctypes.c_char_p, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    return function


def demangled(symbol: str) -> str:
    """What C++ or Rust calls a function; another name stays as it is."""
    if symbol.startswith("_R"):
        return rust_name(symbol) or symbol
    if not symbol.startswith("_Z") or _demangler() is None:
        return symbol
    found = _demangler()(symbol.encode(), None, None, None)
    if not found:
        return symbol
    try:
        name = ctypes.string_at(found).decode(errors="replace")
    finally:
        libc.free(ctypes.c_void_p(found))
    return _of_rust(name) if _RUST_HASH.search(name) else name


def _of_rust(name: str) -> str:
    """A name of Rust, as C++ demangles it, without its hash and with its own signs (legacy mangling)."""
    without = _RUST_HASH.sub("", name).replace("..", "::")
    shown = _RUST_SIGN.sub(lambda sign: _RUST_SIGNS.get(sign[1]) or chr(int(sign[1][1:], 16)), without)
    return re.sub(r"(^|::)_(?=<)", r"\1", shown)


def _near(name: str, symbols: Iterable[str]) -> list[str]:
    identifiers = _IDENTIFIER.findall(name.split("(", maxsplit=1)[0])
    last = identifiers[-1].lower() if identifiers else name.lower()
    by_end: dict[str, str] = {}
    for symbol in sorted(symbols):
        shown = _without_parameters(plain(demangled(symbol)))
        end = shown.rpartition("::")[2].lower()
        if _IDENTIFIER.fullmatch(end):
            by_end.setdefault(end, shown)
    close = difflib.get_close_matches(last, by_end, SHOWN, 0.75)
    holding = [end for end in by_end if last in end and end not in close]
    return [by_end[end] for end in [*close, *holding][:SHOWN]]


def some_of(names: Sequence[str]) -> str:
    """So many of some names as a refusal shows, and how many more there are."""
    more = len(names) - SHOWN
    return "; ".join(names[:SHOWN]) + (f"; and {more} more" if more > 0 else "")
