"""What is wrong with what a detector was given."""

from __future__ import annotations


class DetectionInputError(ValueError):
    """Bad input: one line that names the thing and the remedy."""
