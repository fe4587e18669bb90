"""``zenfi program``: what faults do to runs of any program, from its command line."""

from __future__ import annotations

import json
import os
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path

import click
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from dashboard.analysis.kernel_study import PROGRAM_RESULTS, WAYS, OutcomeShare, short_lines
from dashboard.terminal.options import as_json
from deploy.config.written_faults import fault_fields
from deploy.errors import BadSpecError
from deploy.kernel_study.program_study import changed_study
from injector.kernel_study.results import StudyRun
from zenfi import programs
from zenfi.programs import LIMIT_S, ProgramStudy, ProgramStudySpec

_GROUPS = 12
_CAUSES = 8
_BESIDE_A_FILE = ("file", "runs", "fault", "seed", "limit_s", "slots", "output", "ways", "as_json")
"""Options that go with --spec: all others describe the program."""


@click.group()
def program() -> None:
    """Faults in runs of any program, thousands of them."""


def _environment(given: tuple[str, ...]) -> dict[str, str]:
    found = {}
    for one in given:
        name, equals, value = one.partition("=")
        if not equals and name not in os.environ:
            message = f"--env {name}: there is no such variable; NAME=VALUE sets one"
            raise BadSpecError(message)
        found[name] = value if equals else os.environ[name]
    return found


def _place(address: str, module: str) -> tuple[str, int | None]:
    if not address:
        return module, None
    name, _, offset = address.rpartition("+")
    try:
        return name or module, int(offset, 0)
    except ValueError as error:
        message = f"--address {address}: expected MODULE+0x10, an offset as objdump shows it"
        raise BadSpecError(message) from error


slots = click.option("--slots", type=click.IntRange(1, 256), help="At a time (default: one per processor).")
limit = click.option(
    "--limit-s",
    type=click.FloatRange(0.1, 86400),
    default=LIMIT_S,
    show_default=True,
    help="Longest wall time of a run without a fault.",
)


def _from_file(file: Path) -> ProgramStudySpec:
    """The study in a file, with the numbers and the fault that were given beside it."""
    context = click.get_current_context()
    given = {
        one.name: context.params[one.name]
        for one in context.command.params
        if one.name and context.get_parameter_source(one.name) == click.core.ParameterSource.COMMANDLINE
    }
    for one in context.command.params:
        if one.name in given and one.name not in _BESIDE_A_FILE:
            what = one.opts[0] if isinstance(one, click.Option) else "COMMAND"
            message = f"{what}: with --spec it is in the file: leave it out, or write it into {file}"
            raise BadSpecError(message)
    spec = programs.load(file)
    changed = {name: given[name] for name in ("runs", "seed", "limit_s") if name in given}
    fault = fault_fields(given["fault"]) if "fault" in given else None
    return changed_study(spec, fault, **changed)


@program.command(context_settings={"ignore_unknown_options": True})
@click.option(
    "--spec",
    "file",
    metavar="FILE.toml",
    type=click.Path(path_type=Path),
    help="The study, in place of COMMAND and the options that describe it.",
)
@click.option("--runs", type=click.IntRange(1, 10_000_000), default=1000, show_default=True)
@click.option("--fault", default="", metavar="NAME=VALUE[,...]", help="What is flipped, e.g. bits=2.")
@click.option("--seed", type=click.IntRange(0, 2**32 - 1), default=0, show_default=True)
@slots
@click.option(
    "--output", type=click.Path(dir_okay=False, path_type=Path), help="Kept here, and gone on with."
)
@click.option("--module", default="", metavar="FILE", help="Strike code of this executable or library only.")
@click.option("--symbol", default="", metavar="NAME", help="Strike the code of this function only.")
@click.option("--address", default="", metavar="MODULE+0x10", help="Strike this instruction only.")
@click.option("--line", default="", metavar="FILE:LINE", help="Strike the code of this source line only.")
@click.option("--stdin", default=os.devnull, metavar="FILE", help="What the program reads.")
@click.option("--input", "inputs", multiple=True, metavar="FILE", help="Copied into each run's own folder.")
@click.option(
    "--compare", multiple=True, metavar="FILE", help="Written by the program into its folder: output."
)
@click.option("--ignore", multiple=True, metavar="stdout|stderr", help="Not compared.")
@click.option(
    "--detected", multiple=True, type=click.IntRange(0, 255), help="By this exit status it says so."
)
@click.option("--tolerance", type=click.FloatRange(0), help="Relative, of numbers in the output.")
@click.option(
    "--comparator", default="", metavar="COMMAND", help="Compares: COMMAND GOLDEN_FOLDER RUN_FOLDER."
)
@click.option("--status", type=click.IntRange(0, 255), default=0, help="Exit status without a fault.")
@click.option("--env", "environment", multiple=True, metavar="NAME[=VALUE]", help="Passed to the program.")
@limit
@click.option(
    "--by", "ways", multiple=True, type=click.Choice(list(WAYS)), help="Tables by what was corrupted."
)
@as_json
@click.argument("command", nargs=-1, type=click.UNPROCESSED)
def run(
    *,
    file: Path | None,
    runs: int,
    fault: str,
    seed: int,
    slots: int | None,
    output: Path | None,
    module: str,
    symbol: str,
    address: str,
    line: str,
    stdin: str,
    inputs: tuple[str, ...],
    compare: tuple[str, ...],
    ignore: tuple[str, ...],
    tolerance: float | None,
    comparator: str,
    status: int,
    detected: tuple[int, ...],
    environment: tuple[str, ...],
    limit_s: float,
    ways: tuple[str, ...],
    as_json: bool,
    command: tuple[str, ...],
) -> None:
    """Run a program many times, each time with one fault: zenfi program run -- COMMAND ARGS.

    With --spec FILE.toml the program and the study are in a file; --runs, --fault, --seed and --limit-s take
    the place of those in it.

    It runs without a fault first, and once with its instructions counted. Each fault strikes one dynamic
    instruction of the whole run, libraries included; every one that the fault can strike is equally likely.
    Standard output, standard error, exit status and the files of --compare are compared with those of the run
    without a fault.

    Exit status 0 if all runs were made, 2 if the program cannot be struck.
    """
    if file is not None:
        made = programs.make(_from_file(file), slots=slots, output=output)
        _tell(made, ways, as_json=as_json)
        return
    if not command:
        raise BadSpecError("a COMMAND is needed (zenfi program run -- COMMAND ARGS), or --spec FILE.toml")
    where, offset = _place(address, module)
    spec = programs.program(
        command,
        environment=_environment(environment),
        stdin=stdin,
        inputs=inputs,
        compare=compare,
        ignore=ignore,
        tolerance=tolerance,
        comparator=shlex.split(comparator),
        status=status,
        detected=detected,
        module=where,
        symbol=symbol,
        address=offset,
        line=line,
    )
    study = programs.run(
        spec, runs, seed=seed, slots=slots, fault=fault, output=output, limit_s=limit_s, progress=True
    )
    _tell(study, ways, as_json=as_json)


def _tell(study: ProgramStudy, ways: tuple[str, ...], *, as_json: bool) -> None:
    if as_json:
        for one in study.runs:
            click.echo(one.model_dump_json(by_alias=True))
        click.echo(json.dumps({"summary": study.summary.model_dump()}))
        return
    for table in _tables(study, ways):
        Console().print(table)


@program.command()
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--run", "indices", multiple=True, type=click.IntRange(0), metavar="N", help="This run only.")
@slots
@limit
@as_json
def replay(file: Path, *, indices: tuple[int, ...], slots: int | None, limit_s: float, as_json: bool) -> None:
    """Make the runs of a file again: same instruction, same values, same outcome?

    Exit status 0 if all are the same, 1 if one is not.
    """
    made = programs.replay(file, indices, slots=slots, limit_s=limit_s)
    for one in made:
        if as_json:
            told = {"index": one.was.index, "same": one.same, "now": one.now.model_dump(by_alias=True)}
            click.echo(json.dumps(told))
        elif not one.same:
            click.echo(f"run {one.was.index}: {_outcome(one.was)}, now {_outcome(one.now)}")
    same = sum(one.same for one in made)
    click.echo(f"replayed: {same} of {len(made)} the same", err=as_json)
    sys.exit(0 if same == len(made) else 1)


def _outcome(run: StudyRun) -> str:
    record = run.injection
    told = (
        run.result,
        run.cause and f"({run.cause})",
        record.instruction,
        record.line and f"at {record.line}",
    )
    return " ".join(filter(None, told))


def _tables(study: ProgramStudy, ways: tuple[str, ...]) -> Iterator[Table]:
    summary = study.summary
    title = f"{study.program.name}: faults in {summary.attempted} runs; % of the hit ones, 95 % Wilson"
    table = Table(title=title, box=SIMPLE)
    for column in ("outcome", "runs", "%", "95 %"):
        table.add_column(column, justify="left" if column == "outcome" else "right")
    for name, share in summary.shares.items():
        table.add_row(name, str(share.count), *_share(share, summary.injected))
        if name == "benign" and study.program.tolerance is not None:
            table.add_row("  within tolerance", str(summary.tolerable_sdc), "", "")
    missed = sum(summary.not_injected.values())
    table.add_row("not injected", str(missed), "", "")
    yield table
    yield _circumstances(study)
    for way in ways:
        found = Table(title=f"by {way}", box=SIMPLE)
        found.add_column(way, overflow="fold")
        for column in ("hit", *PROGRAM_RESULTS):
            found.add_column(column, justify="right")
        groups = study.by(way)[:_GROUPS]
        names = [name for name, _, _ in groups]
        for name, (_, count, shares) in zip(
            short_lines(names) if way == "line" else names, groups, strict=True
        ):
            found.add_row(name, str(count), *(" ".join(_share(one, count)) for one in shares.values()))
        yield found


def _circumstances(study: ProgramStudy) -> Table:
    summary, length = study.summary, study.summary.length
    table = Table(box=SIMPLE, show_header=False)
    table.add_row("instructions of a run", f"{length.all:,}")
    table.add_row("in the code asked for", f"{length.scope:,}")
    table.add_row("that the fault can strike", f"{length.eligible:,}")
    table.add_row("runs a second", f"{summary.per_second:.1f}")
    causes: dict[str, int] = {}
    for one in study.runs:
        if one.cause:
            cause = f"{one.result}: {one.cause}"
            causes[cause] = causes.get(cause, 0) + 1
    for cause, count in sorted(causes.items(), key=lambda pair: -pair[1])[:_CAUSES]:
        table.add_row(cause, str(count))
    return table


def _share(one: OutcomeShare, of: int) -> tuple[str, str]:
    return f"{100 * one.count / max(of, 1):.1f}", f"{100 * one.low:.1f}-{100 * one.high:.1f}"
