"""Where the store is if nobody says so. To import it is cheap: the help of commands names it."""

from __future__ import annotations

import os
from pathlib import Path


def default_folder() -> Path:
    """``ZENFI_HOME``, or the user's folder for data."""
    home = os.environ.get("ZENFI_HOME")
    return Path(home) if home else Path.home() / ".local" / "share" / "zenfi"
