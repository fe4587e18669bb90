"""``python -m dashboard``: the same as ``zenfi``, where no command of that name is on the path."""

from __future__ import annotations

from dashboard.cli import main

main()
