"""The API reference is built from docstrings, and its links lead somewhere."""

import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.soak

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


def test_every_module_has_a_page(reference: Path) -> None:
    for module in ("services.kernels", "deploy.mission.flight", "injector.node", "dashboard.api.app"):
        assert (reference / f"{module.replace('.', '/')}.html").is_file()


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
