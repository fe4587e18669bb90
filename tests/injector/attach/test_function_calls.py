"""Calls of a function are those that its user means: of whatever variant, of the copy that runs."""

from pathlib import Path
from typing import Any

import pytest

from injector.attach.approach import AttachTarget
from injector.attach.call_approach import CALLS_LEFT
from injector.attach.function_calls import CalledFunction
from injector.attach.injection import ProcessInjection, inject_into
from injector.attach.permission import admit
from injector.tracing.process import threads
from injector.tracing.symbols import SymbolError, copies_elsewhere, variants_of
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator
from tests.injector.cpp_program import compiled_cpp, running_program

pytestmark = pytest.mark.usefixtures("may_inject")

_HEADER = """
#include <string>
namespace ns {
struct Base { long a; Base(int); virtual ~Base(); };
struct Left : virtual Base { long b; Left(int); ~Left() override; };
template <class T> struct Scale {
    __attribute__((noinline)) T by(T x, int n) { volatile T s = 0; while (n--) s = s + x; return s; }
};
__attribute__((noinline)) inline std::string tagged(int n) { return std::string(n, 'x'); }
__attribute__((noinline)) inline double twice(double x) { return 2 * x; }
__attribute__((noinline)) inline float twice(float x) { return 2 * x; }
double of_library(double x);
}
extern "C" double shared(double x, int n);
"""

_LIBRARY = """
namespace ns {
Base::Base(int n) : a(n) {}
Base::~Base() { a = 0; }
Left::Left(int n) : Base(n), b(n) {}
Left::~Left() { volatile long s = 0; for (int i = 0; i < 9; i++) s = s + i; b = s; }
double of_library(double x) { Scale<double> one; return one.by(x, 30) + shared(x, 20); }
}
double shared(double x, int n) { volatile double s = 0; while (n--) s = s + x; return s; }
"""

_MAIN = """
#include <cstdio>
#include <unistd.h>
#include <sys/prctl.h>
volatile double total; volatile long size;
extern "C" long work(long n) __asm__("work.constprop.0");
__attribute__((noinline)) long work(long n) { volatile long s = n; return s + 1; }
double shared(double x, int n) { volatile double s = 1; while (n--) s = s + 3 * x; return s; }
int main() {
    prctl(PR_SET_PTRACER, -1L, 0, 0, 0);
    prctl(PR_SET_PDEATHSIG, 9);
    puts("ready"); fflush(stdout);
    for (long round = 0;; round++) {
        ns::Scale<double> one;
        total = one.by(round, 20) + ns::of_library(round) + ns::twice(1.0 * round) + ns::twice(1.0f * round);
        { ns::Left here(3); size = here.b; }
        delete new ns::Left(4);
        size = ns::tagged(round % 40).size() + work(round);
        usleep(200);
    }
}
"""


@pytest.fixture(scope="session")
def variants(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program ``variants`` and its library ``libvariants.so``, which define several functions both."""
    folder = tmp_path_factory.mktemp("variants")
    library = compiled_cpp(folder / "libvariants.so", _HEADER + _LIBRARY, "-shared", "-fPIC")
    return compiled_cpp(folder / "variants", _HEADER + _MAIN, str(library), f"-Wl,-rpath,{folder}")


_LEAVER = """
#include <csetjmp>
#include <cstdio>
#include <cstring>
#include <pthread.h>
#include <sys/prctl.h>
#include <unistd.h>
static jmp_buf out;
volatile long sum;
__attribute__((noinline)) void work(long n) { for (long i = 0; i < n; i++) sum = sum + i; }
__attribute__((noinline)) void jumps() { work(300); if (sum) longjmp(out, 1); }
__attribute__((noinline)) void throws() { work(300); if (sum) throw 1; }
__attribute__((noinline)) void at_times(long round) { work(300); if (round % 3) longjmp(out, 1); }
__attribute__((noinline)) void deep(int n) { if (n) { deep(n - 1); work(1); } else work(100); }
__attribute__((noinline)) void ends() { work(300); pthread_exit(nullptr); }
void await_tracer() {
    for (int tracer = 0; !tracer; usleep(1000)) {
        char line[256];
        FILE *status = fopen("/proc/thread-self/status", "r");
        while (fgets(line, sizeof line, status)) sscanf(line, "TracerPid: %d", &tracer);
        fclose(status);
    }
    sleep(1);  // until it watches for calls
}
void *thread(void *) { await_tracer(); ends(); return nullptr; }
int main(int, char **arguments) {
    prctl(PR_SET_PTRACER, -1L, 0, 0, 0);
    prctl(PR_SET_PDEATHSIG, 9);
    pthread_t other;
    if (!strcmp(arguments[1], "ends")) pthread_create(&other, nullptr, thread, nullptr);
    puts("ready"); fflush(stdout);
    if (!strcmp(arguments[1], "once")) {
        await_tracer();
        if (!setjmp(out)) { jumps(); work(7); }
        for (;;) pause();
    }
    for (volatile long round = 0;; round = round + 1) {
        usleep(200);
        if (!strcmp(arguments[1], "ends")) continue;
        if (!setjmp(out)) at_times(round);
        if (!setjmp(out)) { jumps(); work(7); }
        try { throws(); work(7); } catch (int) {}
        deep(40);
    }
}
"""


@pytest.fixture(scope="session")
def leaver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program whose functions are left by jumps, exceptions and the ends of threads."""
    return compiled_cpp(tmp_path_factory.mktemp("leaver") / "leaver", _LEAVER, "-pthread")


def strike(pid: int, symbol: str, module: str = "", **aim: Any) -> ProcessInjection:
    """A dry run of an injection into a call of a function."""
    with admit(pid) as process:
        maps = process.maps()
        found = variants_of(pid, maps, symbol, module)
        function = CalledFunction(found, copies_elsewhere(pid, maps, found) if module else ())
        target = AttachTarget(tids=tuple(threads(pid)), function=function, **aim)
        draw = generator(0, "any process")
        return inject_into(process, target, FaultSpec(target="any"), draw, dry_run=True, watch_s=0)


LEFT, SCALE = "_ZN2ns4LeftC1Ei", "_ZN2ns5ScaleIdE2byEdi"


@pytest.mark.parametrize(
    ("name", "symbols", "file"),
    [
        ("ns::Left::Left(int)", {LEFT}, "libvariants.so"),
        (LEFT, {LEFT}, "libvariants.so"),
        ("ns::Left::~Left()", {"_ZN2ns4LeftD0Ev", "_ZN2ns4LeftD1Ev"}, "libvariants.so"),
        ("ns::Scale<double>::by(double, int)", {SCALE}, "variants"),
        ("ns::Scale<double>::by", {SCALE}, "variants"),
        (SCALE, {SCALE}, "variants"),
        ("ns::tagged(int)", {"_ZN2ns6taggedB5cxx11Ei"}, "variants"),
        ("ns::tagged[abi:cxx11](int)", {"_ZN2ns6taggedB5cxx11Ei"}, "variants"),
        ("shared", {"shared"}, "variants"),
        ("work", {"work.constprop.0"}, "variants"),
    ],
)
def test_a_full_name_is_struck_whatever_variants_and_copies_it_has(
    variants: Path, name: str, symbols: set[str], file: str
) -> None:
    with running_program(variants) as process:
        record = strike(process.pid, name, step=0).injection
        assert record.bits, record.reason
        assert (record.symbol in symbols, record.module) == (True, file)


def test_a_mangled_name_is_of_its_variant_alone(variants: Path) -> None:
    with running_program(variants) as process:
        for symbol in ("_ZN2ns4LeftD0Ev", "_ZN2ns4LeftD1Ev"):
            assert strike(process.pid, symbol, step=0, call=(2, 3)).injection.symbol == symbol
        missed = strike(process.pid, "_ZN2ns4LeftD2Ev", limit_s=0.3).injection  # of derived classes only
        assert missed.status == "not_reached"


def test_a_short_name_of_several_functions_is_told_with_all_of_them(variants: Path) -> None:
    with running_program(variants) as process, pytest.raises(SymbolError) as refused:
        strike(process.pid, "ns::twice")
    said = str(refused.value)
    assert said.startswith(
        "symbol 'ns::twice' is 2 functions: give one in full: ns::twice(double) (_ZN2ns5tw"
    )
    assert "; ns::twice(float) (" in said


def test_a_copy_that_does_not_run_is_told_with_the_one_that_does(variants: Path) -> None:
    with running_program(variants) as process:
        for symbol in ("shared", SCALE):
            missed = strike(process.pid, symbol, "libvariants").injection
            assert missed.status == "not_reached"
            assert (
                "in libvariants.so is not called, that in variants is: give --module variants"
                in missed.reason
            )
            assert strike(process.pid, symbol, "variants", step=0).injection.bits


@pytest.mark.parametrize("name", ["jumps()", "throws()"])
def test_calls_that_never_return_are_told_of_before_the_time_limit(leaver: Path, name: str) -> None:
    with running_program(leaver, "often") as process:
        missed = strike(process.pid, name, limit_s=600.0)
        assert missed.injection.status == "not_reached"
        assert "left by a jump or an exception" in missed.injection.reason
        assert missed.rehearsals == CALLS_LEFT


def test_a_call_that_returns_is_taken_after_those_that_were_left(leaver: Path) -> None:
    with running_program(leaver, "often") as process:
        done = strike(process.pid, "at_times(long)", limit_s=600.0, call=(3, 3))
        assert done.injection.bits or "the drawn one is number" in done.injection.reason
        assert done.injection.precision in ("rehearsed", "exact")


def test_a_recursive_call_is_over_when_the_first_of_them_is(leaver: Path) -> None:
    with running_program(leaver, "often") as process:
        done = strike(process.pid, "deep(int)", limit_s=600.0)
        assert (done.injection.precision, done.rehearsals) == ("rehearsed", 2)
        assert done.instructions is not None
        assert done.instructions > 40 * 5


@pytest.mark.parametrize(("how", "name"), [("once", "jumps()"), ("ends", "ends()")])
def test_whoever_left_the_only_call_and_sleeps_or_ends_is_not_waited_for(
    leaver: Path, how: str, name: str
) -> None:
    with running_program(leaver, how) as process:
        missed = strike(process.pid, name, limit_s=600.0, cpu_s=(500.0, 500.0)).injection
        assert missed.status in ("not_reached", "failed")
        assert "left" in missed.reason or "ended" in missed.reason
        assert process.poll() is None
