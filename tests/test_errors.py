"""The message and the attributes of SimulationDiverged."""

import copy
import pickle

import pytest

from torchsoro.errors import SimulationDiverged

SEEN = {
    "step": 1234,
    "time": 0.01234,
    "particle": 567,
    "quantity": "J <= 0 (J = -0.2)",
    "batch": 2,
    "remedy": "a smaller time step",
}


def test_the_message_names_step_time_particle_quantity_and_remedy():
    error = SimulationDiverged(**SEEN)
    assert str(error) == (
        "step 1234 (t = 12.34 ms): particle 567 of simulation 2: J <= 0 (J = -0.2). Try: a smaller time step."
    )
    assert {name: getattr(error, name) for name in SEEN} == SEEN


def test_without_a_particle_the_message_names_the_simulation():
    error = SimulationDiverged(step=1, time=1e-5, particle=None, quantity="NaN in the loss", remedy="a lower load.")
    assert str(error) == "step 1 (t = 0.01 ms): simulation 0: NaN in the loss. Try: a lower load."


@pytest.mark.parametrize("duplicate", [copy.copy, lambda error: pickle.loads(pickle.dumps(error))])
def test_it_survives_copy_and_pickle(duplicate):
    error = duplicate(SimulationDiverged(**SEEN))
    assert type(error) is SimulationDiverged
    assert str(error) == str(SimulationDiverged(**SEEN))
    assert {name: getattr(error, name) for name in SEEN} == SEEN


def test_it_takes_keywords_only_and_is_a_runtime_error():
    assert issubclass(SimulationDiverged, RuntimeError)
    with pytest.raises(TypeError):
        SimulationDiverged(1, 0.1, 2, "J", 0, "less")  # type: ignore[misc]
