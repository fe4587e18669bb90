"""The kernels' samples that come along are those of the stated flight."""

from pathlib import Path

import pytest

from deploy.bench.kernel_samples import make_samples, write
from deploy.mission.fork_server import ForkServer
from services.kernels import KERNELS


@pytest.mark.soak
def test_the_flight_gives_the_same_samples_again(server: ForkServer, tmp_path: Path) -> None:
    samples = make_samples(server)
    assert set(samples) == {kernel.sample_file for kernel in KERNELS.values()}
    for file, sample in samples.items():
        again = tmp_path / file.name
        write(sample, again)
        assert again.read_bytes() == file.read_bytes(), file
