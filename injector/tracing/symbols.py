"""Finding a function of a process by its name, as the linker has it or as C++ has it."""

from __future__ import annotations

import ctypes
import difflib
import re
from collections.abc import Iterable, Sequence
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

_RUST_HASH = re.compile(r"::h[0-9a-f]{16}$")
_RUST_SIGNS = {"LT": "<", "GT": ">", "RF": "&", "BP": "*", "C": ",", "LP": "(", "RP": ")", "SP": "@"}
_RUST_SIGN = re.compile(rf"\$({'|'.join(_RUST_SIGNS)}|u[0-9a-f]+)\$")


class SymbolError(Exception):
    """No function, or no library, or not just one: one line that names those that are like it."""


def function_at(pid: int, maps: MemoryMap, name: str, module: str = "") -> tuple[int, str]:
    """Address and mangled name of the one loaded function that is called so.

    ``name`` is mangled or not, with parameters or without; ``module`` narrows it to one library.

    :raises SymbolError: if there is none, or more than one.
    """
    matching, every = _matching(pid, maps, name, module)
    if len(matching) == 1:
        ((address, (_, symbol)),) = matching.items()
        return address, symbol
    if matching:
        found = sorted(
            f"{demangled(symbol)} ({symbol} in {_file(piece)})" for piece, symbol in matching.values()
        )
        message = f"symbol {name!r} is {len(found)} functions: give one in full: {some_of(found)}"
        raise SymbolError(message)
    where = f" in {module}" if module else ""
    if not every:
        message = f"symbol {name!r}: no names are left{where} (stripped); use --module"
        raise SymbolError(message)
    near = _near(name, {symbol for _, symbol, _ in every})
    message = f"symbol {name!r} not found{where}" + (f"; similar: {some_of(near)}" if near else "")
    raise SymbolError(message)


def functions_named(pid: int, maps: MemoryMap, name: str, module: str = "") -> dict[int, str]:
    """Addresses and mangled names of all loaded functions that are called so (see :func:`function_at`).

    :raises SymbolError: if there is none.
    """
    matching, _ = _matching(pid, maps, name, module)
    if not matching:
        function_at(pid, maps, name, module)
    return {address: symbol for address, (_, symbol) in matching.items()}


def _matching(
    pid: int, maps: MemoryMap, name: str, module: str
) -> tuple[dict[int, tuple[MemoryMapping, str]], list[tuple[MemoryMapping, str, int]]]:
    """The functions that are called so, by address; and all that were looked at."""
    pieces = module_code(maps, module) if module else [one for one in maps.code() if one.path]
    every = [(one, *found) for one in pieces for found in functions(pid, one)]
    wanted = plain(name)
    parts = _IDENTIFIER.findall(re.split("[<(]", wanted)[0])
    part = parts[-1] if parts and "operator" not in parts else ""
    matching: dict[int, tuple[MemoryMapping, str]] = {}
    for piece, symbol, address in every:
        if symbol == name or (
            symbol.startswith(("_Z", "_R")) and part in symbol and wanted in spellings(demangled(symbol))
        ):
            matching.setdefault(address, (piece, symbol))
    return matching, every


def module_code(maps: MemoryMap, name: str) -> list[MemoryMapping]:
    """The executable pieces of a loaded file, by its name or the beginning of it, or its path.

    :raises SymbolError: if no such file is loaded, or several are.
    """
    loaded = {one.path: _file(one) for one in maps.code() if one.path}
    exact = [path for path, file in loaded.items() if name in (path, file)]
    found = exact or [path for path, file in loaded.items() if file.startswith(name)]
    if len(found) == 1:
        return [one for one in maps.code() if one.path == found[0]]
    what = f"is {len(found)} files: {some_of(found)}" if found else "is not loaded"
    message = f"module {name!r} {what}" + ("" if found else f"; loaded: {', '.join(loaded.values())}")
    raise SymbolError(message)


def _file(piece: MemoryMapping) -> str:
    return Path(piece.path).name.removesuffix(" (deleted)")


def plain(name: str) -> str:
    """A C++ name without blanks that mean nothing."""
    return re.sub(r"\s*([,*&()<>])\s*", r"\1", " ".join(name.split()))


def spellings(name: str) -> set[str]:
    """What somebody may write for a demangled name: with return type and parameters or without."""
    whole = plain(name)
    bare = _without_parameters(whole)
    return {whole, whole[whole.index(bare) :], bare}


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
