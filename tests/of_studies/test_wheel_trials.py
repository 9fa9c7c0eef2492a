"""Single-wheel trials: the published file against physics, synthetic and damaged files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from terrafusion.datasets.core.errors import DataError
from tests.studies.twin_field import wheel_trials
from tests.studies.twin_field.wheel_trials import FIELDS, TRIALS_FILE, WheelTrials, read_wheel_trials

COUNT = 12
DTYPE = [(name, object) for name in [*sorted(FIELDS), "polyx"]]


@pytest.fixture
def smooth() -> Path:
    root = os.environ.get("TERRAFUSION_DATA")
    if not root:
        pytest.skip("TERRAFUSION_DATA is not set: the single-wheel trials are not at hand")
    return Path(root) / TRIALS_FILE


def raw_trials() -> np.ndarray:
    """Trials in the file's axes and units: side force x, resistance y, pull-down z, mm, mm/s, degrees."""
    trials = np.zeros((COUNT, 1), dtype=DTYPE)
    for k in range(COUNT):
        rim, beta = (3.0, 10.0, 40.0)[k % 3], 15.0 * (k // 3)
        slip = (rim - 10.0) / max(rim, 10.0)
        values = {
            "Fx": 30.0 * np.sin(np.radians(beta)),
            "Fy": -20.0 * slip,
            "Fz": -21.0,
            "Vx": 10.0,
            "Vry": rim,
            "angle": beta,
            "Z": -25.0 - k,
        }
        cells = {f"avg_{n}": v for n, v in values.items()} | {f"std_{n}": 0.1 for n in values}
        cells |= {"Vry": rim, "beta": beta, "trial_num": 1 + k % 2, "slip": slip}
        for name, value in cells.items():
            trials[k, 0][name] = np.array([[value]])
        trials[k, 0]["polyx"] = np.array([[0.5, 1.0]], dtype=np.float32)
    return trials


def save(path: Path, trials: Any, name: str = "all_results", **options: Any) -> Path:
    scipy.io.savemat(path, {"before": np.arange(5.0), name: trials}, **options)
    return path


# --- the published file ------------------------------------------------------------------------------------


def test_the_published_trials(smooth: Path) -> None:
    trials = read_wheel_trials(smooth)
    summary = trials.summary()
    assert (summary["trials"], summary["braked"], summary["driven"]) == (189, 84, 84)
    assert summary["slip"] == (-1.0, pytest.approx(0.9, abs=1e-3))
    assert trials.notes == ()
    degrees = np.degrees(np.array(summary["commanded_side_slip_rad"]))
    np.testing.assert_allclose(degrees, [0, 15, 30, 45, 60, 75, 90])
    assert np.abs(trials.side_slip_rad - trials.commanded_side_slip_rad).max() < np.radians(1.0)
    np.testing.assert_allclose(trials.travel_speed_mps, 0.01, atol=3e-5)


def axes_checks(t: WheelTrials) -> dict[str, bool]:
    """What soil does to a wheel: true in the wheel's axes only."""
    straight, broadside = t.commanded_side_slip_rad == 0.0, t.commanded_side_slip_rad > 1.5
    return {
        "a spinning wheel pulls": bool(t.tractive_force_n[straight & (t.slip > 0.7)].min() > 0.0),
        "a locked wheel drags": bool(t.tractive_force_n[straight & (t.slip < -0.9)].max() < -10.0),
        "no side force straight ahead": bool(np.abs(t.side_force_n[straight]).max() < 3.0),
        "side force against the side-slip": bool(t.side_force_n[broadside].min() > 20.0),
        "the load presses": bool(t.load_n.min() > 0.0),
        "friction": bool(np.all(np.hypot(t.tractive_force_n, t.side_force_n) < 4.0 * t.load_n)),
        "it sinks": bool(t.sinkage_m.min() > 0.0 and t.sinkage_m.max() < 0.1),
    }


def test_axes_and_signs(smooth: Path) -> None:
    assert all(axes_checks(read_wheel_trials(smooth)).values())


def test_axes_as_the_file_has_them_are_seen(smooth: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, check in (("Fy", "a locked wheel drags"), ("Fz", "the load presses"), ("Z", "it sinks")):
        with monkeypatch.context() as patch:
            *words, factor = wheel_trials._QUANTITIES[name]
            flipped = wheel_trials._QUANTITIES | {name: (*words, -factor)}
            patch.setattr(wheel_trials, "_QUANTITIES", flipped)
            assert not axes_checks(read_wheel_trials(smooth))[check]


# --- synthetic files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("name", ["all_results", "grouser_results"])
def test_synthetic_trials(tmp_path: Path, compressed: bool, name: str) -> None:
    path = save(tmp_path / "any.dat", raw_trials(), name, do_compression=compressed)
    trials = read_wheel_trials(path)
    assert len(trials) == COUNT
    np.testing.assert_allclose(trials.tractive_force_n, 20.0 * trials.slip)
    np.testing.assert_allclose(trials.side_force_n, 30.0 * np.sin(trials.side_slip_rad))
    np.testing.assert_allclose(trials.load_n, 21.0)
    np.testing.assert_allclose(trials.sinkage_m, 0.025 + 0.001 * np.arange(COUNT))
    np.testing.assert_allclose(trials.rim_speed_mps, np.tile([0.003, 0.01, 0.04], 4))
    assert trials.trial.tolist() == [1, 2] * 6
    assert list(trials.columns())[:3] == ["slip", "side_slip_rad", "tractive_force_n"]


def test_slip_that_its_speeds_do_not_give(tmp_path: Path) -> None:
    trials = raw_trials()
    trials[4, 0]["slip"] = np.array([[0.5]])
    notes = read_wheel_trials(save(tmp_path / "any.mat", trials)).notes
    assert notes == ("slip: off the speeds by up to 0.50, in 1 of 12 trials",)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, np.zeros((0, 0)), np.ones((1, 2)), "text"])
def test_trials_that_lack_a_number(tmp_path: Path, value: Any) -> None:
    trials = raw_trials()
    trials[7, 0]["avg_Fx"] = np.atleast_2d(value) if not isinstance(value, str) else value
    with pytest.raises(DataError, match="avg_Fx: trial 7"):
        read_wheel_trials(save(tmp_path / "any.mat", trials))


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.mat"
    scipy.io.savemat(path, {"x": np.zeros(3), "s": {"a": 1.0}})
    with pytest.raises(DataError, match="holds no structures with"):
        read_wheel_trials(path)
    with pytest.raises(DataError, match="no such file"):
        read_wheel_trials(tmp_path / "none.mat")
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM" + bytes(range(200)))
    with pytest.raises(DataError, match="the MATLAB file cannot be read"):
        read_wheel_trials(path)


def test_no_trials(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="holds no trials"):
        read_wheel_trials(save(tmp_path / "any.mat", raw_trials()[:0]))
