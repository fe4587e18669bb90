"""Only the process that was announced is touched, and its code is read as it is mapped."""

import ctypes
import dataclasses
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from injector.tracing.elf import place
from injector.tracing.process import (
    CodeError,
    IdentityError,
    MemoryMap,
    Process,
    ProcessIdentity,
    VanishedError,
    threads,
)
from services.bus.announce import Announcement, boot_id, start_ticks
from tests.injector.programs import Target, assemble, running

pytestmark = pytest.mark.usefixtures("may_inject")


@contextmanager
def sleeper() -> Iterator[Announcement]:
    """A process that runs another program than ours."""
    with subprocess.Popen(["/bin/sleep", "1000"]) as process:
        try:
            yield Announcement("node", process.pid, process.pid, start_ticks(process.pid), boot_id())
        finally:
            process.kill()


def announced(target: Target) -> ProcessIdentity:
    return ProcessIdentity.announced(target.announcement())


def test_the_announced_process_is_accepted() -> None:
    with running(assemble()) as target, Process(announced(target)) as process:
        process.verify()
        assert process.alive


def test_a_pid_that_is_in_use_again_is_refused() -> None:
    with running(assemble()) as target:
        earlier = dataclasses.replace(announced(target), start_ticks=announced(target).start_ticks - 1)
        with pytest.raises(VanishedError, match=f"process {target.pid} is gone"):
            Process(earlier)


def test_an_announcement_from_another_boot_or_machine_is_refused() -> None:
    with running(assemble()) as target:
        elsewhere = dataclasses.replace(announced(target), boot_id="another")
        with pytest.raises(IdentityError, match="boot_id"):
            Process(elsewhere)


def test_another_program_is_refused() -> None:
    told = r"executable is /.*/sleep now; of a launcher, name the program"
    with sleeper() as claim, pytest.raises(IdentityError, match=told):
        Process(ProcessIdentity.announced(claim))


def test_a_process_that_ended_since_is_told() -> None:
    with running(assemble()) as target, Process(announced(target)) as process:
        target.process.kill()
        target.process.wait()
        assert not process.alive
        with pytest.raises(VanishedError):
            process.verify()


def test_nothing_is_left_open_by_a_refusal() -> None:
    with running(assemble()) as target:
        elsewhere = dataclasses.replace(announced(target), boot_id="another")
        before = os.listdir("/proc/self/fd")  # noqa: PTH208
        with pytest.raises(IdentityError):
            Process(elsewhere)
        assert os.listdir("/proc/self/fd") == before  # noqa: PTH208


def test_all_threads_are_listed() -> None:
    with running(assemble(), threads=3) as target:
        assert len(threads(target.pid)) == 4
        assert target.pid in threads(target.pid)
    assert threads(target.pid) == []


def test_code_is_read_as_it_is() -> None:
    program = assemble()
    with running(program) as target, Process(announced(target)) as process:
        assert process.read_code(target.address) == program[:15]


def test_code_ends_with_its_mapping() -> None:
    with running(assemble()) as target, Process(announced(target)) as process:
        mapping = process.maps().at(target.address)
        assert mapping is not None
        assert len(process.read_code(mapping.end - 4)) == 4


@pytest.mark.parametrize("address", [0, 0x10, 2**47, 2**64 - 1])
def test_where_nothing_is_there_is_no_code(address: int) -> None:
    with running(assemble()) as target, Process(announced(target)) as process, pytest.raises(CodeError):
        process.read_code(address)


def test_a_function_is_told_by_file_build_id_offset_and_name() -> None:
    libc = ctypes.CDLL(None)
    pid = os.getpid()
    with Process(ProcessIdentity.of(pid)) as process:
        maps = process.maps()
    found = {}
    for name in ("getpid", "strtol"):
        address = ctypes.cast(libc[name], ctypes.c_void_p).value
        assert address is not None
        where = place(pid, maps, address + 1)
        assert where.module.startswith("libc")
        assert name in where.symbol
        assert bytes.fromhex(where.build_id)
        found[address] = where.offset
    (one, its), (two, others) = found.items()
    assert one - two == its - others


def test_code_in_no_file_is_told_by_its_address() -> None:
    maps = MemoryMap("7f0000000000-7f0000001000 rwxp 00000000 00:00 0 \n")
    where = place(os.getpid(), maps, 0x7F0000000010)
    assert (where.module, where.build_id, where.offset, where.symbol) == ("", "", 0x7F0000000010, "")
