"""Licences of packages: what their metadata state, and whether that leaves our own licence as it is."""

from __future__ import annotations

import re
from importlib.metadata import Distribution

from license_expression import AND, OR, ExpressionError, LicenseExpression, Licensing

ACCEPTED = frozenset(
    {
        "0BSD",
        "Apache-2.0",
        "Apache-2.0 WITH LLVM-exception",
        "BSD",
        "BSD-2-Clause",
        "BSD-3-Clause",
        "BSL-1.0",
        "CC0-1.0",
        "EPL-2.0",
        "ISC",
        "LGPL-2.1-only",
        "LGPL-2.1-or-later",
        "LGPL-3.0-only",
        "LGPL-3.0-or-later",
        "LicenseRef-Public-Domain",
        "MIT",
        "MIT-0",
        "MIT-CMU",
        "MPL-2.0",
        "PSF-2.0",
        "Zlib",
    }
)
"""Licences that a dependency may have: they leave ours as it is. ``BSD`` is one that does not say which."""

OTHER_NAMES = {
    "Apache 2.0": "Apache-2.0",
    "Apache License": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD License": "BSD",
    "BSD 2-Clause License": "BSD-2-Clause",
    "2-clause BSD": "BSD-2-Clause",
    "BSD 3-Clause License": "BSD-3-Clause",
    "ISC License (ISCL)": "ISC",
    "MIT License": "MIT",
    "Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "Python Software Foundation License": "PSF-2.0",
}
"""What metadata without an SPDX expression call licences."""

_LICENSING = Licensing()
_GPL = re.compile("GPL|General Public", re.IGNORECASE)


def licence_of(package: Distribution) -> str:
    """What a package's metadata state: an SPDX expression, or the name used there; empty if nothing."""
    told = package.metadata.json
    if expression := told.get("license_expression"):
        return str(expression)
    # Some packages have the whole text here; its first line names it, or is of no use.
    named = str(told.get("license", "")).strip().partition("\n")[0]
    own = OTHER_NAMES.get(named, named)
    if is_accepted(own) or _GPL.search(own):
        return own
    licences = [one for one in told.get("classifier", []) if one.startswith("License :: ")]
    names = {one.split(" :: ")[-1] for one in licences} - {"OSI Approved"}
    return " AND ".join(sorted({OTHER_NAMES.get(name, name) for name in names}))


def is_accepted(expression: str) -> bool:
    """Whether a licence leaves ours as it is; of alternatives, one that does is enough."""
    try:
        parsed = _LICENSING.parse(expression)
    except ExpressionError:
        return False
    return parsed is not None and _leaves_ours(parsed)


def _leaves_ours(parsed: LicenseExpression) -> bool:
    match parsed:
        case AND():
            return all(map(_leaves_ours, parsed.args))
        case OR():
            return any(map(_leaves_ours, parsed.args))
        case _:
            return str(parsed) in ACCEPTED
