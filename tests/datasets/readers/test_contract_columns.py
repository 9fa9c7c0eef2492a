"""Tables with the columns of the log folder: which channel a column is of."""

from __future__ import annotations

from pathlib import Path

import pytest

from terrafusion.datasets.readers import open_recording

ANGLES = "front_left_rad,front_right_rad,rear_left_rad,rear_right_rad"
COLUMNS = {
    f"{ANGLES.replace('_rad', '_radps')},{ANGLES}": "wheels",
    f"{ANGLES.replace('_rad', '_mps')},{ANGLES}": "wheels",
    ANGLES: "steering",
    "v_mps,yaw_rate_radps": "command",
    "x_m,y_m,u_mps,v_mps,w_mps,p_radps,q_radps,r_radps": "truth",
}
"""Columns of one file of the log folder, and the channel that they are of."""


@pytest.mark.parametrize("columns", COLUMNS)
def test_a_column_that_two_channels_have_goes_with_those_beside_it(tmp_path: Path, columns: str) -> None:
    cells = ",".join(f"{k / 8}" for k in range(columns.count(",") + 1))
    path = tmp_path / "drive.csv"
    path.write_text(f"t_s,{columns}\n0,{cells}\n1,{cells}\n")
    recording = open_recording(path)
    held = [*recording.channels(), *(["truth"] if recording.truth is not None else [])]
    assert held == [COLUMNS[columns]]
    wheels = recording.wheels
    if wheels is not None:
        assert wheels.angle_rad is not None
        assert wheels.angle_rad[0].tolist() == [0.5, 0.625, 0.75, 0.875]
