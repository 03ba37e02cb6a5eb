"""Threshold that erodes and dilates a design, from the least thickness of its walls and gaps.

The intermediate, the eroded and the dilated design are projections of the same filtered design variable phi~, with
thresholds 0, eta and -eta (Wang, Lazarov and Sigmund 2011). A wall thinner than a length b vanishes in the eroded
design and a gap narrower than b in the dilated one; a design whose performance needs neither is good in all three.

The filter relates eta to b. Its weights (1 - r/R)^3 within a radius R, integrated over planes, leave the share

    T(x) = 3 (1 - x/R)^5 - 2 (1 - x/R)^6

farther than x from a plane through the centre. For a plate with phi = 1 within a width w and -1 elsewhere, phi~ in the
middle is 1 - 2 T(w/2), which is the threshold eta at which the plate vanishes; its thickness b in the intermediate
design is that of the region where phi~ > 0. Rods and balls lose more in the filter: those that survive erosion are
thicker than b.
"""

from __future__ import annotations

from scipy.optimize import root_scalar


def threshold_of(radius: float, feature: float) -> float:
    """Threshold eta at which a plate of thickness ``feature`` in the intermediate design vanishes.

    Args:
        radius: Of the filter, R [m].
        feature: Least thickness of walls and gaps, b [m].

    Returns:
        From 0 for a thickness of 0 to 1 for one of 2 R.

    Raises:
        ValueError: if ``feature`` is not between 0 and 2 R.
    """
    if not 0 < feature < 2 * radius:
        raise ValueError(
            f"feature = {feature:g} m: wanted above 0 and below twice the filter radius, {2 * radius:g} m: no "
            "threshold erodes a thicker plate"
        )

    def beyond(x: float) -> float:
        near = max(1 - x / radius, 0.0)
        return 3 * near**5 - 2 * near**6

    def within(x: float) -> float:
        """Share of the weights on one side of a plane at a distance x."""
        return 1 - beyond(x) / 2 if x >= 0 else beyond(-x) / 2

    def filtered(width: float, x: float) -> float:
        return 2 * (within(x + width / 2) - within(x - width / 2)) - 1

    # The filter makes a plate thinner: w is above b.
    width = root_scalar(lambda w: filtered(w, feature / 2), bracket=(feature, feature + 2 * radius)).root
    return 1 - 2 * beyond(width / 2)
