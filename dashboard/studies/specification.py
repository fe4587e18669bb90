"""Studies that need no campaign, asked for by name or by the file that a page of theirs keeps."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from dashboard.studies.kernels_alone import KernelsAlone
from dashboard.studies.redundant_computers import RedundantComputers
from deploy.errors import BadSpecError

Computed = KernelsAlone | RedundantComputers
"""What is asked of a study that flies nothing."""

MODELS: dict[str, type[KernelsAlone] | type[RedundantComputers]] = {
    KernelsAlone().name: KernelsAlone,
    RedundantComputers().name: RedundantComputers,
}
"""By the name of the study."""


def load(name: str) -> Computed | None:
    """The study that is named, or that a page's specification asks for; None if it flies, or is none.

    :raises BadSpecError: if a file asks for such a study, and for something that it has not.
    """
    if name in MODELS:
        return MODELS[name]()
    path = Path(name)
    if path.suffix != ".json" or not path.is_file():
        return None
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    if not isinstance(found, dict) or str(found.get("name")) not in MODELS:
        return None
    try:
        return MODELS[found["name"]].model_validate_json(path.read_text())
    except ValidationError as error:
        first = error.errors()[0]
        message = f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise BadSpecError(message) from error
