"""What every command line shares: errors told in a line."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator

from torchsoro.errors import SimulationDiverged


@contextlib.contextmanager
def plain_errors() -> Iterator[None]:
    """End the process with a line instead of a traceback: on bad input, a simulation that diverged, and Ctrl-C."""
    try:
        yield
    except (ValueError, SimulationDiverged) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2 if isinstance(error, ValueError) else 1) from error
    except KeyboardInterrupt:
        raise SystemExit(130) from None
