"""Processes that strike copies of a kernel, one a processor, fed with tasks until there are no more."""

from __future__ import annotations

import os
import selectors
import subprocess
from collections import deque
from collections.abc import Iterator, Sequence

from deploy.errors import InfrastructureError
from injector.kernel_study.study import StudyAnswer, StudyTask
from injector.reproducible import launch
from services.kernels import KERNELS
from services.system import plug_ins
from services.system.json_lines import LineReader, line_of


class StudyWorker:
    """One worker process of a kernel study, on a processor of its own."""

    def __init__(self, kernel: str, cpu: int) -> None:
        ours = os.sched_getaffinity(0)
        reference = [] if kernel in KERNELS else [plug_ins.reference("planners", kernel)]
        os.sched_setaffinity(0, {cpu})  # inherited
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                launch.command("injector.kernel_study.worker", kernel, *reference),
                env=launch.environment(os.environ, compiled=f"study-{kernel}"),
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
        self._kernel = kernel
        self._lines = LineReader(self.stdout.fileno())
        self.cpu_s = 0.0

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
        """
        lines = self._lines.read()
        if lines is None:
            raise self._ended()
        answers = [StudyAnswer.model_validate_json(line) for line in lines]
        for answer in answers:
            if answer.problem:
                message = f"{self._kernel}: {answer.problem}"
                raise InfrastructureError(message)
            self.cpu_s = self.cpu_s if answer.cpu_s is None else answer.cpu_s
        return answers

    def _ended(self) -> InfrastructureError:
        return InfrastructureError(
            f"{self._kernel}: a worker of the study ended (status {self._process.wait()})"
        )

    def end(self) -> None:
        """Kill the worker and reap it."""
        self._process.kill()
        self._process.communicate()


class StudyWorkers:
    """The workers of one study; leaving ``with`` ends everything that was started."""

    def __init__(self, kernel: str, slots: int) -> None:
        cpus = sorted(os.sched_getaffinity(0))
        self._workers: list[StudyWorker] = []
        for slot in range(slots):
            self._workers.append(StudyWorker(kernel, cpus[slot % len(cpus)]))

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
