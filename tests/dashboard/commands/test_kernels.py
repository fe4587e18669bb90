"""What a study found is counted, divided and measured as it is."""

import pytest

from dashboard.analysis.kernel_study import divided, instruction_class, short_lines, summarise
from injector.kernel_study.results import CallLength, StudyResult, StudyRun
from services.models.outcome import InjectionRecord


def run(index: int, result: StudyResult, register: str, deviation: float | None = None) -> StudyRun:
    record = InjectionRecord(
        status="injected",
        precision="exact",
        node="pid",
        kernel="pid",
        invocation=0,
        bits=[index],
        register=register,
    )
    return StudyRun(kernel="pid", index=index, result=result, deviation=deviation, injection=record)


RUNS = [
    run(0, "benign", "rax"),
    run(1, "crash", "rsp"),
    run(2, "sdc", "xmm0", 0.5),
    run(3, "sdc", "xmm0", 1.5),
    run(4, "sdc", "rax", None),
    run(9, "not_injected", "rbx").model_copy(update={"cause": "the place is a system call"}),
]


def test_what_was_not_injected_is_counted_apart() -> None:
    found = summarise("pid", "m/s", RUNS, CallLength(scope=90, eligible=80, all=100), 10.0, 5.0)
    assert (found.attempted, found.injected) == (6, 5)
    assert {name: one.count for name, one in found.shares.items()} == {
        "benign": 1,
        "sdc": 3,
        "crash": 1,
        "hang": 0,
    }
    assert found.not_injected == {"the place is a system call": 1}
    assert found.shares["sdc"].low < 0.6 < found.shares["sdc"].high
    assert found.precisions == {"exact": 6}


def test_only_corruption_that_has_a_size_is_measured() -> None:
    found = summarise("pid", "m/s", RUNS, CallLength(scope=90, eligible=80, all=100), 10.0, 5.0)
    assert found.measured == 2
    assert found.deviations == pytest.approx((1.0, 1.45, 1.5))


def test_a_study_is_divided_by_what_was_struck() -> None:
    groups = {name: (count, shares["sdc"].count) for name, count, shares in divided(RUNS, "register")}
    assert groups == {"rax": (2, 1), "xmm0": (2, 2), "rsp": (1, 0)}
    assert [name for name, _, _ in divided(RUNS, "bit")] == ["0-7"]


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("jne short 0000000000001234h", "control"),
        ("call qword ptr [rax]", "control"),
        ("cmp rax,rbx", "compare"),
        ("ucomisd xmm0,xmm1", "compare"),
        ("vmulsd xmm0,xmm1,xmm2", "floating"),
        ("cvttsd2si rax,xmm0", "floating"),
        ("pxor xmm0,xmm0", "vector"),
        ("vmovups zmm0,[rdi]", "vector"),
        ("movsd xmm0,[rax]", "vector"),
        ("mov rax,[rbx]", "move"),
        ("push rbp", "move"),
        ("lock add dword ptr [rax],1", "integer"),
        ("imul rax,rbx", "integer"),
    ],
)
def test_instructions_are_told_apart_by_what_they_do(text: str, kind: str) -> None:
    assert instruction_class(text) == kind


@pytest.mark.parametrize(
    ("lines", "short"),
    [
        (["/a/b/main.c:1", "/a/b/main.c:2"], ["main.c:1", "main.c:2"]),
        (["/a/x/main.c:1", "/a/y/main.c:2", "unknown"], ["x/main.c:1", "y/main.c:2", "unknown"]),
        (["main.c:1", "/x/main.c:1"], ["main.c:1", "x/main.c:1"]),
        (["unknown"], ["unknown"]),
        ([], []),
    ],
)
def test_source_lines_are_shown_with_as_few_folders_as_tell_their_files_apart(
    lines: list[str], short: list[str]
) -> None:
    assert short_lines(lines) == short
