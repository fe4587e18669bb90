"""``zenfi bench``: what this machine does in what time."""

from __future__ import annotations

import json
from pathlib import Path

import click
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from dashboard.terminal.options import as_json
from deploy.bench.kernel_samples import SPEC, make_samples, write
from deploy.bench.pauses import measure_injections
from deploy.bench.platform import measure, to_toml
from deploy.config.check import check
from deploy.errors import BadSpecError
from deploy.mission.fork_server import ForkServer
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec


@click.group()
def bench() -> None:
    """Measure the speed of this machine."""


@bench.command()
@click.option("--flights", type=click.IntRange(1, 1000), default=6, show_default=True, help="Per planner.")
@click.option("--output", type=Path, metavar="FILE.toml", help="Write the platform `host` into this file.")
@as_json
def kernels(flights: int, output: Path | None, as_json: bool) -> None:
    """How long each kernel takes here, from golden flights: the platform `host`."""
    if output is not None and output.suffix != ".toml":
        message = f"--output {output}: a platform's file ends in .toml"
        raise BadSpecError(message)
    server = ForkServer()
    try:
        platform = measure(server, flights)
    finally:
        server.close()
    if output is not None:
        output.write_text(to_toml(platform))
    if as_json:
        click.echo(platform.model_dump_json())
        return
    table = Table(title="thread time of a call")
    for column in ("kernel", "mean ms", "jitter"):
        table.add_column(column, justify="left" if column == "kernel" else "right")
    for kernel, latency in (platform.kernels | platform.detectors).items():
        table.add_row(kernel, f"{latency.mean_ms:.3f}", f"{latency.jitter:.2f}")
    Console().print(table)


@bench.command()
@as_json
def samples(as_json: bool) -> None:
    """Record the kernels' sample inputs anew from a golden flight, into the package."""
    server = ForkServer()
    try:
        made = make_samples(server)
    finally:
        server.close()
    for file, sample in made.items():
        before = file.read_bytes() if file.exists() else b""
        write(sample, file)
        changed = file.read_bytes() != before
        if as_json:
            click.echo(json.dumps({"file": str(file), "bytes": file.stat().st_size, "changed": changed}))
        else:
            told = "changed" if changed else "as it was"
            click.echo(f"{file}: {file.stat().st_size} bytes, {told} ({SPEC.world}, seed {SPEC.seed})")


@bench.command()
@click.option("--flights", type=click.IntRange(1, 10_000), default=12, show_default=True)
@as_json
def injector(flights: int, as_json: bool) -> None:
    """How long injections pause the stack here, how precisely they are placed, how fast stepping is."""
    check(MissionSpec(fault=FaultSpec(target="pid")))
    server = ForkServer()
    try:
        with Progress(console=Console(stderr=True)) as progress:
            task = progress.add_task("flights", total=flights)
            found = measure_injections(server, flights, lambda: progress.advance(task))
    finally:
        server.close()
    if as_json:
        click.echo(found.model_dump_json())
        return
    table = Table(title="injections")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in found.model_dump().items():
        parts = ", ".join(f"{key} {count}" for key, count in value.items()) if isinstance(value, dict) else ""
        table.add_row(name.replace("_", " "), parts or f"{value:,.6g}")
    Console().print(table)
