"""``python -m dashboard.api``: the same as ``zenfi serve``."""

from __future__ import annotations

import sys

from dashboard.cli import main

sys.argv[1:1] = ["serve"]
main()
