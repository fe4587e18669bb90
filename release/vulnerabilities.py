"""Ask for known vulnerabilities of the locked versions: ``python3 launch.py vulnerabilities``.

pip-audit counts as harmless what the service does not know, and an index that mirrors PyPI may know
packages but none of their vulnerabilities. So first it is asked for one that is known to be there.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Any

from release.dependencies import LOCK

KNOWN = "requests==2.19.0"
"""Has CVE-2018-18074; a service that does not say so tells nothing."""

EXIT_VULNERABLE = 1
EXIT_NOT_ASKED = 3
_PATIENCE_S = 15


class NotAskedError(RuntimeError):
    """The service cannot be asked: one line that says why."""


def asked(pinned: Sequence[str]) -> list[dict[str, Any]]:
    """What pip-audit says of packages pinned to versions, an entry each.

    :raises NotAskedError: if it gets no answer.
    """
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("\n".join(pinned))
        file.flush()
        options = ("--no-deps", "--disable-pip", "--progress-spinner=off", "--format=json")
        command = [sys.executable, "-m", "pip_audit", *options, f"--timeout={_PATIENCE_S}", "-r", file.name]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        answer = json.loads(done.stdout)
    except ValueError:
        said = done.stderr.strip().splitlines() or [f"exit status {done.returncode}"]
        raise NotAskedError(said[-1]) from None
    return list(answer["dependencies"])


def check(pinned: Sequence[str]) -> list[str]:
    """The known vulnerabilities of packages pinned to versions, a line each.

    :raises NotAskedError: if the service cannot be asked, or not for all of them.
    """
    if not any(one.get("vulns") for one in asked([KNOWN])):
        message = f"the package index does not tell the known vulnerability of {KNOWN}"
        raise NotAskedError(message)
    answers = asked(pinned)
    if skipped := [one["name"] for one in answers if "skip_reason" in one]:
        message = f"not known to the service: {', '.join(skipped)}"
        raise NotAskedError(message)
    return [
        f"{one['name']} {one['version']}: {found['id']}; mended in: {' '.join(found['fix_versions'])}"
        for one in answers
        for found in one["vulns"]
    ]


def main() -> int:
    """Tell the vulnerabilities of what is locked: status 1 if there are any, 3 if nobody could be asked."""
    pinned = [line for line in LOCK.read_text().splitlines() if not line.startswith("#")]
    try:
        found = check(pinned)
    except NotAskedError as error:
        sys.stderr.write(f"vulnerabilities: not checked: {error}\n")
        return EXIT_NOT_ASKED
    sys.stdout.write("".join(f"{one}\n" for one in found))
    sys.stdout.write(f"{len(pinned)} packages asked for, {len(found)} known vulnerabilities\n")
    return EXIT_VULNERABLE if found else 0


if __name__ == "__main__":
    sys.exit(main())
