"""``zenfi up`` and its kin: the processes of a laboratory under a supervisor."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import click
from rich.console import Console

from dashboard.analysis.extras import installed
from dashboard.terminal import stack_tables
from dashboard.terminal.options import as_json
from deploy.compose import control
from deploy.compose.bus import all_stacks, own_address
from deploy.compose.control import ControlRequest, NotUpError, StackView, ask, stacks_up, wait
from deploy.compose.daemon import start
from deploy.compose.folder import TakenError, held, log_file, logs_folder, stack_folder
from deploy.compose.logs import LogFollower, tail
from deploy.compose.reading import read_stack
from deploy.compose.stack_file import SUPERVISOR, Stack
from deploy.compose.state_machine import MOVING
from deploy.compose.system.process_tree import clear_marked
from deploy.errors import BadSpecError, InfrastructureError

_FOLLOW_PAUSE_S = 0.1
_messages = Console(stderr=True, highlight=False)
in_stack = click.option("--stack", "stack", metavar="NAME", help="Which stack; needed if several are up.")


@click.command()
@click.option(
    "--file",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="STACK.toml",
    help="What to start [default: what a laboratory needs].",
)
@click.option("--foxglove", is_flag=True, help="Also show flights live in Foxglove: zenfi foxglove.")
@click.option(
    "--tls",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="FOLDER",
    help="Certificates of this machine, made by zenfi certificates; in place of the file's.",
)
@click.option("-d", "--detach", is_flag=True, help="Leave it running; wait until it is ready.")
@as_json
def up(file: Path | None, foxglove: bool, tls: Path | None, detach: bool, as_json: bool) -> None:
    """Start a stack's processes and supervise them; again, after a change of the file, apply the change."""
    stack = read_stack(file, foxglove=foxglove, tls=tls)
    folder = stack_folder(stack.name)
    try:
        ask(folder, ControlRequest(do="declare", stack=stack))
    except NotUpError:
        if not detach:
            _attend(stack)
            return
        start(stack, attached=False)
    _tell(wait(folder, lambda view: not view.moving), as_json)


def _attend(stack: Stack) -> None:
    """Supervise as long as this command lives, showing the logs; Ctrl-C goes down, twice at once."""
    logs = {name: log_file(logs_folder(stack), name) for name in (SUPERVISOR, *stack.processes)}
    asked = 0
    with _following(logs) as following:
        supervisor = start(stack, attached=True).process
        while True:
            try:
                ended = supervisor.poll() is not None
                _show(following)
                if ended:
                    break
                time.sleep(_FOLLOW_PAUSE_S)
            except KeyboardInterrupt:
                asked += 1
                _messages.print("going down; Ctrl-C again kills what is left" if asked == 1 else "killing")
                with contextlib.suppress(NotUpError):
                    ask(stack_folder(stack.name), ControlRequest(do="down"))
    if asked:
        raise KeyboardInterrupt
    if supervisor.returncode:
        message = f"the supervisor has ended with status {supervisor.returncode}: see {logs[SUPERVISOR]}"
        raise InfrastructureError(message)


@contextlib.contextmanager
def _following(logs: Mapping[str, Path]) -> Iterator[dict[str, LogFollower]]:
    with contextlib.ExitStack() as files:
        yield {
            name: files.enter_context(contextlib.closing(LogFollower(path))) for name, path in logs.items()
        }


def _show(following: dict[str, LogFollower]) -> None:
    width = max(map(len, following), default=0)
    for name, one in following.items():
        for line in one.lines():
            click.echo(f"{name:{width}} | {line}" if len(following) > 1 else line)


@click.command()
@in_stack
@click.option("--all", "everywhere", is_flag=True, help="Also stacks of other machines, found on Zenoh.")
@as_json
def ps(stack: str | None, everywhere: bool, as_json: bool) -> None:
    """What the processes of a stack are doing."""
    view = _the(stack)
    views = all_stacks(view.folder) if everywhere else [view]
    for one in views:
        if as_json:
            click.echo(one.model_dump_json())
        else:
            Console().print(stack_tables.stack(one, with_host=everywhere))


@click.command()
@click.argument("names", nargs=-1)
@in_stack
@click.option("-f", "--follow", is_flag=True, help="Go on as lines come.")
@click.option("-n", "--lines", type=click.IntRange(0, 1_000_000), default=100, show_default=True)
def logs(names: tuple[str, ...], stack: str | None, follow: bool, lines: int) -> None:
    """The logs of a stack's processes (default: all); "supervisor" is the supervisor's own."""
    view = _the(stack)
    there = {**{one.name: one.log for one in view.processes}, SUPERVISOR: view.log}
    for name in names:
        if name not in there:
            message = f"no process {name!r} in stack {view.name}; there are: {', '.join(there)}"
            raise BadSpecError(message)
    chosen = {name: there[name] for name in names or [one.name for one in view.processes]}
    width = max(map(len, chosen))
    with _following(chosen) as following:
        for name, line in tail(chosen, lines):
            click.echo(f"{name:{width}} | {line}" if len(chosen) > 1 else line)
        while follow:
            _show(following)
            time.sleep(_FOLLOW_PAUSE_S)


@click.command()
@click.argument("names", nargs=-1, required=True)
@in_stack
@as_json
def restart(names: tuple[str, ...], stack: str | None, as_json: bool) -> None:
    """Stop processes and start them again; also those that were stopped or have failed."""
    _order(stack, ControlRequest(do="restart", names=names), as_json)


@click.command()
@click.argument("names", nargs=-1, required=True)
@in_stack
@as_json
def stop(names: tuple[str, ...], stack: str | None, as_json: bool) -> None:
    """Stop processes; ``zenfi restart`` starts them again."""
    _order(stack, ControlRequest(do="stop", names=names), as_json)


def _order(stack: str | None, request: ControlRequest, as_json: bool) -> None:
    def carried_out(view: StackView) -> bool:
        named = [one for one in view.processes if one.name in request.names]
        return not any(one.phase in MOVING for one in named)

    folder = _the(stack).folder
    ask(folder, request)
    _tell(wait(folder, carried_out), as_json, request.names)


@click.command()
@in_stack
def down(stack: str | None) -> None:
    """End a stack: its processes in order, then its supervisor. Also clears what a killed one has left."""
    folder = _folder(stack)
    try:
        control.down(folder)
    except NotUpError:
        _clear(folder)


def _clear(folder: Path) -> None:
    if not folder.exists():
        message = f"stack {folder.name} is not up"
        raise BadSpecError(message)
    try:
        with held(folder):
            killed, refused = clear_marked(folder)
    except TakenError as error:
        raise InfrastructureError(f"{error}, but does not answer: kill its supervisor") from error
    _messages.print(f"stack {folder.name} was not up; {killed} processes that were left are gone")
    if refused:
        message = f"{refused} processes of other users are left: end them as root"
        raise InfrastructureError(message)


@click.command()
@click.argument("folder", type=click.Path(file_okay=False, path_type=Path))
@click.argument("hosts", nargs=-1, metavar="NAME[=ADDRESS,..]...")
@click.option(
    "--viewer", "viewers", multiple=True, metavar="NAME", help="One that sees stacks; may be repeated."
)
@click.option("--days", type=click.IntRange(1, 3650), default=730, show_default=True, help="Valid so long.")
def certificates(folder: Path, hosts: tuple[str, ...], viewers: tuple[str, ...], days: int) -> None:
    """Make certificates for machines that meet over TLS: FOLDER/NAME for each, to be copied there.

    The authority in FOLDER is made the first time; its key stays there. Nothing is overwritten.
    """
    installed("cryptography", "tls")
    from deploy.config.certificates import Machine, write_certificates  # noqa: PLC0415 - needs that package

    machines = [Machine.parse(one, "host") for one in hosts] + [
        Machine.parse(one, "viewer") for one in viewers
    ]
    if not machines:
        raise BadSpecError("for whom? zenfi certificates FOLDER NAME[=ADDRESS,..]... [--viewer NAME]")
    for one in write_certificates(folder, machines, days):
        click.echo(one)


@click.command()
def companion() -> None:
    """Run the stages of missions whose simulator is on another host: a process of a stack file."""
    address = own_address()
    if address is None:
        raise BadSpecError(
            "zenfi companion is the command of a process in a stack file: see docs/two_hosts.md"
        )
    from deploy.workers.companion import serve  # noqa: PLC0415 - loads all that flies

    serve(address)


def _the_only() -> Path:
    """The folder of the only stack that is up, or of the one that comes along."""
    there = stacks_up()
    if len(there) > 1:
        message = f"--stack: several are up: {', '.join(view.name for view in there)}"
        raise BadSpecError(message)
    return there[0].folder if there else stack_folder(read_stack(None).name)


def _the(stack: str | None) -> StackView:
    """The stack of that name, or the only one that is up."""
    return ask(_folder(stack), ControlRequest(do="tell"))


def _folder(stack: str | None) -> Path:
    return stack_folder(stack) if stack else _the_only()


def _tell(view: StackView, as_json: bool, names: Collection[str] = ()) -> None:
    """Print the state; status 1 if a process (of ``names``) that should run does not."""
    if as_json:
        click.echo(view.model_dump_json())
    else:
        Console().print(stack_tables.stack(view))
    for one in view.amiss:
        if not names or one.name in names:
            message = f"{one.name} is {one.phase}: {one.reason}; see zenfi logs {one.name}"
            raise InfrastructureError(message)
