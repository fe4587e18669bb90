"""What the documents name exists: paths, modules, classes, functions, and what links lead to."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path.relative_to(ROOT)
    for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"))
    if path.parent.name != "recipes"
)
RECIPES = sorted(path.relative_to(ROOT) for path in ROOT.glob("docs/recipes/*.md"))
FOLDERS = ("services", "sim", "injector", "detector", "deploy", "dashboard", "zenfi", "tests", "docs")

QUOTED = re.compile(r"`([^`\n]+)`")
PATH = re.compile(rf"(?:{'|'.join(FOLDERS)})(?:/[\w.*-]+)+/?")
DOTTED = re.compile(rf"(?:{'|'.join(FOLDERS)})(?:\.\w+)+(?::\w+(?:\.\w+)?)?(?:\(\w*\))?")
KINDS = ("detectors", "guards", "masks", "pilots", "planners", "signals", "worlds")
NOT_OURS = {"zenfi.sqlite", "zenfi/stack/HOST/NAME", *(f"zenfi.{kind}" for kind in KINDS)}
"""A file, a key of the bus and groups of entry points, which are called as modules of ours could be."""

LINK = re.compile(r"\]\(([^)\s]+)\)")
FENCED = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def prose(page: Path) -> str:
    """The text of a page without its blocks of code."""
    return FENCED.sub("", (ROOT / page).read_text())


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", FENCED.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@cache
def declared(module: Path) -> frozenset[str]:
    """Names that a module's file declares or imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)}
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {one.asname or one.name for one in node.names}
    return frozenset(found)


def is_there(dotted: str) -> bool:
    """Whether a dotted name is a module of ours, or something that one declares."""
    parts = re.split(r"[.:]", dotted.partition("(")[0])
    place = ROOT
    for index, part in enumerate(parts):
        if (place / part).is_dir():
            place /= part
            continue
        module = place / f"{part}.py"
        if module.is_file():
            return set(parts[index + 1 :]) <= declared(module)
        return (place / "__init__.py").is_file() and set(parts[index:]) <= declared(place / "__init__.py")
    return True


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CHANGELOG.md"], ids=str)
def test_what_a_page_names_exists(page: Path) -> None:
    quoted = [name for name in QUOTED.findall(prose(page)) if name not in NOT_OURS]
    paths = [name for name in quoted if PATH.fullmatch(name)]
    missing = [name for name in paths if not list(ROOT.glob(name.rstrip("/")))]
    files = [name for name in quoted if re.fullmatch(r"\w+\.py", name)]
    missing += [name for name in files if not any(list(ROOT.glob(f"{top}/**/{name}")) for top in FOLDERS)]
    dotted = [name for name in quoted if DOTTED.fullmatch(name) and name not in paths]
    missing += [name for name in dotted if not is_there(name)]
    assert missing == []


@pytest.mark.parametrize("page", [*PAGES, *RECIPES], ids=str)
def test_links_lead_somewhere(page: Path) -> None:
    lost = []
    for target in LINK.findall(prose(page)):
        path, _, anchor = target.partition("#")
        if "://" in target:
            continue
        file = ROOT / page.parent / path if path else ROOT / page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            lost.append(target)
    assert lost == []


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_modules_that_a_page_runs_exist(page: Path) -> None:
    commands = re.findall(r"python -m (tests(?:\.\w+)+)", (ROOT / page).read_text())
    assert [one for one in commands if not is_there(one)] == []


def test_every_page_is_linked_from_the_readme_or_its_neighbours() -> None:
    linked = {
        (ROOT / page.parent / target.partition("#")[0]).resolve()
        for page in (*PAGES, *RECIPES)
        for target in LINK.findall(prose(page))
        if "://" not in target
    }
    own = {ROOT / "README.md", ROOT / "CHANGELOG.md"}
    assert {ROOT / page for page in (*PAGES, *RECIPES)} - own <= linked


def test_names_that_are_not_there_are_found_missing() -> None:
    assert is_there("deploy.mission.flight.fly")
    assert is_there("services.control.pid:pid")
    assert not is_there("deploy.mission.flight.run_mission")
    assert not is_there("services.no_such_module")
