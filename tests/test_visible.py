"""What would have been seen, and what would make it visible."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from swings import recorded, weighed

from torchsoro.sim2real.inference.decision import MATTERS, STRENGTH, VISIBLE
from torchsoro.sim2real.inference.evidence import infer
from torchsoro.sim2real.inference.isolability import Isolability
from torchsoro.sim2real.inference.visible import FACTORS, limit, remedies, too_weak


def test_an_effect_of_the_limit_is_near_the_credible_probability():
    data, nothing, drag = recorded(0.0, 12)
    weighing = weighed(data, nothing, drag)
    seen = limit(data, weighing.null, drag.slopes, 1.0, weighing.names)
    size = float(np.sqrt(np.mean([J**2 for J in drag.slopes])))
    probabilities = []
    for share in (0.5, 2.0):
        # The mean recording with an effect of this size, without its noise.
        change = tuple(share * seen / size * J[..., 0] for J in drag.slopes)
        near = [dataclasses.replace(m, residuals=change, at=np.zeros(len(m.at))) for m in (nothing, drag)]
        probabilities.append(weighed(data, *near).candidates()[0]["drag"])
    assert probabilities[0] < 0.5
    assert probabilities[1] > 0.95


def test_what_is_too_weak_is_spread_over_two_decades_about_the_width_of_the_prior():
    data, nothing, drag = recorded(0.0, 12)
    still = infer(data, nothing)
    (J,) = [np.concatenate([one.ravel() for one in drag.slopes])]
    seen = limit(data, still, drag.slopes, 1.0, 10) / float(np.sqrt(np.mean(J**2)))  # multiple of the response

    def told(*responses: tuple[str, float], effects: tuple[str, ...] = ("drag",)) -> float:
        changes = tuple(np.concatenate([r * J for _, r in responses], -1) for J in drag.slopes)
        owners = tuple(name for name, _ in responses)
        empty = np.zeros((0, 0))
        tells = Isolability(
            effects=effects, quantities=(), detectable=empty, cosines=empty, changes=changes, owners=owners
        )
        return too_weak(data, still, tells, 1.0, 10)

    # A response of which a multiple of STRENGTH is just seen is in the middle.
    middle = seen / STRENGTH
    assert told(("drag", middle)) == pytest.approx(0.5)
    assert told(("drag", middle / 3)) == pytest.approx(0.5 + math.log10(3) / 2)
    assert told(("drag", middle * 100)) == 0.0 and told(("drag", middle / 100)) == 1.0
    # Of an effect that acts in several ways the median counts, and one that moves nothing is never seen.
    assert told(("drag", middle), ("drag", middle * 100), ("drag", middle / 100)) == pytest.approx(0.5)
    assert told(("drag", middle), effects=("drag", "leak")) == pytest.approx(0.75)


def test_remedies_name_what_hides_an_effect():
    data, nothing, drag = recorded(0.0, 13)
    wanted = max(MATTERS * data.size, VISIBLE * data.noise)
    still = infer(data, nothing)
    kappa = next(k for k in np.geomspace(1, 1e6, 100) if limit(data, still, drag.slopes, k, 10) > 1.5 * wanted)
    found = remedies(data, still, drag.slopes, float(kappa), 10)
    assert found["twin"] == 2.0  # kappa is of the twin's error
    assert found["trials"] == 4.0
    # What matters grows with the motion, but is no less than what is seen by eye; and falls with the noise likewise.
    now = limit(data, still, drag.slopes, float(kappa), 10)
    assert found["motion"] == next(f for f in FACTORS if now <= max(f * MATTERS * data.size, VISIBLE * data.noise))


def test_less_noise_is_advised_where_it_makes_what_matters_then_visible():
    data, nothing, drag = recorded(0.0, 13)
    still = infer(data, nothing)

    def told(noise):
        return limit(dataclasses.replace(data, noise=noise), still, drag.slopes, kappa, 10)

    def matters(noise):
        return max(MATTERS * data.size, VISIBLE * noise)

    kappa = 1.0
    while told(data.noise) <= 1.5 * matters(data.noise):
        kappa *= 1.1
    # With half of the noise half as much would be seen, but half as much would matter, too.
    factor = remedies(data, still, drag.slopes, kappa, 10).get("noise", math.inf)
    assert factor > 2
    for other in FACTORS:
        assert (told(data.noise / other) <= matters(data.noise / other)) == (other >= factor)
