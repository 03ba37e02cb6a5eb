"""What to measure: the options of ``recipes/benchmark.py``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

# Imported where they are used: the command line lists the options without them.
if TYPE_CHECKING:
    import torch

    from torchsoro.benchmark.timing import Case

SECTIONS = ("naive", "table", "engines", "where", "host", "rollout", "bits", "auto-dt", "five", "compile")
Section = Literal["naive", "table", "engines", "where", "host", "rollout", "bits", "auto-dt", "five", "compile"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Measure the speed of the simulator: naive step, table of sizes and where the time goes, and what is asked for."""

    preset: Literal["desk", "paper"] = "desk"
    """What to measure; "paper" adds its whole rollout (twice, for the bits), five elements, and what is required."""
    formulation: Literal["both", "updated", "total"] = "both"
    """Formulations to measure."""
    only: tuple[Section, ...] = ()
    """Measure these sections and no others, whatever the switches below say."""
    particles: tuple[int, ...] = ()
    """Sizes of the table; 2,000 to 16,384 on a CPU and 16,384 to 2,000,376 on CUDA if empty."""
    size: int | None = None
    """Size of all other sections; 64,000 on CUDA or with "paper", else 4,096."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where; auto takes CUDA if there is one."""
    table_steps: int = 500
    """Substeps of a run, but for the whole rollout."""
    steps: int | None = None
    """Substeps of the whole rollout (with bits and auto-dt); 75,000 with "paper", else 3,000."""
    elements: int = 3
    """Maxwell elements."""
    repeats: int = 3
    """Repetitions of which the best counts; the whole rollout runs once."""
    five: bool = False
    """Also the cost of five Maxwell elements against three."""
    bits: bool = False
    """Also whether two rollouts with their gradients have equal bits."""
    auto_dt: bool = False
    """Also the rollout with the largest stable step, and how far its L and gradient are from the small step's."""
    compile: bool = False
    """Also the compilation, in fresh processes."""
    json: Path | None = None
    """File for all numbers."""

    @property
    def target(self) -> torch.device:
        """Where to compute."""
        import torch

        auto = "cuda" if torch.cuda.is_available() else "cpu"
        return torch.device(auto if self.device == "auto" else self.device)

    @property
    def formulations(self) -> tuple[Literal["updated", "total"], ...]:
        """Which to measure."""
        return ("updated", "total") if self.formulation == "both" else (self.formulation,)

    @property
    def sections(self) -> tuple[str, ...]:
        """What to measure, in order."""
        paper = self.preset == "paper"
        on = {
            "naive": True,
            "table": True,
            "engines": False,
            "where": True,
            "host": paper,
            "rollout": paper,
            "bits": paper or self.bits,
        }
        on |= {"five": paper or self.five, "auto-dt": self.auto_dt, "compile": self.compile}
        return tuple(name for name in SECTIONS if (name in self.only if self.only else on[name]))

    def case(self, formulation: str, **changes: Any) -> Case:
        """A run of the size that is not the table's."""
        from torchsoro.benchmark.timing import Case

        large = self.target.type == "cuda" or self.preset == "paper"
        plain: dict[str, Any] = {"count": self.size or (64_000 if large else 4096), "steps": self.table_steps}
        fixed = {"formulation": formulation, "device": self.target, "elements": self.elements}
        return Case(**(plain | fixed | changes))
