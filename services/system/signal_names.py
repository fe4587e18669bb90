"""Names of signals, real-time ones included."""

from __future__ import annotations

import signal


def signal_name(number: int) -> str:
    """The name of a signal as signal(7) has it: SIGSEGV, SIGRTMIN+6.

    >>> signal_name(11)
    'SIGSEGV'
    """
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"SIGRTMIN+{number - signal.SIGRTMIN}"
