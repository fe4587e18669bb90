"""Whether the estimate of a rare event is covered by its interval, and what it saves beside uniform draws.

`python -m tests.bench.rare [--file STUDY.jsonl --kernel NAME --result RESULT --by WAY,WAY]`.

Without a file, populations are made up: 48 strata (8 bit fields x 6 phases), an event of 1 %, most of it in
one of them. With a file that `zenfi kernels run --output` wrote, the population is its strikes, each drawn
alike with replacement, and `--by` says into which strata they are divided. Each line tells of how many draws
an estimate has, in how many of 200 and of 1,000 repetitions its 95 % interval covered the population's
rate, and variance x cost of uniform draws over ours; `limit` is what strata with these rates allow at most
(Neyman's allocation, with all rates known).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dashboard.analysis.kernel_study import WAYS
from dashboard.campaigns.statistics.harm_rates import Counts, Floats
from dashboard.campaigns.statistics.rare import RareEstimate, estimate_rare
from deploy.kernel_study.file import kept_runs
from injector.kernel_study.results import StudyRun
from services.runtime import rng

BITS, PHASES = 8, 6
RATE = 0.01

SYNTHETIC = {
    "all in a stratum, at 50 %": (0.5, 0.0),
    "all in a stratum, at 80 %": (0.8, 0.0),
    "all in a stratum, at 20 %": (0.2, 0.0),
    "1 % elsewhere, the rest at 50 %": (0.5, 0.01),
    "1 % elsewhere, the rest at 80 %": (0.8, 0.01),
    "10 % elsewhere, the rest at 50 %": (0.5, 0.1),
    "the same rate everywhere": (RATE, 1.0 - 1.0 / (BITS * PHASES)),
}
"""The rate in the stratum that has most events, and the part of events that are elsewhere."""


class Population(NamedTuple):
    """Strata: their names, weights (n,) and rates of the event (n,)."""

    names: Sequence[tuple[str, ...]]
    weights: Floats
    rates: Floats

    @property
    def rate(self) -> float:
        """The event's rate in all of it."""
        return float(self.weights @ self.rates)

    @property
    def limit(self) -> float:
        """Variance of uniform draws over that of Neyman's allocation with all rates known."""
        errors = float(self.weights @ np.sqrt(self.rates * (1.0 - self.rates)))
        return self.rate * (1.0 - self.rate) / errors**2 if errors else float("inf")


class Repeated(NamedTuple):
    """Of many estimates: the part that covers, mean error over the rate, gain, mean width over the rate."""

    coverage: float
    bias: float
    gain: float
    width: float
    n_eff: float


def synthetic(hot_rate: float, elsewhere: float, seed: int = 0) -> Population:
    """Bit fields x phases of drawn weights, one with most events; these are 1 % of all."""
    names = [(f"bits {bit}", f"phase {phase}") for bit in range(BITS) for phase in range(PHASES)]
    hot = BITS * PHASES - PHASES - 1
    weights = rng.generator(seed, "rare population").dirichlet(np.full(len(names), 8.0))
    weights[hot] = 0.0
    weights *= (1.0 - RATE * (1.0 - elsewhere) / hot_rate) / weights.sum()
    weights[hot] = RATE * (1.0 - elsewhere) / hot_rate
    rates = np.full(len(names), RATE * elsewhere / (1.0 - weights[hot]))
    rates[hot] = hot_rate
    return Population(names, weights, rates)


def of_runs(runs: Sequence[StudyRun], result: str, ways: Sequence[str]) -> Population:
    """Strikes of a kernel study, divided by what was struck; those that were not injected are left out."""
    made = [run for run in runs if run.result != "not_injected"]
    names = [tuple(WAYS[way](run.injection) for way in ways) for run in made]
    strata = sorted(set(names))
    place = {name: index for index, name in enumerate(strata)}
    of = np.array([place[name] for name in names])
    count = np.bincount(of, minlength=len(strata))
    events = np.bincount(of, [run.result == result for run in made], minlength=len(strata))
    return Population(strata, count / count.sum(), events / count)


def estimated(population: Population, draws: int, seed: int) -> RareEstimate:
    """One estimate from draws of the population with replacement."""
    outcomes = rng.generator(seed, "rare outcomes")

    def strike(counts: Counts) -> Counts:
        return outcomes.binomial(counts, population.rates)

    return estimate_rare(population.names, list(population.weights), strike, draws, seed)


def repeated(population: Population, draws: int, seeds: Sequence[int]) -> Repeated:
    """Repeat the estimate with each of the seeds."""
    made = [estimated(population, draws, seed) for seed in seeds]
    rate = population.rate
    errors = np.array([one.p for one in made]) - rate
    uniform = rate * (1.0 - rate) / draws
    return Repeated(
        coverage=float(np.mean([one.interval.low <= rate <= one.interval.high for one in made])),
        bias=float(errors.mean() / rate),
        gain=float(uniform / np.mean(errors**2)),
        width=float(np.mean([one.interval.width for one in made]) / rate),
        n_eff=float(np.median([one.n_eff for one in made])),
    )


def populations(asked: argparse.Namespace) -> Iterator[tuple[str, Population]]:
    """Those to measure, by name."""
    if asked.file is None:
        yield from ((name, synthetic(*shape)) for name, shape in SYNTHETIC.items())
        return
    for ways in asked.by:
        runs = kept_runs(asked.file)[asked.kernel]
        yield f"{asked.kernel}: {asked.result} by {ways}", of_runs(runs, asked.result, ways.split(","))


def main() -> None:
    """Print a line for each population and number of draws."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--file", type=Path)
    parser.add_argument("--kernel", default="pid")
    parser.add_argument("--result", default="hang")
    parser.add_argument("--by", nargs="+", default=["register,bit"])
    parser.add_argument("--draws", nargs="+", type=int, default=[4000, 10000])
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--repetitions", type=int, default=1000)
    asked = parser.parse_args()
    for name, population in populations(asked):
        strata = len(population.names)
        print(f"{name}: p {population.rate:.4f}, {strata} strata, limit {population.limit:.1f}", flush=True)
        for draws in asked.draws:
            for count in sorted({min(200, asked.repetitions), asked.repetitions}):
                found = repeated(population, draws, range(asked.first_seed, asked.first_seed + count))
                print(
                    f"  {draws:6} draws, {count:5} times: covered {found.coverage:.3f}, "
                    f"gain {found.gain:5.1f}, mean error {100 * found.bias:+.1f} %, "
                    f"width {100 * found.width:.0f} %, n_eff {found.n_eff:,.0f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
