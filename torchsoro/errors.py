"""The error of a simulation that breaks down, and the refusal of gradients that do not exist."""

from __future__ import annotations

import functools


class SimulationDiverged(RuntimeError):
    """A simulation left the range in which its equations mean anything.

    The message names the step, the time, the particle and what to change, for example::

        step 1234 (t = 12.34 ms): particle 567 of simulation 0: J <= 0 (J = -0.2). Try: a smaller time step.

    Args:
        step: Substep at which the quantity was seen, counted from the start of the simulation.
        time: Simulated time of that step in s.
        particle: Index of the particle, or None when no single particle is to blame.
        quantity: What went wrong, with the value seen, for example ``"J <= 0 (J = -0.2)"``.
        batch: Index of the simulation in the leading batch.
        remedy: What the caller can change, as a phrase that follows "Try: ".
    """

    def __init__(
        self, *, step: int, time: float, particle: int | None, quantity: str, batch: int = 0, remedy: str
    ) -> None:
        self.step = step
        self.time = time
        self.particle = particle
        self.quantity = quantity
        self.batch = batch
        self.remedy = remedy
        where = f"simulation {batch}" if particle is None else f"particle {particle} of simulation {batch}"
        super().__init__(f"step {step} (t = {1e3 * time:.6g} ms): {where}: {quantity}. Try: {remedy.rstrip('.')}.")

    def __reduce__(self) -> tuple[functools.partial[SimulationDiverged], tuple[()]]:
        """Rebuild from the keywords: the default would hand the message to a keyword-only constructor."""
        keywords = {name: getattr(self, name) for name in ("step", "time", "particle", "quantity", "batch", "remedy")}
        return functools.partial(type(self), **keywords), ()


def refuse_gradients(**numbers: object) -> None:
    """Refuse a tensor that requires a gradient where a plain number is wanted, which has none.

    Args:
        **numbers: What was given, by the name of the argument; sequences are looked through.

    Raises:
        ValueError: naming the argument.
    """
    for name, value in numbers.items():
        for one in value if isinstance(value, list | tuple) else (value,):
            if getattr(one, "requires_grad", False):
                raise ValueError(f"{name} = {one}: requires a gradient, wanted a number, by which there is none")
