"""How far a design is eroded and dilated, so that its walls and gaps have a least thickness.

A design is judged three times: as it is, eroded, and dilated, by thresholds 0, eta and -eta of the projection of the
filtered design variable phi~ (Wang, Lazarov and Sigmund 2011). A wall that is too thin is not there when eroded, a gap
that is too narrow not when dilated, and a design that is to do well in all three has neither.

How thin that is follows from the filter. Its weights (1 - r/R)^3 within a radius R, summed over the planes beside a
plate, leave beyond a distance x to both sides of a plane the share

    T(x) = 3 (1 - x/R)^5 - 2 (1 - x/R)^6 .

Of a plate of thickness w, phi = 1 within it and -1 elsewhere, the filtered variable in its middle is 1 - 2 T(w/2): with
that threshold it is just gone. As it is, it is as thick as where phi~ > 0. Rods and balls are filtered more, so that
those that are left when eroded are thicker.
"""

from __future__ import annotations

from scipy.optimize import root_scalar


def threshold_of(radius: float, feature: float) -> float:
    """Threshold eta with which a plate is just eroded that is ``feature`` thick as it is.

    Args:
        radius: Of the filter, R [m].
        feature: Least thickness of walls and gaps [m].

    Returns:
        Between 0, for no thickness at all, and 1, for that of the filter, 2 R.

    Raises:
        ValueError: if the feature is not above 0, or as wide as the filter.
    """
    if not 0 < feature < 2 * radius:
        raise ValueError(
            f"feature = {feature:g} m: wanted above 0 and below twice the filter radius, {2 * radius:g} m, of which a "
            "plate is no more told from the solid"
        )

    def beyond(x: float) -> float:
        near = max(1 - x / radius, 0.0)
        return 3 * near**5 - 2 * near**6

    def within(x: float) -> float:
        """Share of the weights on one side of a plane at a distance x."""
        return 1 - beyond(x) / 2 if x >= 0 else beyond(-x) / 2

    def filtered(width: float, x: float) -> float:
        return 2 * (within(x + width / 2) - within(x - width / 2)) - 1

    # Of the design variable: a plate that is thinner than the filter comes out thinner than it was.
    width = root_scalar(lambda w: filtered(w, feature / 2), bracket=(feature, feature + 2 * radius)).root
    return 1 - 2 * beyond(width / 2)
