"""Training of small networks, with torch. Nothing in a flight imports this."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

STEPS = 2000
RATE = 0.01
DIGITS = 9
"""Significant digits of an exported weight: what the next machine's rounding may differ in is beyond them."""


def fit(
    rows: NDArray[np.float64], wanted: NDArray[np.float64], sizes: Sequence[int], seed: int
) -> list[tuple[list[list[float]], list[float]]]:
    """Weight and bias of each layer of a network that makes ``wanted`` (n, outputs) of ``rows`` (n, inputs).

    Hidden layers bend by softsign, the last one is linear. Full batches in float64 on one thread, so that the
    same rows and seed give the same weights.
    """
    threads, kept = torch.get_num_threads(), torch.get_rng_state()
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    try:
        layers = [
            torch.nn.Linear(inputs, outputs, dtype=torch.float64) for inputs, outputs in pairwise(sizes)
        ]
        bent = [part for layer in layers[:-1] for part in (layer, torch.nn.Softsign())]
        _descend(torch.nn.Sequential(*bent, layers[-1]), torch.from_numpy(rows), torch.from_numpy(wanted))
    finally:
        torch.set_num_threads(threads)
        torch.set_rng_state(kept)
    return [(_rounded(layer.weight).tolist(), _rounded(layer.bias).tolist()) for layer in layers]


def _descend(network: torch.nn.Module, rows: torch.Tensor, wanted: torch.Tensor) -> None:
    """Adam with a rate that falls to nothing (cosine)."""
    optimiser = torch.optim.Adam(network.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
    for _ in range(STEPS):
        optimiser.zero_grad()
        loss = torch.nn.functional.mse_loss(network(rows), wanted)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()


def _rounded(tensor: torch.Tensor) -> NDArray[np.float64]:
    values = tensor.detach().numpy()
    return np.array([float(f"{value:.{DIGITS}g}") for value in values.ravel()]).reshape(values.shape)
