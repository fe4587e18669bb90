"""What the command tells of an error, and with which exit status."""

from __future__ import annotations

from pydantic import ValidationError

from dashboard.campaigns.store.database import StoreError
from deploy.compose.folder import StackError
from deploy.errors import BadSpecError, InfrastructureError, one_line
from deploy.mission.fork_server import ForkServerError
from deploy.pairing.golden_twin import NothingToInjectError
from detector.errors import DetectionInputError

BAD_INPUT = (BadSpecError, NothingToInjectError, DetectionInputError, StackError)
FAILURES = (InfrastructureError, ForkServerError, StoreError)


def told(error: Exception) -> tuple[int | None, str]:
    """The exit status of an error and its one line; no status for a bug, of which a traceback tells more."""
    if isinstance(error, ValidationError):
        return 2, one_line(error)
    if isinstance(error, BAD_INPUT):
        return 2, str(error)
    return (1 if isinstance(error, FAILURES) else None), str(error)
