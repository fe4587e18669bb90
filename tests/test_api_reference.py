"""The API reference is built from docstrings, and its links lead somewhere."""

import ast
import re
import subprocess
import sys
import tomllib
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("services", "sim", "injector", "detector", "deploy", "dashboard", "zenfi")

LINK = re.compile(r'<a [^>]*href="([^"]+)"')
ANCHOR = re.compile(r' id="([^"]+)"')
SCRIPT = re.compile(r"<script.*?</script>", re.DOTALL)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the reference, built as ``python3 launch.py docs`` builds it."""
    folder = tmp_path_factory.mktemp("reference")
    command = [sys.executable, str(ROOT / "docs" / "api.py"), str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def named(requirement: str) -> str:
    """The name of the distribution that a requirement is for, as all spellings of it are normalised."""
    return re.split(r"[^\w.-]", requirement)[0].lower().replace("_", "-")


def installed_with(extra: str) -> set[str]:
    """All distributions that ``zenfi[extra]`` brings, those that its requirements require included."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras[extra]]
    for several in re.findall(r"zenfi\[(.*?)\]", " ".join(wanted)):
        wanted += [one for part in several.split(",") for one in extras[part]]
    found: set[str] = set()
    while wanted:
        if (name := named(wanted.pop())) not in found | {"zenfi"}:
            found.add(name)
            with suppress(PackageNotFoundError):  # for another system
                wanted += [one for one in requires(name) or () if "extra ==" not in one]
    return found


def imported(file: Path) -> set[str]:
    """Top-level names of what a module imports as soon as it is imported itself."""
    found: set[str] = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.Import):
            found |= {one.name.partition(".")[0] for one in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.partition(".")[0])
    return found


def test_the_extra_brings_what_every_module_imports() -> None:
    distributions = packages_distributions()
    brought = installed_with("docs")
    lacking = {
        f"{file.relative_to(ROOT)}: {name}"
        for package in PACKAGES
        for file in (ROOT / package).rglob("*.py")
        for name in imported(file) - sys.stdlib_module_names - set(PACKAGES)
        if not brought & {named(one) for one in distributions.get(name, [name])}
    }
    assert lacking == set()


@pytest.mark.soak
def test_every_module_has_a_page(reference: Path) -> None:
    for module in ("services.kernels", "deploy.mission.flight", "injector.node", "dashboard.api.app"):
        assert (reference / f"{module.replace('.', '/')}.html").is_file()


@pytest.mark.soak
def test_links_lead_to_a_page_and_an_anchor(reference: Path) -> None:
    pages = {page: SCRIPT.sub("", page.read_text()) for page in reference.rglob("*.html")}
    anchors = {page: set(ANCHOR.findall(text)) for page, text in pages.items()}
    lost = []
    for page, text in pages.items():
        for target in set(LINK.findall(text)):
            path, _, anchor = target.partition("#")
            if "://" in target:
                continue
            file = (page.parent / unquote(path)).resolve() if path else page
            if file not in pages or (anchor and unquote(anchor) not in anchors[file]):
                lost.append(f"{page.relative_to(reference)}: {target}")
    assert lost == []
