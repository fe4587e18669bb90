"""Studies without flights are read back from what a page keeps."""

from pathlib import Path

import pytest

from dashboard.studies.kernels_alone import KernelsAlone
from dashboard.studies.redundant_computers import RedundantComputers
from dashboard.studies.specification import load
from deploy.errors import BadSpecError


def test_a_name_asks_for_a_study_as_it_is() -> None:
    assert load("fig6") == KernelsAlone()
    assert load("fig15") == RedundantComputers()
    assert load("fig7") is None
    assert load("fig6.toml") is None


@pytest.mark.parametrize(
    "asked",
    [
        KernelsAlone(kernels=("pid", "rrt", "octomap"), injections=7, seed=3, fault="scope=thread"),
        RedundantComputers(airframes=("spark",), computer_kg=0.1),
    ],
)
def test_a_specification_is_read_back(asked: KernelsAlone | RedundantComputers, tmp_path: Path) -> None:
    path = tmp_path / "asked.json"
    path.write_text(asked.model_dump_json())
    assert load(str(path)) == asked


def test_a_file_of_something_else_is_left_to_others_and_a_wrong_one_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "kernels.json"
    for other in ('{"name": "fig7"}', '{"name": ["fig6"]}', "[]", "{"):
        path.write_text(other)
        assert load(str(path)) is None
    path.write_text('{"name": "fig6", "injections": 0}')
    with pytest.raises(BadSpecError, match=r"kernels.json: injections: .*greater than or equal to 1"):
        load(str(path))
