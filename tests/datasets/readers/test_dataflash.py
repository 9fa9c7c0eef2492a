"""DataFlash logs of ArduPilot."""

from pathlib import Path

import numpy as np
import pytest

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recording
from tests.datasets import dataflash_files as files


@pytest.mark.parametrize("first_side", ["left", "right"])
def test_a_log_is_read_in_body_axes_units_and_utc(tmp_path: Path, first_side: str) -> None:
    (path := tmp_path / "00000012.BIN").write_bytes(files.log(first_side))
    log = open_recording(path)
    # 302 418 s into GPS week 2312 are 12:00:18 on 1 May 2024 in GPS time, 18 s ahead of UTC
    assert log.start_ns + 5 * 10**9 == 1_714_564_800_000_000_000
    assert log.imu is not None
    assert log.imu.t_ns[0] == 1_714_564_800_000_000_000
    assert len(log.imu) == 500  # of the first of two
    assert log.imu.gyro_radps[0] == pytest.approx([0.1, -0.2, -0.3])
    assert log.imu.accel_mps2[0] == pytest.approx([1.0, -2.0, 9.8])
    assert log.wheels is not None
    assert (log.wheels.names, log.wheels.unit) == (("left", "right"), "radps")
    np.testing.assert_allclose(log.wheels.speed[5], [1 / files.RADIUS_M, 2 / files.RADIUS_M], rtol=1e-5)
    assert (log.overrides.track_m, log.overrides.wheel_radius_m) == pytest.approx((0.5, 0.1))
    assert log.gnss is not None
    assert (len(log.gnss), set(log.gnss.fix.tolist())) == (90, {Fix.FIXED})
    assert log.gnss.sigma_enu_m[0] == pytest.approx([0.02, 0.02, 0.04])
    assert log.gnss.velocity_enu_mps is not None
    assert log.gnss.velocity_enu_mps[0] == pytest.approx([np.sqrt(0.5), np.sqrt(0.5), 0.25])
    assert log.datum is not None
    assert log.datum == pytest.approx((48.0000064, 11.0, 500.0), abs=1e-7)
    assert "gnss: 10 of 100 GPS messages hold no fix; left out" in log.notes


def test_without_encoders_or_their_places_no_wheels_are_made(tmp_path: Path) -> None:
    whole = files.log()
    (path := tmp_path / "log.bin").write_bytes(whole.replace(b"WENC2_POS_Y", b"WENC2_POS_X"))
    assert open_recording(path).wheels is None
    assert any("give no left and right wheel" in note for note in open_recording(path).notes)
    path.write_bytes(whole.replace(files.described("WENC"), b""))
    log = open_recording(path)
    assert log.wheels is None
    assert any("no encoders are in the log" in note for note in log.notes)
    assert any("bytes are of no complete message; left out" in note for note in log.notes)


def test_a_cut_log_is_read_to_its_end(tmp_path: Path) -> None:
    (path := tmp_path / "log.bin").write_bytes(files.log()[:-50])
    log = open_recording(path)
    assert len(log.channels()["imu"]) == 499
    assert any(" bytes are of no complete message" in note for note in log.notes)


@pytest.mark.parametrize(
    ("form", "fields"),
    [("QBfffffw", ""), ("QBfffff", ""), ("", "TimeUS,I,GyrX,GyrX,GyrZ,AccX,AccY,AccZ"),
     ("", "TimeMS,I,a,b,c,d,e,f"), ("QBfffffB", "")],
)  # fmt: skip
def test_messages_that_do_not_fit_their_description_are_refused(
    tmp_path: Path, form: str, fields: str
) -> None:
    broken = files.log().replace(files.described("IMU"), files.described("IMU", form, fields))
    (tmp_path / "log.bin").write_bytes(broken)
    with pytest.raises(DataError, match="do not fit their format"):
        open_recording(tmp_path / "log.bin")


def test_a_log_without_sensors_is_refused(tmp_path: Path) -> None:
    (tmp_path / "log.bin").write_bytes(files.log(seconds=0))
    with pytest.raises(DataError, match="neither IMU, GPS nor WENC messages; set LOG_BITMASK"):
        open_recording(tmp_path / "log.bin")
