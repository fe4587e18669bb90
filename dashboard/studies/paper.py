"""The numbers of the paper (Hsiao et al., ROSFI) to hold campaigns against, and how ours are computed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import exp, log, sqrt
from statistics import mean, variance

from dashboard.campaigns.flight_record import FlightRecord, Result
from dashboard.campaigns.statistics.proportions import Interval, newcombe, wilson, z_of

Records = Sequence[FlightRecord]
Reckoned = Callable[[Records], float | None]
Between = Callable[[Records], Interval | None]

LEVEL = 0.95


def _unknown(_records: Records) -> None:
    """The longest of some flights has no interval that says anything of others."""


@dataclass(frozen=True, slots=True)
class PaperValue:
    """A number of the paper's and the same of a campaign; None where its flights say nothing yet.

    ``without`` is what it would be if the fault or the detector did nothing; None where there is neither.
    """

    what: str
    unit: str
    paper: float
    ours: Reckoned
    interval: Between = _unknown
    without: Reckoned = _unknown


def success(records: Records) -> float | None:
    """Missions that succeeded, in per cent."""
    flown = results(records)
    return 100 * mean(one.success for one in flown) if flown else None


def success_between(records: Records) -> Interval | None:
    """The 95 % interval of :func:`success`, in per cent."""
    flown = results(records)
    low, high = wilson(sum(one.success for one in flown), len(flown), LEVEL)
    return Interval(100 * low, 100 * high) if flown else None


def worst(records: Records) -> float | None:
    """The longest successful flight over its golden twin, in per cent."""
    over = [
        100 * (one.flight_time_s / one.twin_flight_time_s - 1)
        for one in results(records)
        if one.success and one.twin_success and one.twin_flight_time_s
    ]
    return max(over, default=None)


def results(records: Records) -> list[Result]:
    """The results of the runs that were flown."""
    return [record.result for record in records if record.result is not None]


def _of(records: Records, arm: str, world: str = "", *, injected: bool | None = None) -> Records:
    """Of an arm, in a world, with or without a fault."""
    return [
        one
        for one in records
        if one.cell.arm == arm
        and world in ("", one.cell.world)
        and (injected is None or (one.cell.fault != "golden") == injected)
    ]


def _success_of(
    what: str,
    paper: float,
    arm: str,
    world: str = "",
    *,
    injected: bool | None = None,
    beside: str | None = None,
) -> PaperValue:
    """Success of an arm; ``beside`` is the arm whose golden success it is if the fault does nothing."""

    def ours(records: Records) -> Records:
        return _of(records, arm, world, injected=injected)

    def without(records: Records) -> float | None:
        return None if beside is None else success(_of(records, beside, world, injected=False))

    return PaperValue(
        f"{what}: success",
        "%",
        paper,
        lambda records: success(ours(records)),
        lambda records: success_between(ours(records)),
        without,
    )


def _mean_over(what: str, paper: float, name: str, arm: str) -> PaperValue:
    """Mean of a quantity of an arm's successful flights over that of the golden ones, in per cent.

    The interval is that of the logarithm of a ratio of two independent means (delta method). Ours are of the
    same seeds, which makes it rather too wide.
    """

    def quantities(records: Records) -> list[list[float]]:
        return [
            [getattr(one, name) for one in results(_of(records, which)) if one.success]
            for which in (arm, "golden")
        ]

    def ours(records: Records) -> float | None:
        values, golden = quantities(records)
        return 100 * (mean(values) / mean(golden) - 1) if values and golden else None

    def interval(records: Records) -> Interval | None:
        samples = quantities(records)
        if min(map(len, samples)) < 2:
            return None
        spread = sqrt(sum(variance(one) / len(one) / mean(one) ** 2 for one in samples))
        middle = log(mean(samples[0]) / mean(samples[1]))
        low, high = (100 * (exp(middle + side * z_of(LEVEL) * spread) - 1) for side in (-1, 1))
        return Interval(low, high)

    return PaperValue(what, "%", paper, ours, interval, lambda _: 0.0)


def _worst_of(arm: str, world: str) -> Reckoned:
    return lambda records: worst(_of(records, arm, world, injected=True))


def _removed(bare: str, held: str, world: str = "") -> Reckoned:
    """By how much of the worst delay an arm's worst is smaller, in per cent."""

    def ours(records: Records) -> float | None:
        free, kept = (worst(_of(records, arm, world, injected=True)) for arm in (bare, held))
        return 100 * (1 - kept / free) if free and kept is not None else None

    return ours


def _largest_loss(records: Records) -> float | None:
    golden = success(_of(records, "golden"))
    arms = {one.cell.arm for one in records} - {"golden"}
    rates = [rate for arm in arms if (rate := success(_of(records, arm))) is not None]
    return golden - min(rates) if golden is not None and rates else None


def _largest_loss_between(records: Records) -> Interval | None:
    """The largest of all arms' losses lies between the largest ends of their intervals (Bonferroni)."""
    golden = results(_of(records, "golden"))
    flown = [results(_of(records, arm)) for arm in {one.cell.arm for one in records} - {"golden"}]
    arms = [one for one in flown if one]
    if not golden or not arms:
        return None
    level = 1 - (1 - LEVEL) / len(arms)
    losses = [newcombe((_successes(golden), _successes(one)), (len(golden), len(one)), level) for one in arms]
    return Interval(*(100 * max(ends) for ends in zip(*losses, strict=True)))


def _successes(flown: Sequence[Result]) -> int:
    return sum(one.success for one in flown)


def _table1() -> list[PaperValue]:
    return [
        _wall("a flight on one slot, mean", "s", 300.0, 1.0),
        _wall("1,000 flights on one slot", "h", 24 * 3.48, 1000 / 3600.0),
    ]


def _wall(what: str, unit: str, paper: float, factor: float) -> PaperValue:
    """``factor`` times the mean wall time of a flight, in s; those that were proven took none."""

    def ours(records: Records) -> float | None:
        flown = _flown_s(records)
        return factor * mean(flown) if flown else None

    def interval(records: Records) -> Interval | None:
        return _mean_between([factor * one for one in _flown_s(records)])

    return PaperValue(what, unit, paper, ours, interval)


def _flown_s(records: Records) -> list[float]:
    return [one.wall_s for one in results(records) if not one.proof]


def _fig7() -> list[PaperValue]:
    return [
        PaperValue("longest flight over its golden twin", "%", 57.3, worst),
        PaperValue(
            "largest loss of success", "points", 8.0, _largest_loss, _largest_loss_between, lambda _: 0.0
        ),
    ]


def _table3() -> list[PaperValue]:
    golden = {"flight_time_s": 94.6, "distance_m": 49.5, "energy_kj": 51.4}
    injected = {
        "1 bit": (105.6, 55.9, 57.2, 92.0),
        "3 bits": (107.3, 56.8, 58.7, 91.0),
        "5 bits": (111.8, 59.4, 61.1, 89.0),
    }
    words = {"flight_time_s": "time", "distance_m": "distance", "energy_kj": "energy"}
    found = [_success_of("golden", 100.0, "golden")]
    for arm, (*values, rate) in injected.items():
        found.append(_success_of(arm, rate, arm, beside="golden"))
        found += [
            _mean_over(f"{arm}: {words[name]} over golden, mean", 100 * (value / golden[name] - 1), name, arm)
            for name, value in zip(golden, values, strict=True)
        ]
    return found


def _table4() -> list[PaperValue]:
    worlds = ("factory", "farm", "sparse", "dense")
    rates = {
        "golden": (100.0, 100.0, 95.0, 85.0),
        "injected": (91.7, 97.3, 88.3, 75.3),
        "gaussian": (98.7, 99.3, 94.3, 83.0),
        "autoencoder": (99.3, 100.0, 95.0, 84.7),
    }
    delays = {
        "bare": (73.8, 74.2, 62.6, 93.3),
        "gaussian": (56.4, 63.5, 49.0, 58.7),
        "autoencoder": (64.2, 68.4, 57.8, 73.0),
    }
    found = []
    for i, world in enumerate(worlds):
        for setting, values in rates.items():
            arm = "bare" if setting in ("golden", "injected") else setting
            what = f"{world}, {setting}"
            injected = setting != "golden"
            beside = "bare" if injected else None
            found.append(_success_of(what, values[i], arm, world, injected=injected, beside=beside))
    for i, world in enumerate(worlds):
        label = f"{world}: longest flight over its golden twin (Fig. 12)"
        found.append(PaperValue(label, "%", delays["bare"][i], _worst_of("bare", world)))
        found += [
            PaperValue(
                f"{world}, {arm}: of that delay removed (Fig. 12)",
                "%",
                delays[arm][i],
                _removed("bare", arm, world),
            )
            for arm in ("gaussian", "autoencoder")
        ]
    return found + _table5(worlds)


def _table5(worlds: Sequence[str]) -> list[PaperValue]:
    parts = {
        "gaussian": (1.981, 1.871, 1.9218, 2.2223),
        "autoencoder": (0.0042, 0.0037, 0.0047, 0.0062),
    }
    return [
        _overhead(f"{world}, {arm}: detection and recomputation (Table V)", values[i], arm, world)
        for i, world in enumerate(worlds)
        for arm, values in parts.items()
    ]


def _overhead(what: str, paper: float, arm: str, world: str) -> PaperValue:
    """The mean part of virtual time that an arm's detector takes, in per cent."""

    def parts(records: Records) -> list[float]:
        flown = results(_of(records, arm, world))
        return [100 * one.overhead for one in flown if one.overhead is not None]

    def ours(records: Records) -> float | None:
        found = parts(records)
        return mean(found) if found else None

    return PaperValue(what, "%", paper, ours, lambda records: _mean_between(parts(records)), lambda _: 0.0)


def _mean_between(values: Sequence[float]) -> Interval | None:
    """The 95 % interval of a mean, by the normal law."""
    if len(values) < 2:
        return None
    half = z_of(LEVEL) * sqrt(variance(values) / len(values))
    return Interval(mean(values) - half, mean(values) + half)


def _fig14() -> list[PaperValue]:
    removed = {
        "gaussian": (16.2, 29.9, 34.7, 65.1, 76.5),
        "autoencoder": (20.1, 59.3, 73.2, 74.8, 87.1),
    }
    stages = ("perception", "planning", "control", "planning_control", "all")
    return [
        PaperValue(f"{scheme}, {stage}: delay removed", "%", value, _removed("bare", f"{scheme} {stage}"))
        for scheme, values in removed.items()
        for stage, value in zip(stages, values, strict=True)
    ]


def _fig16() -> list[PaperValue]:
    return [
        PaperValue(f"TX2, {scheme}: delay removed", "%", value, _removed("tx2", f"tx2 {scheme}"))
        for scheme, value in (("gaussian", 79.3), ("autoencoder", 88.0))
    ]


STUDIES = ("table1", "fig7", "fig8", "fig9", "table3", "table4", "fig14", "fig16")
"""The presets that are experiments of the paper, in its order."""

FINDINGS: dict[str, list[PaperValue]] = {
    "table1": _table1(),
    "fig7": _fig7(),
    "table3": _table3(),
    "table4": _table4(),
    "fig14": _fig14(),
    "fig16": _fig16(),
}
"""By the preset that flies ours; Fig. 8 and Fig. 9 are told without numbers."""
