"""The process that makes one study of a program for the service, and dies with it.

Run as ``python -m dashboard.api.processes.program_process PARENT FOLDER SLOTS``, where FOLDER is the study's.
Exit status 0: all runs are made; 2: they cannot be, one line on standard error says why; 130 after SIGTERM:
it was told to leave, and what is made is kept.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from types import FrameType

from dashboard.api.processes.program_studies import RUNS, making
from deploy.errors import BadSpecError, InfrastructureError
from deploy.kernel_study.program_study import program_study
from services.system.lifeline import die_with_parent


def main() -> None:
    """Make the runs of a study that are not made yet."""
    parent, folder, slots = sys.argv[1:]
    die_with_parent(int(parent))
    signal.signal(signal.SIGTERM, _leave)
    try:
        with (
            making(Path(folder)) as entry,
            program_study(entry.spec, Path(folder) / RUNS, int(slots)) as (study, section),
        ):
            section.finish(study.run())
    except BadSpecError as error:
        print(error, file=sys.stderr)  # noqa: T201 - the service keeps it
        sys.exit(2)
    except InfrastructureError as error:
        print(error, file=sys.stderr)  # noqa: T201
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


def _leave(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
