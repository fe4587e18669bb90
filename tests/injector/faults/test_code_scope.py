"""What is the kernel's own code, in the map of a process and in a struck program."""

import os
from pathlib import Path
from typing import Any

import pytest
from numba import njit

from injector.faults import apply as striking
from injector.faults.apply import apply_fault
from injector.faults.code_scope import within
from injector.tracing.elf import place
from injector.tracing.process import Process, ProcessIdentity
from services.kernels import KERNELS
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator
from tests.injector.c_programs import Program, compiled, running_program

LOOP = """
double kernel(void) {
    volatile long sum = 0;
    for (long i = 0; i < 100; i++) sum += i;
    return sum;
}
"""
RESULT = "4950"


def fault(target: str, **fields: Any) -> FaultSpec:
    return FaultSpec(target=target, scope="kernel", **fields)


def test_a_compiled_kernels_code_is_in_memory_without_a_file() -> None:
    compiled_code: Any = next(iter(njit("int64(int64)")(lambda x: x + 1).overloads.values()))
    address = compiled_code.library.get_pointer_to_function(compiled_code.fndesc.llvm_func_name)
    with Process(ProcessIdentity.of(os.getpid())) as own:
        assert within(fault("pid"), own)(address)
        (vdso,) = [one.start for one in own.maps().code() if one.name == "[vdso]"]
        assert not within(fault("pid"), own)(vdso)
        assert within(FaultSpec(target="pid", scope="thread"), own)(vdso)


@pytest.mark.parametrize("target", ["octomap", "rrt"])
def test_a_librarys_code_is_the_kernels_where_the_table_names_it(target: str) -> None:
    __import__({"octomap": "pyoctomap", "rrt": "ompl"}[target])
    with Process(ProcessIdentity.of(os.getpid())) as own:
        maps = own.maps()
        inside = within(fault(target), own)
        modules = set()
        for one in maps.code():
            name = Path(one.path).name
            expected = not one.name or name.startswith(KERNELS[target].modules)
            assert inside(one.start) == inside(one.end - 1) == expected
            modules |= {name} if expected else set()
        assert any(name.startswith(KERNELS[target].modules) for name in modules)


def struck_from_the_mark(one: Program, spec: FaultSpec, seed: int) -> tuple[str, int]:
    """The module that is struck, and how many instructions after the mark."""
    with one.at_kernel(entered=False) as (tracees, thread, process):
        found = None
        while found is None:  # the mark is a system call, and so is stepped over here
            found = apply_fault(tracees, thread, process, spec, generator(seed, "test"))
            if found is None:
                tracees.step(thread)
        assert found.instruction is not None
        module = place(one.pid, process.maps(), found.instruction.address).module
    assert one.result() == RESULT
    return module, found.passed_over


@pytest.mark.usefixtures("may_inject")
def test_only_the_kernels_own_code_is_struck_and_not_always_its_first_instruction(tmp_path: Path) -> None:
    with running_program(compiled(tmp_path, LOOP, library="liboctomap-test.so")) as one:
        own = [struck_from_the_mark(one, fault("octomap", model="none"), seed) for seed in range(8)]
        assert {module for module, _ in own} == {"liboctomap-test.so"}
        assert len({passed_over for _, passed_over in own}) > 4
        anywhere, _ = struck_from_the_mark(one, FaultSpec(target="octomap", scope="thread", model="none"), 0)
        assert anywhere == "libc.so.6"


@pytest.mark.usefixtures("may_inject")
def test_code_that_is_never_come_to_is_not_activated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(striking, "OUTSIDE", 200)
    with running_program(compiled(tmp_path, LOOP)) as one:
        with one.at_kernel() as (tracees, thread, process):
            found = apply_fault(tracees, thread, process, fault("octomap"), generator(0, "test"))
            assert found is not None
            assert (found.status, found.passed_over) == ("not_activated", 200)
            assert found.reason == "none of the kernel's own code in 200 instructions"
        assert one.result() == RESULT
