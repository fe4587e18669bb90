"""``zenfi inject`` as people meet it: what it prints, and what it refuses."""

import json
import os
import re
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from injector.attach import permission
from injector.attach.injection import inject_into
from injector.attach.permission import admit, name_of, not_permitted
from injector.tracing.process import Process, threads, tracer_of
from injector.tracing.tracees import TraceeGroup
from tests.conftest import PATIENCE_S, wait_until
from tests.dashboard import command
from tests.dashboard.command import ZENFI, Answer, zenfi
from tests.injector.cpp_program import mapper, running_program
from tests.injector.programs import HAS_AVX512, state
from zenfi import injection as zenfi_injection

NOBODY = 65534

__all__ = ["mapper"]


def inject(*arguments: object) -> Answer:
    return zenfi("inject", *arguments)


def refusal(*arguments: object) -> str:
    """The line that such a command ends with."""
    return command.refusal("inject", *arguments)


@contextmanager
def sleeper() -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen(["/bin/sleep", "1000"]) as process:
        try:
            yield process
        finally:
            process.kill()


def test_the_card_says_what_was_done(mapper: Path) -> None:
    with running_program(mapper) as process:
        pid = str(process.pid)
        options = ("--symbol", "grid::insert(double, int)", "--fault", "operand=source")
        typed = [ZENFI, "inject", "--pid", pid, *options]
        answer = subprocess.run(typed, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
        assert (answer.returncode, answer.stderr) == (0, "")
        lines = answer.stdout.splitlines()
        assert lines[0].startswith(f"injected: process {pid} (mapper), thread ")
        told = {line.split()[0]: line for line in lines[1:]}
        assert re.search(r"grid::insert\(double, int\), /\S+:\d+, libgrid.so at 0x", told["at"])
        assert {"executes", "struck", "before", "after", "read", "when", "pause", "then"} <= set(told)
        assert "rehearsed, instruction" in told["when"]
        assert "4 threads stood" in told["pause"]
        assert {tracer_of(tid) for tid in threads(process.pid)} <= {0}


def test_the_record_is_one_object_and_the_same_seed_draws_the_same(mapper: Path) -> None:
    with running_program(mapper) as process:
        options = ("--symbol", "_ZN4grid6insertEdi", "--dry-run", "--seed", "3", "--json")
        records = []
        for _ in range(2):
            answer = inject("--pid", process.pid, *options)
            assert (answer.returncode, answer.stderr) == (0, "")
            records.append(json.loads(answer.stdout))
        one, other = records
        assert one["dry_run"]
        assert one["injection"]["status"] == "not_activated"
        assert one["injection"]["before"] == one["injection"]["after"] == one["injection"]["read_back"]
        assert one["aftermath"]["result"] == "lives"
        for name in ("instruction", "offset", "register", "bits"):
            assert one["injection"][name] == other["injection"][name]


def test_of_a_long_call_the_pass_is_told(mapper: Path) -> None:
    with running_program(mapper) as process:
        answer = inject("--pid", process.pid, "--symbol", "lengthy", "--seed", "3", "--dry-run")
        found = re.search(r"exact, pass (\d+) through it, of (\d+) instructions", answer.stdout)
        assert found is not None, answer.stdout + answer.stderr
        assert 0 < int(found[1]) <= int(found[2])


def test_a_stripped_library_is_struck_by_its_name_and_its_functions_are_not_found(
    mapper: Path, tmp_path: Path
) -> None:
    stripped = tmp_path / "mapper"
    subprocess.run(["/usr/bin/env", "strip", "-o", stripped, mapper], check=True)
    with running_program(stripped) as process:
        busy = threads(process.pid)[1]
        answer = inject("--pid", process.pid, "--module", "mapper", "--thread", busy, "--dry-run")
        assert answer.returncode == 0, answer.stdout + answer.stderr
        assert "mapper at 0x" in answer.stdout
        assert "stripped" in refusal("--pid", process.pid, "--symbol", "lengthy", "--module", "mapper")


def test_what_is_refused_is_one_line_and_status_2() -> None:
    assert refusal("--pid", 2).startswith("process 2 ")


def test_pids_that_are_no_targets() -> None:
    with subprocess.Popen(["/bin/true"]) as ended:
        wait_until(lambda: state(ended.pid) == "Z")
        assert f"process {ended.pid} (true) has ended: it is a zombie" == refusal("--pid", ended.pid)
    assert f"there is no process {ended.pid}" == refusal("--pid", ended.pid)
    assert "thread of the kernel" in refusal("--pid", 2)
    assert "is this injector itself" in refusal("--pid", os.getpid())


@pytest.fixture(params=["admitted", "aimed at"])
def ended_once(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every target ends as soon as it is admitted, or when it is known where to strike it: a certain race."""

    def end(pid: int) -> None:
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: state(pid) == "Z")

    def admit_and_end(pid: int, kind: type[Process]) -> Process:
        process = admit(pid, kind)
        end(pid)
        return process

    def end_and_inject(process: Process, *details: Any, **more: Any) -> Any:
        end(process.pid)
        return inject_into(process, *details, **more)

    if request.param == "admitted":
        monkeypatch.setattr(zenfi_injection, "admit", admit_and_end)
    else:
        monkeypatch.setattr(zenfi_injection, "inject_into", end_and_inject)


@pytest.mark.usefixtures("ended_once")
@pytest.mark.parametrize(
    "options", [(), ("--symbol", "main"), ("--module", "libc"), ("--fault", "model=opcode")]
)
def test_one_that_ends_while_it_is_got_hold_of_is_not_injected(
    options: tuple[str, ...], mapper: Path
) -> None:
    with running_program(mapper) as process:
        answer = inject("--pid", process.pid, *options)
        assert (answer.returncode, answer.stderr) == (1, "")
        assert answer.stdout == (
            f"failed: process {process.pid} (mapper): the process ended before the fault\n"
        )


@pytest.mark.usefixtures("ended_once")
def test_the_record_of_one_that_ended_says_so() -> None:
    with sleeper() as process:
        answer = inject("--pid", process.pid, "--json")
        record = json.loads(answer.stdout)
        assert answer.returncode == 1
        assert record["injection"]["status"] == "failed"
        assert record["injection"]["reason"] == "the process ended before the fault"
        assert record["aftermath"]["result"] == "ended"


@pytest.mark.parametrize("options", [(), ("--module", "libc"), ("--symbol", "abort")])
def test_one_that_is_killed_before_the_fault_is_told_with_its_end(options: tuple[str, ...]) -> None:
    with sleeper() as process:

        def kill_once_traced() -> None:
            wait_until(lambda: tracer_of(process.pid) != 0)
            process.kill()

        killer = threading.Thread(target=kill_once_traced)
        killer.start()
        answer = inject("--pid", process.pid, *options, "--json")
        killer.join()
        record = json.loads(answer.stdout)
        assert answer.returncode == 1
        assert record["injection"]["status"] == "failed"
        assert "ended" in record["injection"]["reason"]
        assert record["aftermath"]["result"] in ("killed", "ended")  # killed while it was being seized


def test_one_that_becomes_another_program_meanwhile_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    shell = ["/bin/sh", "-c", "read line; exec /bin/sleep 1000"]
    with subprocess.Popen(shell, stdin=subprocess.PIPE) as process:

        def admit_and_let_go(pid: int, kind: type[Process]) -> Process:
            admitted = admit(pid, kind)
            assert process.stdin is not None
            process.stdin.write(b"\n")
            process.stdin.flush()
            wait_until(lambda: name_of(pid) == "sleep")
            return admitted

        monkeypatch.setattr(zenfi_injection, "admit", admit_and_let_go)
        try:
            said = refusal("--pid", process.pid)
            assert said == (
                f"process {process.pid} (sleep) has become another program or user meanwhile: try again"
            )
            assert process.poll() is None
            assert tracer_of(process.pid) == 0
        finally:
            process.kill()


def test_processes_that_end_in_no_time_are_told_of_in_one_way_or_the_other() -> None:
    for number in range(12):
        with subprocess.Popen(["/bin/sleep", f"{number / 1000}"]) as process:
            answer = inject("--pid", process.pid, "--cpu-s", "0", "--limit-s", "1", "--watch-s", "0.1")
            assert answer.returncode in (0, 1, 2)
            if answer.returncode == 2:
                assert answer.stderr.startswith(f"zenfi: process {process.pid} ") or (
                    answer.stderr == f"zenfi: there is no process {process.pid}\n"
                )
            process.kill()  # the flip may keep it from its end


def test_whoever_is_traced_already_is_refused_with_the_tracer() -> None:
    with sleeper() as process:
        with TraceeGroup() as tracees:
            tracees.seize([process.pid])
            assert f"is traced by process {os.getpid()} (" in refusal("--pid", process.pid)
        assert process.poll() is None


def test_threads_that_are_not_the_processs(mapper: Path) -> None:
    with running_program(mapper) as process:
        thread = threads(process.pid)[1]
        assert refusal("--pid", thread).endswith(f"give --pid {process.pid} --thread {thread}")
        said = refusal("--pid", process.pid, "--thread", os.getpid())
        assert said.startswith(f"process {process.pid} has no thread {os.getpid()}; its threads: ")
        assert str(thread) in said


def test_names_that_are_not_there_or_not_only_once(mapper: Path) -> None:
    with running_program(mapper) as process:

        def said(*options: str) -> str:
            return refusal("--pid", process.pid, *options)

        assert said("--symbol", "grid::insrt") == "symbol 'grid::insrt' not found; similar: grid::insert"
        assert "is 2 functions: give one in full: grid::insert(double, int) (" in said(
            "--symbol", "grid::insert"
        )
        assert "lengthy" in said("--symbol", "length")
        missing = said("--module", "libmissing.so")
        assert missing.startswith("module 'libmissing.so' is not loaded; loaded: ")
        assert "libgrid.so" in missing
        assert "is 2 files" in said("--module", "libg") or "libgcc" in missing
        assert "not found in libgrid.so" in said("--symbol", "lengthy", "--module", "libgrid.so")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--call", "3"), "call and step go with symbol"),
        (("--symbol", "main", "--step", "1", "--cpu-s", "1"), "leave out one"),
        (("--after-s", "5-1"), "'5-1'"),
        (("--call", "0"), "'0'"),
        (("--fault", "scope=kernel"), "scope goes with flights"),
        (("--fault", "bits"), "NAME=VALUE"),
        (("--fault", "register_class=flags,bits=8"), "7 status flags"),
    ],
)
def test_options_that_make_no_sense(options: tuple[str, ...], says: str) -> None:
    with sleeper() as process:
        assert says in refusal("--pid", process.pid, *options)


@pytest.mark.skipif(HAS_AVX512, reason="this processor has mask registers")
def test_registers_that_the_processor_lacks() -> None:
    with sleeper() as process:
        said = refusal("--pid", process.pid, "--fault", "register_class=mask")
        assert "absent on this CPU" in said


def small_32_bit_program(file: Path) -> None:
    """An ELF file of one page that pauses for ever: mov eax,29; int 0x80; jmp back."""
    code = bytes.fromhex("b81d000000 cd80 ebf7")
    base, header = 0x08048000, 52 + 32
    identity = b"\x7fELF\x01\x01\x01".ljust(16, b"\0")
    size = header + len(code)
    head = struct.pack("<HHIIIIIHHHHHH", 2, 3, 1, base + header, 52, 0, 0, 52, 32, 1, 40, 0, 0)
    segment = struct.pack("<IIIIIIII", 1, 0, base, base, size, size, 5, 4096)
    file.write_bytes(identity + head + segment + code)
    file.chmod(0o755)


def test_a_32_bit_process_is_refused(tmp_path: Path) -> None:
    small_32_bit_program(tmp_path / "small")
    try:
        process = subprocess.Popen([tmp_path / "small"])
    except OSError:
        pytest.skip("this kernel runs no 32-bit programs")
    with process:
        try:
            assert "(small) is 32-bit" in refusal("--pid", process.pid)
            assert process.poll() is None
        finally:
            process.kill()


AS_NOBODY = """
import os, sys
from injector.attach.permission import AttachRefusedError, admit
from injector.attach.injection import inject_into
os.setuid(65534)
try:
    admit(int(sys.argv[1]))
except AttachRefusedError as error:
    print(error)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="needs two users")
def test_another_users_process_is_refused_with_its_owner() -> None:
    with sleeper() as process:
        asking = [sys.executable, "-c", AS_NOBODY, str(process.pid)]
        answer = subprocess.run(
            asking,
            cwd=Path(__file__).parents[4],
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE_S,
        )
        assert (
            f"not permitted to trace process {process.pid} (sleep): it belongs to user root" in answer.stdout
        )


def test_what_yama_and_containers_forbid_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = os.getpid()
    assert "--cap-add SYS_PTRACE" in not_permitted(own)
    scope = tmp_path / "ptrace_scope"
    scope.write_text("1\n")
    monkeypatch.setattr(permission, "_YAMA", scope)
    monkeypatch.setattr(os, "geteuid", lambda: NOBODY)
    monkeypatch.setattr(permission, "_owner", lambda _: NOBODY)
    assert "Yama's ptrace_scope is 1: sysctl kernel.yama.ptrace_scope=0" in not_permitted(own)
    scope.write_text("3\n")
    assert "only a reboot lifts that" in not_permitted(own)
