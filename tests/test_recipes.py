"""Each recipe in ``docs/recipes`` holds one complete diff, and the diff applies to this tree."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.scratch_environment import install, make_environment

ROOT = Path(__file__).parents[1]
RECIPES = sorted((ROOT / "docs" / "recipes").glob("*.md"))
DIFF = re.compile(r"^```diff\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def diff_of(recipe: Path) -> str:
    """The diff of a recipe."""
    found = DIFF.findall(recipe.read_text())
    assert len(found) == 1
    return str(found[0])


def applies(diff: str, folder: Path) -> str:
    """What ``git apply --check`` has against a diff; nothing if it applies."""
    done = subprocess.run(
        ["git", "apply", "--check", "-"],  # noqa: S607 - the git in PATH
        cwd=folder,
        input=diff,
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stderr if done.returncode else ""


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.stem)
def test_the_diff_of_a_recipe_applies(recipe: Path) -> None:
    assert applies(diff_of(recipe), ROOT) == ""


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.stem)
def test_a_recipe_says_what_to_run(recipe: Path) -> None:
    assert re.search(r"^## Run it$", recipe.read_text(), re.MULTILINE)


def test_there_is_a_recipe_for_each_kind_of_part() -> None:
    parts = {"kernel", "planner", "detector", "world", "node", "fault_model", "page", "rest_resource"}
    assert {recipe.stem for recipe in RECIPES} == parts


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout of its own, installed in an environment of its own that has our packages, too."""
    folder = tmp_path_factory.mktemp("recipe") / "zenfi"
    run(ROOT, f"git checkout-index --all --prefix={folder}/")
    make_environment(folder)
    install(folder, "-e", ".")
    return folder


def run(folder: Path, command: str) -> None:
    """Run one line of a recipe in a checkout, with the commands of its environment."""
    path = f"{folder / '.venv' / 'bin'}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    words = shlex.split(command, comments=True)
    if words[0] == "pytest":
        words = [".venv/bin/python", "-m", *words]
    done = subprocess.run(
        words,
        cwd=folder,
        env={**os.environ, "PATH": path},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}"


@pytest.mark.soak
@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.stem)
def test_a_recipe_that_is_carried_out_works(recipe: Path, checkout: Path) -> None:
    """Apply the diff, run what is to be run; a server is not begun."""
    diff = checkout / "recipe.diff"
    diff.write_text(diff_of(recipe))
    to_run = recipe.read_text().split("## Run it")[1].split("## The diff")[0]
    run(checkout, "git apply recipe.diff")
    try:
        for line in re.findall(r"^\$ (.*)$", to_run, re.MULTILINE):
            if line.startswith("pip "):
                install(checkout, "-e", ".")
            elif not line.startswith(("zenfi serve", "curl ")):
                run(checkout, line)
    finally:
        run(checkout, "git apply -R recipe.diff")


def test_a_diff_of_something_else_does_not_apply() -> None:
    diff = "--- a/LICENSE\n+++ b/LICENSE\n@@ -1,1 +1,1 @@\n-no such line\n+another\n"
    assert "patch does not apply" in applies(diff, ROOT)
