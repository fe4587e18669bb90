"""``import zenfi`` is quick, typed and whole: what a name needs is loaded when it is used."""

import subprocess
import sys
import typing

import pytest

import zenfi
from services.models.mission import MissionSpec
from zenfi.mission_fields import MissionFields

pytestmark = pytest.mark.process


def loaded_by(code: str) -> set[str]:
    """The top-level modules that a new Python has loaded after ``code``."""
    show = "import sys; print(*{name.partition('.')[0] for name in sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; {show}"], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_the_import_alone_loads_nothing_of_ours_or_others() -> None:
    own = loaded_by("import zenfi") - loaded_by("import typing, importlib")
    assert own <= {"zenfi", *sys.stdlib_module_names}


def test_every_public_name_is_there_and_listed() -> None:
    assert dir(zenfi) == sorted(zenfi.__all__)
    for name in zenfi.__all__:
        assert getattr(zenfi, name) is not None, name
    with pytest.raises(AttributeError, match="nonsense"):
        zenfi.nonsense  # noqa: B018


def test_names_stay_what_they_are_in_whatever_order_they_are_used() -> None:
    for first, second in (("Campaign", "campaigns"), ("kernels", "fly"), ("fly", "kernels")):
        code = f"import zenfi; zenfi.{first}; print(type(zenfi.{second}).__name__)"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["module" if second == "kernels" else "function"]


def test_editors_know_every_field_of_a_mission() -> None:
    told = set(typing.get_type_hints(MissionFields))
    assert told == (set(MissionSpec.model_fields) - {"fault"}) | {"profile"}
