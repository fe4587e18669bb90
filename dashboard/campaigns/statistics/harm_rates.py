"""What is expected of strata after some draws: their rates of a rare event, and groups of like ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Counts = NDArray[np.int64]

PENALTY = 0.5
"""Of a name's squared effect on the log odds: a name that was seldom drawn has little."""

OWN_DRAWS = 1.0
"""So many draws of a stratum itself count as much as what is expected by its names."""

MOST_STRATA = 2000
"""Grouping them takes memory of their number squared."""

_STEPS = 25
_FURTHEST = 12.0
"""Log odds beyond which a rate is as good as 0 or 1."""


def expected_rates(names: Sequence[Sequence[str]], drawn: Counts, events: Counts) -> Floats:
    """The expected rate of an event in each stratum (n,), above 0 and below 1, from all draws so far.

    ``names`` (n strata of k names each) say what a stratum is in each respect, e.g. bits and phase. A
    logistic regression on them, with a ridge penalty, tells what strata that were hardly drawn have in common
    with others; a stratum's own draws (``drawn`` (n,), of which ``events`` (n,)) outweigh it soon.
    """
    by_names = _fitted(_indicators(names), drawn.astype(float), events.astype(float))
    return (events + OWN_DRAWS * by_names) / (drawn + OWN_DRAWS)


def _indicators(names: Sequence[Sequence[str]]) -> Floats:
    """A column of ones, and one for each name in each respect (n, 1 + names)."""
    columns = [np.ones(len(names))]
    for respect in zip(*names, strict=True):
        columns += [np.array([one == name for one in respect], float) for name in sorted(set(respect))]
    return np.stack(columns, axis=1)


def _fitted(columns: Floats, drawn: Floats, events: Floats) -> Floats:
    """The rates by penalised logistic regression (Newton's method); without names the overall rate."""
    overall = (events.sum() + 0.5) / (drawn.sum() + 1.0)
    effects = np.zeros(columns.shape[1])
    effects[0] = np.log(overall / (1.0 - overall))
    penalty = np.full(len(effects), PENALTY)
    penalty[0] = 1e-6  # the overall rate is free
    for _ in range(_STEPS):
        rates = _rates(columns @ effects)
        slope = columns.T @ (events - drawn * rates) - penalty * effects
        curvature = (columns.T * (drawn * rates * (1.0 - rates))) @ columns + np.diag(penalty)
        step = np.linalg.solve(curvature, slope)
        longest = float(np.abs(step).max())
        effects += step * min(1.0, 3.0 / max(longest, 3.0))
        if longest < 1e-4:
            break
    return _rates(columns @ effects)


def _rates(log_odds: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -_FURTHEST, _FURTHEST))))


def grouped(weights: Floats, rates: Floats, most: int) -> NDArray[np.int64]:
    """The group (n,) of each stratum, 0 to ``most`` - 1; those with like expected ``rates`` are together.

    Of all ways to cut the strata in the order of their rates it is the one with the least sum of W sigma over
    groups, which is the standard error under Neyman's allocation (Cochran 1977, Sampling Techniques, 5A.7).

    :raises ValueError: if there are more than :data:`MOST_STRATA`.
    """
    if len(weights) > MOST_STRATA:
        message = f"{len(weights)} strata, at most {MOST_STRATA} can be grouped: name fewer respects"
        raise ValueError(message)
    order = np.argsort(-rates, kind="stable")
    weight, expected = (np.concatenate([[0.0], np.cumsum(one[order])]) for one in (weights, weights * rates))
    of_group = np.maximum(weight[None, :] - weight[:, None], 0.0)
    events = np.clip(expected[None, :] - expected[:, None], 0.0, of_group)
    error = np.sqrt(events * (of_group - events))  # W sqrt(p (1 - p)) of strata begin..end
    error[np.tril_indices(len(error), -1)] = np.inf
    best, begins = error[0], []
    for _ in range(most - 1):
        together = best[:, None] + error
        begins.append(together.argmin(axis=0))
        best = together.min(axis=0)
    groups, end = np.zeros(len(weights), np.int64), len(weights)
    for group in range(most - 1, 0, -1):
        begin = int(begins[group - 1][end])
        groups[order[begin:end]] = group
        end = begin
    return groups
