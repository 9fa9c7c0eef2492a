"""`convert --apply-fixes`: each repair is printed and noted, and the repaired log replays."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from terrafusion.datasets.readers import open_recording

pytestmark = pytest.mark.usefixtures("quick", "no_report")

ACCEL = ("accel_x_mps2", "accel_y_mps2", "accel_z_mps2")


@pytest.fixture
def log(good_log: Path, tmp_path: Path) -> Path:
    """A copy of the good log, to be corrupted."""
    return shutil.copytree(good_log, tmp_path / "log")


def corrupt(log: Path, channel: str, columns: tuple[str, ...], factor: float) -> None:
    """Multiply columns of a channel."""
    table = pd.read_csv(log / f"{channel}.csv")
    table[list(columns)] *= factor
    table.to_csv(log / f"{channel}.csv", index=False)


def set_back(log: Path, channel: str, after_s: float, by_s: float) -> None:
    """Set the clock of a channel back by some seconds."""
    table = pd.read_csv(log / f"{channel}.csv")
    table["t_s"] -= np.where(table["t_s"] > after_s, by_s, 0.0)
    table.to_csv(log / f"{channel}.csv", index=False, float_format="%.9f")


def test_repairs_are_printed_and_noted(log: Path, good_log: Path, terrafusion) -> None:
    corrupt(log, "imu", ACCEL, 1 / 9.80665)
    outcome = terrafusion("convert", "log", "out", "--apply-fixes")
    assert (outcome.status, outcome.err) == (0, "")
    lines = [line for line in outcome.out.splitlines() if line.startswith("repaired: ")]
    assert len(lines) == 1
    assert lines[0].startswith("repaired: accel-in-g, imu: ")
    assert "9.80665" in lines[0]
    assert "error" not in outcome.out
    repaired, good = open_recording("out"), open_recording(good_log)
    assert repaired.imu is not None
    assert good.imu is not None
    np.testing.assert_allclose(repaired.imu.accel_mps2, good.imu.accel_mps2, rtol=1e-9)
    assert any("repaired" in note and "accel" in note for note in repaired.notes)
    assert "no findings" in terrafusion("inspect", "out").out
    assert terrafusion("replay", "out", "--out", "results").status == 0


def test_nothing_is_changed_unasked(log: Path, terrafusion) -> None:
    corrupt(log, "imu", ACCEL, 1 / 9.80665)
    outcome = terrafusion("convert", "log", "copy")
    assert (outcome.status, outcome.err) == (0, "")
    assert "error: accel-in-g, imu: " in outcome.out
    assert "--apply-fixes repairs it" in outcome.out
    before, after = open_recording("log"), open_recording("copy")
    assert before.imu is not None
    assert after.imu is not None
    np.testing.assert_array_equal(before.imu.accel_mps2, after.imu.accel_mps2)


def test_unrepaired_findings_are_reported(log: Path, terrafusion) -> None:
    table = pd.read_csv(log / "imu.csv")
    table["accel_z_mps2"] *= 0.5
    table.to_csv(log / "imu.csv", index=False)
    outcome = terrafusion("convert", "log", "out", "--apply-fixes")
    assert outcome.status == 0
    assert "repaired: " not in outcome.out
    remaining = next(
        line for line in outcome.out.splitlines() if line.startswith("error: accel-magnitude, imu")
    )
    assert remaining.endswith("[remains: the correct values are unknown]")
    assert terrafusion("replay", "out", "--out", "results").refused("m/s2, not 9.8")


def test_a_log_without_gravity_is_replayed_by_its_gyro(log: Path, terrafusion) -> None:
    table = pd.read_csv(log / "imu.csv")
    table["accel_z_mps2"] -= 9.80665
    table.to_csv(log / "imu.csv", index=False)
    assert terrafusion("replay", "log", "--out", "results").refused(
        "gravity has been removed", "--apply-fixes"
    )
    assert terrafusion("convert", "log", "out", "--apply-fixes").status == 0
    assert terrafusion("replay", "out", "--out", "results").status == 0


def test_a_refused_replay_names_the_remedy(log: Path, terrafusion) -> None:
    corrupt(log, "imu", ACCEL, 1 / 9.80665)
    refusal = terrafusion("replay", "log", "--out", "results")
    assert refusal.refused("imu", "`terrafusion convert log OUT --apply-fixes`")
    words = refusal.err.split("`terrafusion ")[1].split("`")[0].split()
    assert terrafusion(*(word.replace("OUT", "out") for word in words)).status == 0
    assert terrafusion("replay", "out", "--out", "results").status == 0


def test_repairing_a_good_log_changes_nothing(good_log: Path, terrafusion) -> None:
    outcome = terrafusion("convert", good_log, "same", "--apply-fixes")
    assert (outcome.status, outcome.err) == (0, "")
    assert "repaired" not in outcome.out
    for path in good_log.glob("*.csv"):
        assert (Path("same") / path.name).read_bytes() == path.read_bytes()


def test_a_clock_set_back(log: Path, terrafusion) -> None:
    """`inspect` shows it, `convert` and `replay` take it out where that is asked for."""
    set_back(log, "imu", after_s=12.0, by_s=3.0)
    assert "[clock-jump]" in terrafusion("inspect", "log").out
    assert terrafusion("convert", "log", "copy").refused("imu", "time runs backwards", "--repair-clock")
    assert terrafusion("replay", "log", "--out", "results").refused(
        "imu", "time runs backwards", "--repair-clock"
    )
    for option in ("--repair-clock", "--apply-fixes"):
        outcome = terrafusion("convert", "log", f"with{option}", option)
        assert (outcome.status, outcome.err) == (0, ""), outcome
        repaired = open_recording(f"with{option}")
        assert repaired.imu is not None
        assert (np.diff(repaired.imu.t_ns) > 0).all()
        assert any("imu" in note and "3" in note for note in repaired.notes)
    assert terrafusion("replay", "log", "--out", "results", "--repair-clock").status == 0
