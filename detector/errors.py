"""Errors in the input of a detector."""

from __future__ import annotations


class DetectionInputError(ValueError):
    """Bad input: one line that names the thing and the remedy."""
