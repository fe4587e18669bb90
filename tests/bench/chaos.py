"""Campaigns under chaos: whatever befalls what flies them, no stored outcome is another one.

``python -m tests.bench.chaos [RUNS SEED]`` (500, 0): a campaign is flown undisturbed and then, in rounds,
by a service on SQLite and on PostgreSQL in turns, while processes of every class are killed, stopped and
slowed, the disk is full and files are gone, about one disturbance for two
runs. Prints for each class and kind how
many disturbances there were and what became of the runs that were under way. As root alone: the store is on
a small disk that it mounts.

``python -m tests.bench.chaos dask [RUNS SEED]`` (300, 0): the same by the command on a Dask cluster of four
workers, whose scheduler and workers are disturbed.
"""

import signal
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import get_args

from tests.chaos.campaign import Report, Verdict, fly_under_chaos, specification, undisturbed
from tests.chaos.deployment import StoreKind

ROUND = 42
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)


def table(reports: list[Report]) -> list[str]:
    """A line for each class and kind: disturbances, and what became of the runs under way."""
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for report in reports:
        for one in report.disturbances:
            row = counts[one.of, one.kind]
            row["disturbances"] += 1
            row.update({verdict: report.count(verdict, one.runs) for verdict in VERDICTS})
    lines = [
        "| disturbed | how | times | runs under way: equal | not flown | differing | lost |",
        "|---|---|---|---|---|---|---|",
    ]
    for (of, kind), row in sorted(counts.items()):
        told = " | ".join(str(row[name]) for name in ("disturbances", *VERDICTS))
        lines.append(f"| {of} | {kind} | {told} |")
    return lines


def told(number: int, kind: StoreKind, report: Report) -> list[str]:
    """A round in some lines."""
    counts = ", ".join(f"{report.count(one)} {one}" for one in VERDICTS)
    often = f"{len(report.disturbances)} disturbances, {report.attempts} attempts"
    return [
        f"seed {number}, {kind}: {counts}; {often}, {report.wall_s:.0f} s; left over: {len(report.left)}",
        *(f"  {line}" for line in (*report.differences, *report.left)),
        *(f"  resumed {times} times: {why}" for why, times in report.resumed.items()),
        *(f"  not flown {times} times: {why}" for why, times in report.errors.items()),
        f"  starts: {dict(report.starts)}",
    ]


def show(line: str) -> None:
    print(line, flush=True)


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    words = sys.argv[1:]
    dask = words[:1] == ["dask"]
    runs, seed = [int(word) for word in words[dask:]] or [300 if dask else 500, 0]
    reports: list[Report] = []
    with tempfile.TemporaryDirectory(prefix="zenfi-calm-") as name:
        spec = specification(min(runs, ROUND), recorded=not dask)
        calm = undisturbed(spec, Path(name))
        show(f"{len(calm)} runs undisturbed")
        try:
            while sum(len(report.verdicts) for report in reports) < runs:
                kind: StoreKind = "postgresql" if len(reports) % 2 and not dask else "sqlite"
                number = seed + len(reports)
                reports.append(fly_under_chaos(spec, calm, number, kind, dask=dask, tell=show))
                show("\n".join(told(number, kind, reports[-1])))
        finally:  # interrupted, too
            show("\n".join(table(reports)))
            total = {one: sum(report.count(one) for report in reports) for one in VERDICTS}
            show(f"{total}, left over: {sum(len(report.left) for report in reports)}")


if __name__ == "__main__":
    main()
