"""Maxwell elements by pyvisco (github.com/NREL/pyvisco), to compare with; ``material_checks.py`` prints them."""

from __future__ import annotations

import contextlib
import io
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from torchsoro.rheology.measured import Sweep
from torchsoro.rheology.spectrum import Spectrum


def pyvisco_fits(curve: Sweep) -> list[tuple[str, Spectrum, float]]:
    """Fits by pyvisco of a master curve in tension: one term per decade, the same optimised, its proposed number.

    Returns:
        How it was fitted, the spectrum, and the time that it took [s].

    Raises:
        ModuleNotFoundError: without pyvisco.
    """
    import pyvisco as pv  # pyright: ignore[reportMissingImports]  # an extra

    def spectrum(found: Any) -> Spectrum:
        terms = found["df_terms"]
        order = np.argsort(terms["tau_i"].to_numpy())
        share, times = terms["alpha_i"].to_numpy()[order], terms["tau_i"].to_numpy()[order]
        instantaneous = 1e6 * found["E_0"]
        return Spectrum(
            equilibrium=max(instantaneous * (1 - share.sum()), 0.0),
            moduli=instantaneous * share,
            times=times,
            deformation="tension",
        )

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        file = Path(folder) / "master.csv"
        rows = np.column_stack([curve.omega / (2 * np.pi), curve.storage / 1e6, curve.loss / 1e6])
        np.savetxt(file, rows, delimiter=",", header="f,E_stor,E_loss\nHz,MPa,MPa", comments="", fmt="%.17g")
        data, _ = pv.load.user_master(pv.load.file(str(file)), "freq", curve.temperature, "E")
        data = pv.master.smooth(data, 1)  # window of one point: no smoothing
        found = []
        begin = time.perf_counter()
        plain, _ = pv.prony.fit(pv.prony.discretize(data), data, opt=False)
        found.append(("one per decade", spectrum(plain), time.perf_counter() - begin))
        begin = time.perf_counter()
        optimised, _ = pv.prony.fit(pv.prony.discretize(data), data, opt=True)
        found.append(("one per decade, optimised", spectrum(optimised), time.perf_counter() - begin))
        begin = time.perf_counter()
        series, proposed, _ = pv.opt.nprony(data, plain, window="min", opt=1.5)
        found.append(("the number it proposes", spectrum(series[proposed]), time.perf_counter() - begin))
    return found
