"""``zenfi.inject``: any process, from Python."""

import subprocess
import sys

import pytest

import zenfi

LOOP = "print('ready', flush=True)\nwhile True: sum(range(1000))"


def test_a_process_is_struck_and_goes_on() -> None:
    with subprocess.Popen([sys.executable, "-c", LOOP], stdout=subprocess.PIPE) as target:
        assert target.stdout is not None
        assert target.stdout.readline() == b"ready\n"
        done = zenfi.inject(target.pid, cpu_s=(0.001, 0.01), dry_run=True, watch_s=0.1, seed=3)
        assert done.injection.pid == target.pid
        assert done.injection.bits
        assert done.injection.read_back == done.injection.before
        assert target.poll() is None
        target.kill()


def test_what_contradicts_itself_is_refused() -> None:
    with pytest.raises(zenfi.BadSpecError, match="pid or node"):
        zenfi.inject()
    with pytest.raises(zenfi.BadSpecError, match="call and step go with symbol"):
        zenfi.inject(1, call=3)
