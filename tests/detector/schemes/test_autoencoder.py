"""The autoencoder scheme."""

import json
import subprocess
import sys

import numpy as np
import pytest

from detector.schemes.autoencoder import INPUTS, SIZES, Autoencoder, AutoencoderParameters, inspect
from detector.schemes.control_scheme import SCORE
from detector.schemes.network_training import fit
from tests.detector.flights import COLUMNS, flight, planned, tracked

LESSONS = [Autoencoder.lesson(flight(phase)) for phase in np.linspace(0.0, 6.0, 20)]
PARAMETERS = Autoencoder.train(LESSONS, 0)


def test_error_free_flights_raise_no_alarm_and_it_watches_control_only() -> None:
    detector = Autoencoder.load(PARAMETERS)
    assert all(detector.check("control", tick) is None for tick in tracked(planned(0.4)))
    nonsense = planned()
    nonsense[:] = np.nan
    assert detector.check("planning", nonsense) is None
    assert detector.score("planning", nonsense) == 0.0


@pytest.mark.parametrize("state", INPUTS)
def test_every_input_is_watched_from_the_first_waypoint_on(state: str) -> None:
    ticks = tracked(planned())
    detector = Autoencoder.load(PARAMETERS)
    assert detector.check("control", ticks[0]) is None
    bad = ticks[1].copy()
    bad[1, COLUMNS["control"][state]] = 2.0**200
    alarm = detector.check("control", bad)
    assert alarm is not None
    assert alarm.state == state
    assert detector.check("control", ticks[1]) is None


def test_a_waypoint_is_compared_with_the_row_behind_it_whatever_came_before() -> None:
    bad = tracked(planned())[0]
    bad[1, COLUMNS["control"]["trajectory.y"]] = 64.0
    assert Autoencoder.load(PARAMETERS).check("control", bad) is not None


def test_the_compiled_network_is_the_one_that_was_trained() -> None:
    import torch

    parameters = AutoencoderParameters.model_validate(PARAMETERS)
    change = np.array([[0, 1, 0, -1, 0, 0, 0, 0, 0, 1, 0, 0, 0]], dtype=np.float64)
    seen = torch.from_numpy((change / np.array(parameters.scale)) ** 3)
    value = seen
    for index, layer in enumerate(parameters.layers):
        value = value @ torch.tensor(layer.weight, dtype=torch.float64).T + torch.tensor(layer.bias)
        value = torch.nn.functional.softsign(value) if index < 2 else value
    expected = float(((value - seen) ** 2).mean()) / parameters.threshold
    values = np.zeros((2, len(COLUMNS["control"])))
    values[1, [COLUMNS["control"][name] for name in INPUTS]] = np.where(change[0] != 0.0, change[0], 0.0)
    network, memory = parameters.packed(), np.zeros(4 + len(INPUTS))
    inspect(memory, network, np.zeros_like(values), True)
    values[1, COLUMNS["control"]["command.vx"]] = 0.5
    inspect(memory, network, values, False)
    assert np.isclose(memory[SCORE], expected)


def test_training_repeats() -> None:
    rows = np.unique(np.concatenate([lesson["changes"] for lesson in LESSONS]), axis=0).astype(np.float64)
    once, again, other = fit(rows, rows, SIZES, 3), fit(rows, rows, SIZES, 3), fit(rows, rows, SIZES, 4)
    assert once == again
    assert once != other


def test_flying_needs_no_torch() -> None:
    program = f"""
import sys
sys.modules["torch"] = None
import json, numpy as np
from detector.schemes.autoencoder import Autoencoder
detector = Autoencoder.load(json.loads({json.dumps(PARAMETERS)!r}))
print(detector.check("control", np.zeros((2, {len(COLUMNS["control"])}))))
"""
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert answer.stdout == "None\n"


def test_another_shape_is_refused() -> None:
    layers = json.loads(json.dumps(PARAMETERS["layers"]))
    layers[1]["weight"][0].append(0.0)
    with pytest.raises(ValueError, match="13-6-3-13"):
        Autoencoder.load({**PARAMETERS, "layers": layers})
