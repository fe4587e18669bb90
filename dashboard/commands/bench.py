"""``zenfi bench``: what this machine does in what time."""

from __future__ import annotations

import json
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from dashboard.commands.options import as_json
from deploy.check import BadSpecError
from deploy.forkserver import ForkServer
from deploy.measure import measure, to_toml
from deploy.samples import SPEC, make_samples, write


@click.group()
def bench() -> None:
    """Measure this machine."""


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
    for kernel, latency in platform.kernels.items():
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
