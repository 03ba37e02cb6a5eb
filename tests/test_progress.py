"""How far an explanation says it is."""

from __future__ import annotations

import numpy as np
import pytest

from torchsoro.sim2real.progress import STAGES, Progress, span


def test_progress_in_a_log_grows_to_the_end_and_says_what_is_left(tmp_path, monkeypatch):
    clock = iter(np.arange(0.0, 1e5, 4.0))
    monkeypatch.setattr("torchsoro.sim2real.progress.time.perf_counter", lambda: float(next(clock)))
    with open(tmp_path / "log", "w") as stream:
        progress = Progress(stream)
        fractions = []
        for name, (_, batches) in STAGES.items():
            progress.stage(name)
            for _ in range(3 * batches):
                progress.tick()
                fractions.append(progress.fraction)
        progress.close()
    assert sum(share for share, _ in STAGES.values()) == pytest.approx(1.0)
    assert (np.diff(fractions) >= 0).all() and fractions[-1] < 1
    lines = (tmp_path / "log").read_text().splitlines()
    assert all(name in " ".join(lines) for name in STAGES) and " s left" in lines[-1]
    assert [span(v) for v in (40.0, 600.0, 7200.0)] == ["40 s", "10 min", "2.0 h"]


def test_time_left_follows_from_what_a_batch_has_still_to_simulate(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("torchsoro.sim2real.progress.time.perf_counter", lambda: now[0])
    with open(tmp_path / "log", "w") as stream:
        progress = Progress(stream)
        for name in list(STAGES)[:3]:
            progress.stage(name)
        for _ in range(60):  # of one simulated second and one second each
            progress.watch(1.0, 0.0)
            now[0] += 1
            progress.tick()
        before = progress.left
        assert 5 < before < 20
        progress.watch(600.0, 0.0)
        assert progress.left == pytest.approx(600 * 80 / 75, rel=0.1)
        now[0] += 300
        progress.watch(600.0, 0.5)
        fraction = progress.fraction
        assert 300 < progress.left < 400 and 0.4 < fraction < 0.9
        now[0] += 300
        progress.tick()
        assert progress.left < 150 and progress.fraction >= fraction
