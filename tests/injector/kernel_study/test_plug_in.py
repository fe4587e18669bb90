"""A study of a planner that another package adds."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.scratch_environment import install_examples, zenfi


@pytest.mark.soak
def test_a_study_is_the_same_where_other_packages_are_installed(tmp_path: Path) -> None:
    """A worker that looked for its plug-in itself had what is installed in its memory: a strike differed."""

    def study() -> list[dict[str, Any]]:
        done = zenfi(tmp_path, "kernels run --kernel bit_star --injections 150 --json")
        return [line for line in map(json.loads, done.stdout.splitlines()) if "summary" not in line]

    install_examples(tmp_path)
    alone = study()
    (packages,) = (tmp_path / ".venv").glob("lib/*/site-packages")
    for number in range(40):
        other = packages / f"other_{number}-1.0.dist-info"
        other.mkdir()
        (other / "METADATA").write_text(f"Metadata-Version: 2.1\nName: other-{number}\nVersion: 1.0\n")
        names = "\n".join(f"other_{number}_{one} = nothing:NOTHING" for one in range(20))
        (other / "entry_points.txt").write_text(f"[zenfi.planners]\n{names}\n")
    assert study() == alone
    assert len(alone) == 150
