"""How far an explanation is: a bar on a terminal, a line every ten seconds in a log."""

from __future__ import annotations

import sys
import time
from typing import TextIO

from tqdm import tqdm

# Guesses of each stage: its share of the time, and batches of simulations in it. Only the bar depends on them.
STAGES = {
    "comparing cell sizes": (0.10, 12),
    "simulating what each effect would change": (0.10, 2),
    "searching among the effects": (0.75, 60),
    "predicting trials and writing the report": (0.05, 6),
}
EVERY = 10.0  # s between two lines of a log


class Progress:
    """Stage, share that is done and time left.

    Args:
        stream: Where to; standard error if None. A bar on a terminal, lines elsewhere.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self.begin = self.told = time.perf_counter()
        self.name, self.done, self.share, self.batches, self.expected = "", 0.0, 0.0, 0, 1
        self.bar: tqdm | None = None
        if self.stream.isatty():
            form = "{desc}: {percentage:3.0f} % |{bar}| {postfix}"
            self.bar = tqdm(total=1.0, file=self.stream, bar_format=form, leave=False, dynamic_ncols=True)

    @property
    def fraction(self) -> float:
        """Share that is done, 0 to 1; grows."""
        # Approaches the end of a stage that takes more batches than expected.
        done = self.batches / self.expected
        return self.done + self.share * (0.8 * done if done < 1 else 1 - 0.2 / done)

    @property
    def left(self) -> float | None:
        """Time left, about [s]; None before there is something to go by."""
        spent, fraction = time.perf_counter() - self.begin, self.fraction
        return spent * (1 - fraction) / fraction if fraction > 0.02 else None

    def stage(self, name: str) -> None:
        """Begin a stage; the one before has ended."""
        self.done += self.share
        self.share, self.expected = STAGES[name]
        self.name, self.batches = name, 0
        self._show(now=True)

    def tick(self, _line: str = "") -> None:
        """A batch of simulations has ended."""
        self.batches += 1
        self._show()

    def note(self, text: str) -> None:
        """A line that stays."""
        tqdm.write(text, file=self.stream)

    def close(self) -> None:
        """Remove the bar."""
        if self.bar is not None:
            self.bar.close()

    def _show(self, now: bool = False) -> None:
        left = "" if self.left is None else f"about {span(self.left)} left"
        if self.bar is not None:
            self.bar.n = self.fraction
            self.bar.set_description_str(self.name, refresh=False)
            self.bar.set_postfix_str(left)
        elif now or time.perf_counter() - self.told > EVERY:
            self.told = time.perf_counter()
            print(f"{int(100 * self.fraction):3d} % {self.name}" + (f", {left}" if left else ""), file=self.stream)


def span(seconds: float) -> str:
    """A time in words that one would use."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
