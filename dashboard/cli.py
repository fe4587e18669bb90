"""The ``zenfi`` command and its table of commands, each loaded only when it is asked for.

With ``--json``, standard output carries one JSON object per line and nothing else; messages go to
standard error. Exit status: 0 done, 1 we failed, 2 bad input (one clear line), 130 interrupted (by Ctrl-C or
SIGTERM: what is under way is ended in order).
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from types import FrameType
from typing import NamedTuple

import click


class LazyCommand(NamedTuple):
    """The module of ``dashboard.commands`` that has it, and what the list of commands says of it."""

    module: str
    summary: str


COMMANDS = {
    "announce": LazyCommand("programs.inject", "Run a program of your own so that zenfi inject finds it."),
    "bench": LazyCommand("bench", "Measure the speed of this machine."),
    "campaign": LazyCommand("campaign", "Many flights: run, resumed, compared, exported."),
    "certificates": LazyCommand("stack", "Make certificates for machines that meet over TLS."),
    "companion": LazyCommand("stack", "Run the stages of missions whose simulator is on another host."),
    "demo": LazyCommand("campaign", "A small campaign: golden flights beside flights with faults."),
    "detect": LazyCommand("detect", "How much of the harm that faults do detectors catch in time."),
    "doctor": LazyCommand("mission", "Check what this machine allows, and fly once."),
    "down": LazyCommand("stack", "End a stack: its processes in order, then its supervisor."),
    "evidence": LazyCommand("studies.evidence", "Failures per flight hour by faults, as a file to hand in."),
    "fly": LazyCommand("mission", "Fly one mission; with --fault, its golden twin first."),
    "foxglove": LazyCommand("service", "Show this machine's flights live in Foxglove."),
    "harm": LazyCommand("harm", "Collect the faults that harmed a mission; show them."),
    "inject": LazyCommand("programs.inject", "Inject one fault into any process."),
    "kernels": LazyCommand("kernels", "Faults in kernels alone, thousands of them."),
    "logs": LazyCommand("stack", "The logs of a stack's processes."),
    "plugins": LazyCommand("mission", "What other installed packages add to zenfi."),
    "program": LazyCommand("programs.program", "Faults in any program, thousands of runs."),
    "propagation": LazyCommand("recordings", "How the error of a recorded flight passed on, by topic."),
    "ps": LazyCommand("stack", "What the processes of a stack are doing."),
    "publish": LazyCommand("studies.publish", "A campaign as a static site: findings, harmful flights."),
    "redundancy": LazyCommand("redundancy", "Velocity and flight time with one, two, three computers."),
    "replay": LazyCommand("replay", "Fly injected flights again and compare."),
    "restart": LazyCommand("stack", "Stop processes of a stack and start them again."),
    "ros2": LazyCommand("ros2", "ROS 2 over Zenoh (rmw_zenoh)."),
    "serve": LazyCommand("service", "Serve dashboard and REST API, and fly what is asked for."),
    "stop": LazyCommand("stack", "Stop processes of a stack."),
    "store": LazyCommand("campaign", "The place where campaigns are: backup, restore, check."),
    "study": LazyCommand(
        "studies.study", "Experiments of the paper and of ours: flown, judged, written as pages."
    ),
    "token": LazyCommand("service", "The token that requests to the service must bear."),
    "train": LazyCommand("train", "Train and evaluate anomaly detectors."),
    "up": LazyCommand("stack", "Start a stack's processes and supervise them."),
    "view": LazyCommand("recordings", "Show a recorded flight."),
    "world": LazyCommand("world", "Worlds: what there is, what they look like, as files."),
}
"""All commands by name; the function in the module has the same name."""


class LazyGroup(click.Group):
    """A group that loads a command when it is asked for: some import for a second what others do without."""

    def list_commands(self, _: click.Context) -> list[str]:
        """The names of all commands in order."""
        return sorted(COMMANDS)

    def get_command(self, _: click.Context, name: str) -> click.Command | None:
        """Load a command, None if there is none of that name."""
        if name not in COMMANDS:
            return None
        found = getattr(import_module(f"dashboard.commands.{COMMANDS[name].module}"), name)
        assert isinstance(found, click.Command)  # noqa: S101 - the table is ours
        return found

    def format_commands(self, _: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands from the table, loading none."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, one.summary) for name, one in sorted(COMMANDS.items())])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="zenfi")
def zenfi() -> None:
    """Fault injection for autonomous machines: what does one flipped bit do to the mission?"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the ``zenfi`` command, with what was typed or with ``arguments``."""
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        zenfi.main(arguments, standalone_mode=False)
    except click.ClickException as error:
        _give_up(error.format_message(), 2)
    except (KeyboardInterrupt, click.Abort):
        _give_up("interrupted", 130)
    except Exception as error:
        # Loaded by now if it is one of them.
        status, text = import_module("dashboard.terminal.errors").told(error)
        if status is None:
            raise
        _give_up(text, status)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _give_up(text: str, status: int) -> None:
    click.echo(f"zenfi: {text}", err=True)
    sys.exit(status)
