"""A budget is read with its sources, and what is wrong with it is one clear line."""

from pathlib import Path

import pytest

from dashboard.evidence.budget import load_budget
from deploy.errors import BadSpecError

SOUND = """
name = "companion computer"
target_per_hour = 1e-6

[[elements]]
name = "registers of pid"
arm = "baseline"
fault = "pid"
fit = { value = 700, low = 500, high = 1000, source = "beam test" }
flux = { value = 1.3, source = "JESD89B" }
share = { value = 0.02, source = "zenfi bench platform" }
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "budget.toml"
    path.write_text(text)
    return path


def test_a_budget_is_what_its_file_says(tmp_path: Path) -> None:
    budget = load_budget(written(tmp_path, SOUND))
    (one,) = budget.elements
    assert (one.fit.value, one.fit.high, one.flux.low, one.share.source) == (
        700.0,
        1000.0,
        None,
        "zenfi bench platform",
    )
    assert budget.confidence == 0.95


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('source = "JESD89B"', 'source = ""', "flux"),
        (", high = 1000", "", "low and high"),
        ("low = 500", "low = 800", "between low and high"),
        ("value = 0.02", "value = 1.2", "share"),
        ("value = 1.3", "value = 0", "flux"),
        ("target_per_hour", "target", "target"),
        ("[[elements]]", "[elements]", "elements"),
        ("name =", "name", "budget.toml"),
    ],
)
def test_what_is_wrong_is_one_line(old: str, new: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(BadSpecError, match=told) as caught:
        load_budget(written(tmp_path, SOUND.replace(old, new)))
    assert "\n" not in str(caught.value)
    assert "budget.toml" in str(caught.value)


def test_two_elements_of_one_name_and_no_file(tmp_path: Path) -> None:
    with pytest.raises(BadSpecError, match="same name"):
        load_budget(written(tmp_path, SOUND + SOUND[SOUND.index("[[elements]]") :]))
    with pytest.raises(BadSpecError, match="No such file"):
        load_budget(tmp_path / "absent.toml")
