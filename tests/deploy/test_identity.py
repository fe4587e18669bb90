"""Two installations that would fly differently are told apart."""

import pytest

from deploy import identity


def test_an_installation_is_like_itself() -> None:
    assert identity.own().difference(identity.Identity.model_validate_json(identity.told())) == ""


@pytest.mark.parametrize("field", ["zenfi", "forms", "sources", "machine", "python"])
def test_each_difference_is_named(field: str) -> None:
    other = identity.own().model_copy(update={field: "other"})
    assert identity.own().difference(other).endswith(f"is other there, {getattr(identity.own(), field)} here")


def test_packages_that_compute_count() -> None:
    own = identity.own()
    other = own.model_copy(update={"packages": {**own.packages, "ompl": "9"}})
    assert own.difference(other) == f"ompl is 9 there, {own.packages['ompl']} here"
