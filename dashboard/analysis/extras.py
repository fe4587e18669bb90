"""Packages that only some of this needs: loaded when they are used; if they lack, their extra is named."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from deploy.errors import BadSpecError


def installed(module: str, extra: str) -> Any:
    """Load a module that ``zenfi[extra]`` brings.

    :raises BadSpecError: if it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        message = f"{module.partition('.')[0]} is not installed: pip install 'zenfi[{extra}]'"
        raise BadSpecError(message) from error
