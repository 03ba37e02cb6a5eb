"""All numbers that decide what an explanation says, each with its reason or its measurement.

Everything else in the decision follows from them, from the noise of the recording, and from the twin's own error.
"""

from __future__ import annotations

CREDIBLE = 0.95  # posterior probability of the set of candidates that is told: odds of twenty to one, as is customary
MATTERS = 0.02  # of the motion: what is smaller is no reason to change a design, and bodies are built no better
VISIBLE = 3.0  # times the noise: what is larger is seen in a plot by eye, so that it must not be passed over
STRENGTH = 3.0  # noticeable changes (Quantity.scale): width of the prior of an effect that is missing
FREEDOM = 4.0  # degrees of freedom of priors that are not to be trusted in their tails: 10 widths are still credible
TOLERANCE = 0.5  # standard deviation of a belief over its stated tolerance, which thus holds in 95 of 100 setups
BELIEVED = 1.45  # tolerances by which a stated number may be off and still be credible: 2.9 standard deviations
MISSING = 0.5  # prior probability that something is missing; names share it evenly, a pair has 1/n of a name's share
COMMON = 0.5  # share of a discrepancy's variance that all markers have in common: bodies move in modes, not by markers
UNEXPLAINED = 0.2  # of the difference: what leaves more of it than a fifth, a twenty-fifth of its square, is another's

# Measured, not chosen (recipes/judge/track_record.py): of the 231 names that were most probable in the judge's sealed
# batches 18 and 20, the odds that one was wrong that left nothing, and by how much their logarithm grows with what is
# left over the root of the summed squares of the noise, the simulation's own error, and a tenth of what the name moves.
WRONG, WRONG_BY_LEFT = 0.11, 4.5
