"""Errors of the infrastructure: they are raised, and never become part of an outcome."""


class InfrastructureError(Exception):
    """A process, file or connection of ours has failed. The run may be flown again."""


class DisturbedFlightError(InfrastructureError):
    """A process of a flight was ended from outside: the flight has no outcome and is to be flown again."""
