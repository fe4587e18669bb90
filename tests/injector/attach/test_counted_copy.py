"""Calls too long to step through are struck at an instruction drawn uniformly, and the process hears nothing."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from scipy import stats

from injector.attach.approach import AttachTarget
from injector.attach.function_calls import CalledFunction
from injector.attach.injection import ProcessInjection, inject_into
from injector.attach.permission import admit
from injector.tracing.process import threads
from injector.tracing.symbols import variants_of
from services.models.faults.specification import FaultSpec
from services.runtime.rng import generator
from tests.conftest import wait_until
from tests.injector.cpp_program import compiled_cpp, running_program

pytestmark = pytest.mark.usefixtures("may_inject")

ROUNDS = {"lengthy": 20_000, "huge": 1_000_000}
_SOURCE = """
#include <csignal>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <pthread.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>
asm(R"(
    .text
    .globl lengthy
    .type lengthy, @function
lengthy:
    xor %eax, %eax
    xor %edx, %edx
    mov %rdi, %rcx
lengthy_first:
    add %rcx, %rax
    lea 1(%rax,%rdx), %rdx
    dec %rcx
    jnz lengthy_first
    lea (%rdi,%rdi,2), %rcx
lengthy_second:
    xor %rcx, %rax
    add %rax, %rdx
    dec %rcx
    jnz lengthy_second
    add %rdx, %rax
    ret
    .size lengthy, . - lengthy
)");
extern "C" long lengthy(long n);
extern "C" __attribute__((noinline)) long huge(long n) { return lengthy(n) + 1; }
int *shared; FILE *out; pthread_mutex_t held = PTHREAD_MUTEX_INITIALIZER;
extern "C" __attribute__((noinline)) long writes(long n) { long r = lengthy(n); write(fileno(out), "x", 1); return r + 1; }
extern "C" __attribute__((noinline)) long shares(long n) { long r = lengthy(n); *shared += 1; return r; }
extern "C" __attribute__((noinline)) long locks(long n) {
    long r = lengthy(n); pthread_mutex_lock(&held); pthread_mutex_unlock(&held); return r;
}
void *holder(void *) { for (;;) { pthread_mutex_lock(&held); usleep(3000); pthread_mutex_unlock(&held); usleep(30); } }
void heard(int) { _exit(3); }
int main(int, char **arguments) {
    prctl(PR_SET_PTRACER, -1L, 0, 0, 0);
    prctl(PR_SET_PDEATHSIG, 9);
    signal(SIGCHLD, heard);
    auto is = [&](const char *name) { return !strcmp(arguments[1], name); };
    shared = (int *)mmap(nullptr, 4096, 3, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    out = tmpfile();
    pthread_t other;
    if (is("locks")) pthread_create(&other, nullptr, holder, nullptr);
    if (is("seccomp")) {
        sock_filter all[] = {
            BPF_STMT(BPF_LD | BPF_W | BPF_ABS, 0), BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, 56, 0, 1),
            BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_KILL_PROCESS), BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW)};
        sock_fprog program = {4, all};
        prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0);
        prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, &program);
    }
    long n = atol(arguments[2]), first = lengthy(n);
    puts("ready"); fflush(stdout);
    for (;;) {
        if (lengthy(n) != first) _exit(4);
        if (huge(n) != first + 1 || writes(n) != first + 1 || shares(n) != first) _exit(4);
        if (is("locks")) locks(n);
        if (waitpid(-1, nullptr, WNOHANG) != -1) _exit(5);
        usleep(100);
    }
}
"""


@pytest.fixture(scope="session")
def long_calls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program of long calls that ends if a child is heard of, or if a call gives another result."""
    return compiled_cpp(
        tmp_path_factory.mktemp("long_calls") / "long_calls", _SOURCE, "-pthread", "-no-pie", "-w"
    )


def strike(pid: int, symbol: str, seed: int = 0, *, dry_run: bool = True, **fault: Any) -> ProcessInjection:
    """An injection into a call of a function, a dry run if nothing else is asked for."""
    with admit(pid) as process:
        function = CalledFunction(variants_of(pid, process.maps(), symbol, ""))
        target = AttachTarget(tids=(pid,), function=function)
        draw = generator(seed, "any process")
        spec = FaultSpec(target="any", seed=seed, **fault)
        return inject_into(process, target, spec, draw, dry_run=dry_run, watch_s=0)
