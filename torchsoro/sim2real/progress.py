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
FIRST = 0.02  # of the time left that has to have passed before it is told: the first batches say little
MORE = 0.1  # of the batches expected of a stage, that are still expected of one that has had as many


class Progress:
    """Stage, share that is done and time left.

    Args:
        stream: Where to; standard error if None. A bar on a terminal, lines elsewhere.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self.begin = self.told = self.since = time.perf_counter()
        self.name, self.done, self.share, self.batches, self.expected = "", 0.0, 0.0, 0, 1
        self.shown = self.ended = 0.0  # share of all; simulated time of the stage [s]
        self.size = self.running = 0.0  # simulated time of the batch at work [s], and how much of that is done
        self.bar: tqdm | None = None
        if self.stream.isatty():
            form = "{desc}: {percentage:3.0f} % |{bar}| {postfix}"
            self.bar = tqdm(total=1.0, file=self.stream, bar_format=form, leave=False, dynamic_ncols=True)

    @property
    def fraction(self) -> float:
        """Share that is done, 0 to 1; grows."""
        spent = time.perf_counter() - self.begin
        if spent > 0 and (left := self.left) is not None:
            self.shown = max(self.shown, spent / (spent + left))
        return self.shown

    @property
    def left(self) -> float | None:
        """Time left, about [s]; None before there is something to go by."""
        now = time.perf_counter()
        before, spent = self.since - self.begin, now - self.since
        simulated = self.ended + self.running
        if simulated > 0 or self.batches:
            at_work = spent / simulated * (self.size - self.running) if simulated > 0 else 0.0
            # A stage that takes more batches than expected goes on for a while.
            more = max(self.expected - self.batches, MORE * self.expected)
            left = at_work + more * spent / max(1, self.batches + self.running / (self.size or 1.0))
        elif self.done > 0:
            left = max(before * self.share / self.done - spent, 0.0)
        else:
            return None
        later = 1 - self.done - self.share
        left += (before + spent + left) * later / (1 - later)
        return left if before + spent > FIRST * left else None

    def stage(self, name: str) -> None:
        """Begin a stage; the one before has ended."""
        self.done += self.share
        self.share, self.expected = STAGES[name]
        self.name, self.batches, self.since = name, 0, time.perf_counter()
        self.ended = self.size = self.running = 0.0
        self._show(now=True)

    def tick(self, _line: str = "") -> None:
        """A batch of simulations has ended."""
        self.batches += 1
        self.ended, self.size, self.running = self.ended + self.size, 0.0, 0.0
        self._show()

    def watch(self, size: float, share: float) -> None:
        """Of a batch of so much simulated time [s] this share is done."""
        self.size, self.running = size, share * size
        self._show()

    def note(self, text: str) -> None:
        """A line that stays."""
        tqdm.write(text, file=self.stream)

    def close(self) -> None:
        """Remove the bar."""
        if self.bar is not None:
            self.bar.close()

    def _show(self, now: bool = False) -> None:
        fraction, seconds = self.fraction, self.left
        left = "" if seconds is None else f"about {span(seconds)} left"
        if self.bar is not None:
            self.bar.n = fraction
            self.bar.set_description_str(self.name, refresh=False)
            self.bar.set_postfix_str(left)
        elif now or time.perf_counter() - self.told > EVERY:
            self.told = time.perf_counter()
            print(f"{int(100 * fraction):3d} % {self.name}" + (f", {left}" if left else ""), file=self.stream)


def span(seconds: float) -> str:
    """A time in words that one would use."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
