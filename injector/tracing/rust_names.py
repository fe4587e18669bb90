"""Names of Rust, from symbols that are mangled in its newer way (v0): paths without the hashes of crates.

Source: RFC 2603.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial

_BASIC = {"a": "i8", "b": "bool", "c": "char", "d": "f64", "e": "str", "f": "f32", "h": "u8", "i": "isize"}
_BASIC |= {"j": "usize", "l": "i32", "m": "u32", "n": "i128", "o": "u128", "p": "_", "s": "i16", "t": "u16"}
_BASIC |= {"u": "()", "v": "...", "x": "i64", "y": "u64", "z": "!"}
_DIGITS = "0123456789abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ"
_MOST = 10_000
"""References to earlier parts: with them a short symbol can have a name without end."""


def rust_name(symbol: str) -> str | None:
    """The name behind a symbol ``_R...``; None if it is none that is known."""
    whole = symbol[2:].partition(".")[0]
    if not symbol.startswith("_R") or not symbol.isascii() or not whole[:1].isupper():
        return None
    try:
        return _Reader(whole).whole()
    except (ValueError, IndexError, RecursionError):
        return None


class _Reader:
    """Reads a symbol from left to right; ValueError or IndexError if it does not fit."""

    def __init__(self, text: str) -> None:
        self._text, self._at, self._bound, self._references = text, 0, 0, 0

    def whole(self) -> str:
        """The name; behind it may stand the crate for which generic code was made."""
        name = self.part("::")
        if self._at < len(self._text):
            self.part()
        return name if self._at == len(self._text) else self._fail()

    def part(self, turbofish: str = "") -> str:  # noqa: C901, PLR0911, PLR0912 - one case a letter
        """A path or a type; generic arguments of functions follow ``turbofish``."""
        match tag := self._next():
            case "C":
                return self._identifier()[0]
            case "M" | "X" | "Y":
                if tag != "Y":  # where it is implemented
                    self._number_after("s")
                    self.part()
                return f"<{self.part()}>" if tag == "M" else f"<{self.part()} as {self.part()}>"
            case "N":
                space, within, (name, number) = self._next(), self.part(turbofish), self._identifier()
                if space.isupper():
                    kind = {"C": "closure", "S": "shim"}.get(space, space)
                    return f"{within}::{{{kind}{name and ':' + name}#{number}}}"
                return f"{within}::{name}" if name else within
            case "I":
                return f"{self.part(turbofish)}{turbofish}<{', '.join(self._list(self._argument))}>"
            case "B":
                return self._earlier(partial(self.part, turbofish))
            case "R" | "Q":
                lifetime = self._lifetime(self._number()) if self._eats("L") else ""
                return f"&{lifetime and lifetime + ' '}{'mut ' if tag == 'Q' else ''}{self.part()}"
            case "P" | "O":
                return ("*const " if tag == "P" else "*mut ") + self.part()
            case "A":
                return f"[{self.part()}; {self._constant()}]"
            case "S":
                return f"[{self.part()}]"
            case "T":
                parts = self._list(self.part)
                return f"({', '.join(parts)}{',' if len(parts) == 1 else ''})"
            case "F":
                return self._binding(self._function)
            case "D":
                bounds = "dyn " + self._binding(lambda: " + ".join(self._list(self._trait)))
                lifetime = self._argument()
                return bounds if lifetime == "'_" else f"{bounds} + {lifetime}"
        return _BASIC[tag] if tag in _BASIC else self._fail()

    def _argument(self) -> str:
        if self._eats("L"):
            return self._lifetime(self._number()) or "'_"
        return self._constant() if self._eats("K") else self.part()

    def _function(self) -> str:
        unsafe, abi = "unsafe " if self._eats("U") else "", ""
        if self._eats("K"):
            abi = f'extern "{"C" if self._eats("C") else self._name().replace("_", "-")}" '
        parameters, result = ", ".join(self._list(self.part)), self.part()
        return f"{unsafe}{abi}fn({parameters})" + ("" if result == "()" else f" -> {result}")

    def _trait(self) -> str:
        whole, types = self.part(), list[str]()
        while self._eats("p"):
            types.append(f"{self._name()} = {self.part()}")
        if types:
            inner = whole[:-1] + ", " if whole.endswith(">") else whole + "<"
            return f"{inner}{', '.join(types)}>"
        return whole

    def _constant(self) -> str:
        if self._eats("B"):
            return self._earlier(self._constant)
        kind, sign = self._next(), "-" if self._eats("n") else ""
        if kind == "p":
            return "_"
        value = int(self._take("[0-9a-f]*_")[:-1] or "0", 16)
        if kind == "b":
            return ("false", "true")[value]
        return repr(chr(value)) if kind == "c" else f"{sign}{value}"

    def _binding(self, read: Callable[[], str]) -> str:
        bound = self._number_after("G")
        self._bound += bound
        names = ", ".join(self._lifetime(one) for one in range(bound, 0, -1))
        found = (f"for<{names}> " if names else "") + read()
        self._bound -= bound
        return found

    def _lifetime(self, index: int) -> str:
        if index > self._bound:
            self._fail()
        return f"'{_DIGITS[10:36][self._bound - index]}" if index else ""

    def _earlier(self, read: Callable[[], str]) -> str:
        here, back = self._at - 1, self._number()
        self._references += 1
        if back >= here or self._references > _MOST:
            self._fail()
        after, self._at = self._at, back
        found = read()
        self._at = after
        return found

    def _list(self, read: Callable[[], str]) -> list[str]:
        found = []
        while not self._eats("E"):
            found.append(read())
        return found

    def _identifier(self) -> tuple[str, int]:
        number = self._number_after("s")
        return self._name(), number

    def _name(self) -> str:
        foreign, length = self._eats("u"), int(self._take("0|[1-9][0-9]*"))
        self._eats("_")
        self._at += length
        name = self._text[self._at - length : self._at]
        plain, _, coded = name.rpartition("_")
        return f"{plain}-{coded}".removeprefix("-").encode().decode("punycode") if foreign else name

    def _number(self) -> int:
        digits = self._take("[0-9a-zA-Z]*_")[:-1]
        value = sum(_DIGITS.index(one) * 62**place for place, one in enumerate(reversed(digits)))
        return value + 1 if digits else 0

    def _number_after(self, tag: str) -> int:
        return self._number() + 1 if self._eats(tag) else 0

    def _take(self, pattern: str) -> str:
        found = re.compile(pattern).match(self._text, self._at)
        self._at = found.end() if found is not None else len(self._text)
        return found[0] if found is not None else self._fail()

    def _eats(self, tag: str) -> bool:
        eaten = self._text.startswith(tag, self._at)
        self._at += eaten
        return eaten

    def _next(self) -> str:
        self._at += 1
        return self._text[self._at - 1]

    def _fail(self) -> str:
        raise ValueError(self._text[self._at :])
