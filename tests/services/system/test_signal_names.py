"""Every signal has a name."""

import signal

import pytest

from services.system.signal_names import signal_name

pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    ("number", "name"),
    [(11, "SIGSEGV"), (signal.SIGRTMIN, "SIGRTMIN"), (40, "SIGRTMIN+6"), (63, "SIGRTMIN+29")],
)
def test_a_signal_is_named(number: int, name: str) -> None:
    assert signal_name(number) == name
