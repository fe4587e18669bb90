"""Each recipe in ``docs/recipes`` holds one complete diff, and the diff applies to this tree."""

import re
import subprocess
from pathlib import Path

import pytest

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


def test_a_diff_of_something_else_does_not_apply() -> None:
    diff = "--- a/LICENSE\n+++ b/LICENSE\n@@ -1,1 +1,1 @@\n-no such line\n+another\n"
    assert "patch does not apply" in applies(diff, ROOT)
