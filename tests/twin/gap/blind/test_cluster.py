"""A blind check on a Dask cluster of two processes, killed in the middle, goes on and ends the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.twin import executors
from terrafusion.twin.gap.blind.answers import Pool, answered
from terrafusion.twin.gap.blind.check import run_blind_check
from terrafusion.twin.gap.blind.plan import CheckSize
from tests.twin.gap.blind import blind_answers as fake

pytest.importorskip("distributed", reason="distributed is not installed: pip install 'terrafusion[cluster]'")

from tests.twin.sweep.test_dask import scheduler, wait_for_workers, worker

SMALL = CheckSize(nulls=4, other_nulls=2, effects=1, other_effects=0, harder=0, outside=1, pairs=1)


def test_a_cluster_that_is_killed_in_the_middle_loses_no_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Answers that were given are kept, the others are asked for on the next cluster."""
    monkeypatch.setattr("terrafusion.twin.gap.blind.answers.cases", fake.short_cases)
    monkeypatch.setattr(executors, "WORKERLESS_S", 2.0)
    whole = run_blind_check(tmp_path / "whole", fake.slow_guess, scale=SMALL)
    out = tmp_path / "out"

    def check(address: str, progress: Any = None) -> dict[str, Any]:
        pool = Pool(jobs=2, backend="dask", address=address)
        return run_blind_check(out, fake.slow_guess, scale=SMALL, pool=pool, progress=progress)

    with scheduler(tmp_path) as address:
        with worker(address) as one, worker(address) as other:
            wait_for_workers(address, 2)

            def kill(share: float) -> None:
                for mortal in (one, other):
                    mortal.kill()

            with pytest.raises(TerrafusionError, match=r"no workers any more; start some: .* continues"):
                check(address, kill)
        kept = answered(out)
        assert 0 < len(kept) < whole["trials"]
        with worker(address), worker(address):
            wait_for_workers(address, 2)
            shares: list[float] = []
            scores = check(address, shares.append)
    assert shares[0] > len(kept) / whole["trials"]
    assert {t: answered(out)[t] for t in kept} == kept
    assert fake.without_times(scores) == fake.without_times(whole)
