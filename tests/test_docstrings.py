"""Docstrings: a first line helps whoever has not read the file, and the names in them exist."""

import ast
import builtins
import importlib
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.test_names import FLOORS, ROOT, modules

SHORTEST = 28
"""Characters of a first line; shorter ones turned out to be riddles ("Do it.")."""

RAISES = re.compile(r":raises ([^:]+):")
ROLE = re.compile(r":(class|func|meth|mod|data|attr|exc):`~?\.?([\w.]+)`")

Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@cache
def tree(path: Path) -> ast.Module:
    """The syntax tree of a module."""
    return ast.parse(path.read_text())


def module_name(path: Path) -> str:
    """The dotted name of a module."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def docstrings(parsed: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of the docstring of a module and of each class and function in it."""
    for node in ast.walk(parsed):
        text = ast.get_docstring(node) if isinstance(node, Documented) else None
        if text is not None:
            yield getattr(node, "lineno", 1), text


def too_short(parsed: ast.Module) -> Iterator[str]:
    """The first lines that say too little."""
    for line, text in docstrings(parsed):
        first = text.partition("\n")[0]
        if len(first) < SHORTEST:
            yield f"{line}: {first}"


def bound(parsed: ast.Module) -> set[str]:
    """Every name that a module defines, assigns or imports, on any level."""
    names = set()
    for node in ast.walk(parsed):
        match node:
            case ast.ClassDef() | ast.FunctionDef() | ast.AsyncFunctionDef():
                names.add(node.name)
            case ast.Name(ctx=ast.Store()):
                names.add(node.id)
            case ast.Attribute(ctx=ast.Store()):
                names.add(node.attr)
            case ast.alias():
                names.add(node.asname or node.name)
    return names


@cache
def known() -> dict[str, set[str]]:
    """Modules of product code, each with the names in it."""
    return {module_name(path): bound(tree(path)) for path in modules()}


def exists(name: str) -> bool:
    """Whether a name is one of a module of ours, a builtin, or in a package that can be imported."""
    *before, last = name.split(".")
    ours = known()
    if not before:
        return hasattr(builtins, last) or any(last in names for names in ours.values())
    if before[0] in FLOORS:
        owners = [".".join(before[:end]) for end in range(len(before), 0, -1)]
        owner = next((one for one in owners if one in ours), None)
        return name in ours or (owner is not None and last in ours[owner])
    if before[0][0].isupper() or "_" in before[0]:  # a class or a module beside this one
        return any({*before, last} <= names | {one.rpartition(".")[2]} for one, names in ours.items())
    return hasattr(importlib.import_module(".".join(before)), last)


def lost(parsed: ast.Module) -> Iterator[str]:
    """The names after ``:raises``, and in roles such as ``:class:``, that do not exist."""
    for line, text in docstrings(parsed):
        raised = [name for group in RAISES.findall(text) for name in group.split(", ")]
        for name in raised:
            if not exists(name):
                yield f"{line}: raises {name}"
        for role, name in ROLE.findall(text):
            beside = role == "mod" and any(one.endswith(f".{name}") for one in known())
            if not beside and not exists(name):
                yield f"{line}: {role} {name}"


def test_first_lines_say_enough() -> None:
    found = {module_name(path): short for path in modules() if (short := list(too_short(tree(path))))}
    assert found == {}


def test_names_in_docstrings_exist() -> None:
    found = {module_name(path): names for path in modules() if (names := list(lost(tree(path))))}
    assert found == {}


def test_riddles_and_lost_names_are_found() -> None:
    text = '''
def act():
    """Do it.

    :raises ValueError, LineError: see :class:`services.bus.session.Nobody` and :class:`subprocess.Popen`.
    """
'''
    parsed = ast.parse(text)
    assert list(too_short(parsed)) == ["2: Do it."]
    assert list(lost(parsed)) == ["2: raises LineError", "2: class services.bus.session.Nobody"]
