"""Logs that name a vehicle file: it goes with them, and every command finds it from any folder."""

import dataclasses
import shutil
from pathlib import Path

import pytest
from ruamel.yaml import YAML
from typer.testing import CliRunner, Result

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_log_folder
from terrafusion.fusion.cli.main import app
from terrafusion.fusion.sensor_calibration import calibrate_sensors
from terrafusion.twin.model.choose import choose_vehicle
from terrafusion.twin.model.vehicle import load_vehicle

OWN = """robot:
  extends: base.yaml
  track_m: {value: 0.51, known: measured}
"""
BASE = """robot:
  extends: generic
  name: rover_9
  wheel_radius_m: {value: 0.175, known: measured}
"""


def run(*words: str | Path) -> Result:
    return CliRunner().invoke(app, [*map(str, words)])


@pytest.fixture
def workshop(chirp: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a log of an unnamed robot and its vehicle file, which extends another one."""
    place = tmp_path / "workshop"
    place.mkdir()
    write_log_folder(dataclasses.replace(chirp, vehicle=None, truth=None), place / "drive")
    (place / "own.yaml").write_text(OWN)
    (place / "base.yaml").write_text(BASE)
    monkeypatch.chdir(place)
    return place


def test_a_converted_log_is_moved_with_its_vehicle(
    workshop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = load_vehicle("own.yaml")
    assert run("convert", "drive", "fixed", "--vehicle", "own.yaml").exit_code == 0
    shutil.move(workshop / "fixed", tmp_path / "moved")
    for name in ("own.yaml", "base.yaml"):
        (workshop / name).unlink()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    again = write_log_folder(open_recording("../moved"), "again")  # the copy of a copy is whole, too
    for log in (tmp_path / "moved", again):
        chosen, _ = choose_vehicle(open_recording(log))
        assert chosen == known
    both = [open_recording(log) for log in (tmp_path / "moved", again)]
    assert calibrate_sensors(both).vehicle.name == "rover_9"  # two copies are one vehicle


def test_init_starts_from_the_vehicle_file_that_the_log_names(workshop: Path) -> None:
    assert run("convert", "drive", "fixed", "--vehicle", "own.yaml").exit_code == 0
    done = run("init", "fixed", "--out", "out/new.yaml", "--no-verdict")
    assert done.exit_code == 0, done.exception
    robot = YAML(typ="safe", pure=True).load(workshop / "out" / "new.yaml")["robot"]
    assert robot["extends"] == "../fixed/vehicle.yaml"
    assert load_vehicle("out/new.yaml").odometry.track_m == 0.51
    own = run("init", "fixed", "--out", "fixed/vehicle.yaml", "--force", "--no-verdict")
    assert "the new file extends it; give another --out" in str(own.exception)


def test_a_bag_names_the_file_by_its_absolute_path(workshop: Path) -> None:
    assert run("convert", "drive", "fixed.mcap", "--vehicle", "own.yaml").exit_code == 0
    assert open_recording("fixed.mcap").vehicle == str(workshop / "own.yaml")


def test_a_vehicle_file_that_is_gone_is_named_with_the_log(workshop: Path) -> None:
    meta = workshop / "drive" / "meta.yaml"
    meta.write_text(f"{meta.read_text()}vehicle: gone.yaml\n")
    for command in (("init", "drive"), ("replay", "drive")):
        done = run(*command, "--out", "out.yaml")
        assert str(done.exception) == (
            "chirp: the log names the vehicle file 'gone.yaml': no such file; "
            "correct the path in its meta.yaml, or give --vehicle FILE"
        )


def test_errors_of_a_draft_name_the_log_and_no_temporary_file(workshop: Path) -> None:
    meta = workshop / "drive" / "meta.yaml"
    meta.write_text(f"{meta.read_text()}wheel_radius_m: 0.015\n")  # below what a vehicle file takes
    done = run("init", "drive", "--out", "new.yaml")
    assert done.exit_code == 1
    assert str(done.exception).startswith("chirp: ")
    assert ".terrafusion-" not in str(done.exception)
