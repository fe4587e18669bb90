"""Makes the recorded inputs of the kernels, from one golden flight of a stated specification."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from zipfile import ZipFile, ZipInfo

import numpy as np

from deploy.errors import InfrastructureError
from deploy.mission.flight import fly
from deploy.mission.fork_server import ForkServer
from services.kernels import KERNELS
from services.models.mission import MissionSpec
from services.runtime.kernel_trial import NoSampleError, Sample, SampleFlight

SPEC = MissionSpec(world="dense", seed=2)
"""In which the vehicle meets a collision ahead and leads around it in flight."""


def make_samples(server: ForkServer) -> Mapping[Path, Sample]:
    """The sample of each stage, by its file.

    :raises InfrastructureError: if the flight holds no input that puts the kernels to work.
    """
    flight = fly(SPEC, server, keep_messages=True)
    assert flight.messages is not None  # noqa: S101 - asked for
    recording = SampleFlight(SPEC, flight.messages)
    samples = {}
    for kernel in KERNELS.values():
        if kernel.sample_file not in samples:
            stage = importlib.import_module(f"services.{kernel.stage}.samples")
            try:
                samples[kernel.sample_file] = stage.record(recording)
            except NoSampleError as error:
                message = f"{kernel.stage}: {error}"
                raise InfrastructureError(message) from error
    return samples


def write(sample: Sample, file: Path) -> None:
    """Write a sample: the same arrays are the same bytes everywhere.

    Not compressed, and not by :func:`numpy.savez`: its headers differ between releases of Python.
    """
    with ZipFile(file, "w") as archive:
        for name, array in sample.items():
            content = BytesIO()
            np.lib.format.write_array(content, array, allow_pickle=False)
            archive.writestr(ZipInfo(f"{name}.npy"), content.getvalue())
