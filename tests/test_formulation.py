"""A formulation by its name, or as an object: the same simulation."""

from __future__ import annotations

import pytest
import torch
from problems import DT, WAYS, block, simulator

from torchsoro import Prony, ground, stable_step
from torchsoro.simulation.formulation import Total, Updated, formulation_of

OBJECTS = {"apic": Updated(), "flip": Updated(transfer="flip"), "total": Total()}


@pytest.mark.parametrize("way", WAYS)
def test_a_formulation_as_an_object_simulates_the_same_bits_as_by_name(way):
    run = {"duration": 8 * DT, "prony": Prony.paper(1), "planes": (ground(),), "probes": torch.arange(4)}
    _, body = block()
    by_name, by_object = (simulator(**options)(body, **run) for options in (WAYS[way], {"formulation": OBJECTS[way]}))
    assert torch.equal(by_name.position, by_object.position)
    assert torch.equal(by_name.final, by_object.final)
    assert by_name.position.std(1).max() > 0


def test_a_stable_step_of_the_updated_form_does_not_depend_on_the_transfer():
    _, body = block()
    steps = {stable_step(body, None, cell=5e-3, formulation=form) for form in ("updated", *OBJECTS.values())}
    assert len(steps) == 2


def test_a_state_of_either_formulation_has_the_shape_that_the_formulation_says():
    _, body = block()
    shapes = {form: simulator(**options)(body, duration=DT).final.shape for form, options in WAYS.items()}
    assert shapes["apic"] == shapes["flip"] != shapes["total"]


def test_transfer_beside_an_object_or_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match=r"^transfer = 'flip' beside formulation = Total\(\): wanted only one of both"):
        formulation_of(Total(), "flip")
    with pytest.raises(ValueError, match=r"^transfer = 'pic': wanted one of 'apic', 'flip'"):
        Updated(transfer="pic")
    with pytest.raises(ValueError, match=r"^transfer = 'pic': wanted one of"):
        formulation_of("total", "pic")
    with pytest.raises(ValueError, match=r"^formulation = 'eulerian': wanted \"updated\" or \"total\""):
        simulator(formulation="eulerian")
