"""`--rerun`: the replay on its two timelines; without the package one line tells the remedy."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.reports.rerun_log import require_rerun, write_rerun


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ConfigError, match=r"rerun-sdk is not installed.*terrafusion\[rerun\]") as error:
        require_rerun()
    assert "\n" not in str(error.value)


def test_the_command_refuses_before_it_computes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, terrafusion: Any
) -> None:
    """The log does not even exist: the missing package is told first, and nothing is written."""
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log").mkdir()
    outcome = terrafusion("replay", "log", "--out", "results", "--rerun", "a.rrd")
    assert outcome.status == 1
    assert outcome.err.count("\n") == 1
    assert "terrafusion[rerun]" in outcome.err
    assert [p.name for p in tmp_path.iterdir()] == ["log"]


@pytest.fixture
def chunks(drive: Any, tmp_path: Path) -> tuple[Any, dict[str, Any]]:
    """The drive, and what the SDK reads from the file, by entity."""
    pytest.importorskip("rerun", reason="the extra 'rerun' is not installed")
    from rerun.chunk import RrdReader

    d = drive(seconds=60.0)
    result = SimpleNamespace(
        recording=d.recording,
        mode="adaptive",
        estimate=d.estimate,
        outages=(Outage(20.0, 10.0),),
        used=d.fixes,
        held_out=None,
    )
    path = write_rerun(result, tmp_path / "a.rrd")  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == [path]
    found: dict[str, Any] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        found.setdefault(str(chunk.entity_path), []).append(chunk)
    return d, found


def values(chunks: list[Any], column: str) -> np.ndarray:
    parts = [np.array(chunk.to_record_batch().column(column).to_pylist()) for chunk in chunks]
    return np.concatenate(parts)


def test_numbers_stand_at_their_times(chunks: Any) -> None:
    d, found = chunks
    estimate, start = d.estimate, d.recording.start_ns
    for name, expected in (
        ("/slip/mean", estimate.slip),
        ("/weights/gyro_inflation", estimate.weights["gyro_inflation"]),
        ("/terrain/mud", estimate.terrain[:, 2]),
    ):
        np.testing.assert_array_equal(values(found[name], "Scalars:scalars")[:, 0], expected)
    batch = found["/slip/mean"][0].to_record_batch()
    elapsed = batch.column("elapsed").cast("int64").to_numpy()
    stamp = batch.column("stamp").cast("int64").to_numpy()
    np.testing.assert_array_equal(elapsed, estimate.trajectory.t_ns - start)
    np.testing.assert_array_equal(stamp, estimate.trajectory.t_ns)


def test_the_body_moves_along_the_path(chunks: Any) -> None:
    d, found = chunks
    moved = values(found["/world/base_link"], "Transform3D:translation")[:, 0]
    np.testing.assert_allclose(moved, d.estimate.trajectory.position_m, rtol=1e-6, atol=1e-6)
    assert {"/world/path", "/world/truth", "/world/two_sigma", "/world/gnss/used"} <= found.keys()
    assert "/world/gnss/held_out" not in found
    refused = [i for i in d.estimate.innovations if not i.accepted]
    (drawn,) = values(found["/world/gnss/rejected"], "Points3D:positions")
    assert len(drawn) == len(refused) > 0


def test_events_tell_the_reasons(chunks: Any) -> None:
    d, found = chunks
    told = [str(text[0]) for text in values(found["/events"], "TextLog:text")]
    assert len(told) == len(d.estimate.changes) + 1
    assert any("loose_sand became likelier" in text for text in told)
    assert told[0].startswith("running: ")
