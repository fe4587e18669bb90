"""Processes that strike copies of a kernel, or runs of a program, and are fed with tasks."""

from __future__ import annotations

import os
import selectors
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from deploy.errors import BadSpecError, InfrastructureError
from injector.kernel_study.results import StudyAnswer, StudyTask
from injector.program.spec import ProgramOrder
from injector.reproducible import launch
from services.kernels import KERNELS
from services.system import plug_ins
from services.system.json_lines import LineReader, line_of


@dataclass(frozen=True, slots=True)
class WorkerCommand:
    """How a worker of a study is started; ``first`` is the first line that it reads.

    ``name`` is that of the kernel or program that it strikes.
    """

    name: str
    command: Sequence[str]
    environment: Mapping[str, str] | None = None
    first: bytes = b""


def kernel_worker(kernel: str) -> WorkerCommand:
    """The worker that strikes a kernel."""
    reference = [] if kernel in KERNELS else [plug_ins.reference("planners", kernel)]
    return WorkerCommand(
        kernel,
        launch.command("injector.kernel_study.worker", kernel, *reference),
        launch.environment(os.environ, compiled=f"study-{kernel}"),
    )


def program_worker(order: ProgramOrder) -> WorkerCommand:
    """The worker that strikes a program."""
    command = [sys.executable, "-P", "-m", "injector.program.worker"]
    return WorkerCommand(order.program.name, command, None, line_of(order))


class StudyWorker:
    """One worker process of a study, on a processor of its own."""

    def __init__(self, what: WorkerCommand, cpu: int) -> None:
        ours = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {cpu})  # inherited
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                what.command,
                env=what.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                start_new_session=True,
            )
        finally:
            os.sched_setaffinity(0, ours)
        assert self._process.stdin is not None  # noqa: S101 - asked for above
        assert self._process.stdout is not None  # noqa: S101
        self._stdin, self.stdout = self._process.stdin, self._process.stdout
        self._name = what.name
        self._lines = LineReader(self.stdout.fileno())
        self.cpu_s = 0.0
        self._stdin.write(what.first)

    def give(self, task: StudyTask) -> None:
        """Send the worker its next task.

        :raises InfrastructureError: if it has ended.
        """
        try:
            self._stdin.write(line_of(task))
        except BrokenPipeError as error:
            raise self._ended() from error

    def hear(self) -> list[StudyAnswer]:
        """The worker's next answer; waits if there is none yet.

        :raises InfrastructureError: if it ended or has a problem.
        :raises BadSpecError: if what it is to strike cannot be struck as it is.
        """
        lines = self._lines.read()
        if lines is None:
            raise self._ended()
        answers = [StudyAnswer.model_validate_json(line) for line in lines]
        for answer in answers:
            if answer.refused:
                raise BadSpecError(answer.refused)
            if answer.problem:
                message = f"{self._name}: {answer.problem}"
                raise InfrastructureError(message)
            self.cpu_s = self.cpu_s if answer.cpu_s is None else answer.cpu_s
        return answers

    def _ended(self) -> InfrastructureError:
        return InfrastructureError(
            f"{self._name}: a worker of the study ended (status {self._process.wait()})"
        )

    def end(self) -> None:
        """Kill the worker and reap it."""
        self._process.kill()
        self._process.communicate()


class StudyWorkers:
    """The workers of one study; leaving ``with`` ends everything that was started."""

    def __init__(self, what: WorkerCommand, slots: int) -> None:
        cpus = sorted(os.sched_getaffinity(0))
        self._workers: list[StudyWorker] = []
        for slot in range(slots):
            self._workers.append(StudyWorker(what, cpus[slot % len(cpus)]))

    @property
    def cpu_s(self) -> float:
        """Processor time that they and the copies used, up to their last whole task."""
        return sum(worker.cpu_s for worker in self._workers)

    def work(self, tasks: Sequence[StudyTask]) -> Iterator[StudyAnswer]:
        """Have the workers do the tasks, in any order; all answers.

        :raises InfrastructureError: if a worker ends or has a problem.
        """
        waiting = deque(tasks)
        with selectors.DefaultSelector() as selector:
            for worker in self._workers[: len(waiting)]:
                worker.give(waiting.popleft())
                selector.register(worker.stdout, selectors.EVENT_READ, worker)
            while selector.get_map():
                for key, _ in selector.select():
                    for answer in key.data.hear():
                        yield answer
                        if answer.cpu_s is not None and waiting:
                            key.data.give(waiting.popleft())
                        elif answer.cpu_s is not None:
                            selector.unregister(key.fileobj)

    def __enter__(self) -> StudyWorkers:
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.end()
