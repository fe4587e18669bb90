"""Two installations that would fly differently are told apart."""

import pytest

from deploy.workers import installation


def test_an_installation_is_like_itself() -> None:
    assert (
        installation.own().difference(installation.Installation.model_validate_json(installation.told()))
        == ""
    )


@pytest.mark.parametrize("field", ["zenfi", "forms", "sources", "machine", "python"])
def test_each_difference_is_named(field: str) -> None:
    other = installation.own().model_copy(update={field: "other"})
    assert (
        installation.own()
        .difference(other)
        .endswith(f"is other there, {getattr(installation.own(), field)} here")
    )


def test_packages_that_compute_count() -> None:
    own = installation.own()
    other = own.model_copy(update={"packages": {**own.packages, "ompl": "9"}})
    assert own.difference(other) == f"ompl is 9 there, {own.packages['ompl']} here"
