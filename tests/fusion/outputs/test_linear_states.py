"""Linear states in the outputs: columns, metrics, report, diagnostics, and the switch of the command."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator
from typer.testing import CliRunner

from terrafusion.datasets.core.json_text import to_json
from terrafusion.datasets.core.robot import ANTENNA_SIGMA_M
from terrafusion.datasets.writers.log_folder import write_log_folder
from terrafusion.fusion.cli.main import app
from terrafusion.fusion.estimate.estimate import Estimate
from terrafusion.fusion.graph.key_state import CALIBRATION, LINEAR, ON_DEMAND
from terrafusion.fusion.graph.slow_states import CALIBRATION_SIGMA
from terrafusion.fusion.metrics.scores import score
from terrafusion.fusion.outputs.linear_states import QUANTITIES, calibration, cells, series
from terrafusion.fusion.outputs.replay_files import estimate_columns, metrics_of
from terrafusion.fusion.outputs.ros_estimate import written_estimate
from terrafusion.fusion.reports.plots.replay import plot_skid_steering
from terrafusion.fusion.reports.plots.sheet import Sheet
from terrafusion.fusion.reports.replay import write_report
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate
from tests.fusion.replayed import result_of

SCHEMA = Path(__file__).parents[3] / "docs" / "schemas" / "metrics.schema.json"
PRIOR = CALIBRATION_SIGMA | dict.fromkeys(("antenna_x_m", "antenna_y_m"), ANTENNA_SIGMA_M)
WANDERING = LINEAR[1 : LINEAR.index("radius_scale")]


def with_states(estimate: Estimate, calibrated: bool) -> Estimate:
    """States of 0.01, 0.02, ... as `LINEAR`; sigma: 0.4 of the prior's of the antenna, 0.9 of the others'."""
    n = len(estimate.trajectory)
    value = np.tile(0.01 * np.arange(1, len(LINEAR) + 1), (n, 1))
    sigma = np.full((n, len(LINEAR)), 0.05)
    for name, prior in PRIOR.items():
        share = 0.4 if name.startswith("antenna") else 0.9
        sigma[:, LINEAR.index(name)] = share * prior
    if not calibrated:
        sigma[:, LINEAR.index(ON_DEMAND[0]) :] = np.nan
    return dataclasses.replace(estimate, linear=value, linear_sigma=sigma, bias_sigma=np.full((n, 6), 0.003))


def metrics_for(d: Any, estimate: Estimate) -> dict[str, Any]:
    return metrics_of(result_of(d.recording, estimate, score(estimate, d.recording)))


def test_a_series_is_there_only_where_the_state_was_estimated(drive: Any) -> None:
    plain = drive().estimate
    assert series(plain, "yaw_scale") is None
    found = series(with_states(plain, calibrated=False), "side_slip")
    assert found is not None
    assert found[0] == pytest.approx(0.06)
    assert series(with_states(plain, calibrated=False), "radius_scale") is None


def test_every_state_of_a_calibration_has_its_unit_and_prior(drive: Any) -> None:
    rows = calibration(with_states(drive().estimate, calibrated=True))
    assert tuple(row["state"] for row in rows) == CALIBRATION == tuple(QUANTITIES) == tuple(CALIBRATION_SIGMA)
    assert [row["state"] for row in rows if row["observed"]] == ["antenna_x_m", "antenna_y_m"]
    told, prior = {row["state"]: cells(row) for row in rows}, PRIOR["antenna_x_m"]
    assert told["antenna_x_m"][1:] == ["0.080", f"{0.4 * prior:.3f}", f"{prior:.3f}", "observed"]
    yaw_deg = np.degrees(0.01 * (LINEAR.index("imu_yaw_rad") + 1))
    assert told["imu_yaw_rad"][0].endswith(", deg")
    assert float(told["imu_yaw_rad"][1]) == pytest.approx(yaw_deg, abs=5e-4)
    assert told["imu_yaw_rad"][4] == "not observable on this drive"
    of_no_unit = {"state": "slip_per_grade", "value": 0.4, "sigma": 0.1, "prior_sigma": 0.4, "observed": True}
    assert cells(of_no_unit)[0] == "slip over the sine of the slope"


@pytest.mark.parametrize("calibrated", [False, True])
def test_columns_of_the_states_come_after_those_of_the_contract(drive: Any, calibrated: bool) -> None:
    d = drive()
    table = estimate_columns(with_states(d.estimate, calibrated), d.recording.start_ns)
    names = list(table)
    more = names[names.index("immobilised") + 1 :]
    biases = [f"sigma_gyro_bias_{a}_radps" for a in "xyz"] + [f"sigma_accel_bias_{a}_mps2" for a in "xyz"]
    states = (*WANDERING, *(ON_DEMAND if calibrated else ()))
    assert more == biases + [part for state in states for part in (state, f"sigma_{state}")]
    assert names[: len(names) - len(more)][-3:] == ["status", "slipping", "immobilised"]
    assert {float(cell) for cell in table["sigma_gyro_bias_z_radps"]} == {0.003}
    assert {float(cell) for cell in table["yaw_scale"]} == {0.04}
    assert {len(column) for column in table.values()} == {len(d.estimate.trajectory)}


def test_metrics_tell_the_calibration_and_keep_to_the_schema(drive: Any) -> None:
    d = drive()
    for calibrated, count in ((False, 0), (True, len(CALIBRATION))):
        metrics = metrics_for(d, with_states(d.estimate, calibrated))
        Draft202012Validator(json.loads(SCHEMA.read_text(encoding="utf-8"))).validate(
            json.loads(to_json(metrics), parse_constant=pytest.fail)
        )
        assert len(metrics["calibration"]) == count


def test_the_report_says_what_was_observed_and_what_could_not_be(drive: Any, tmp_path: Path) -> None:
    d = drive()
    pages = []
    for calibrated in (False, True):
        estimate = with_states(d.estimate, calibrated)
        run = result_of(d.recording, estimate, score(estimate, d.recording))
        page = write_report(tmp_path / f"{calibrated}.html", "Replay", [run])
        pages.append(page.read_text(encoding="utf-8"))
    assert all("Yaw scale: true over wheel yaw rate" in page for page in pages)
    assert ["<h2>Calibration</h2>" in page for page in pages] == [False, True]
    assert pages[1].count("<td>observed</td>") == 2
    assert pages[1].count("<td>not observable on this drive</td>") == 6


def test_the_plot_of_skid_steering_has_a_band_of_two_sigma(drive: Any) -> None:
    d = drive()
    sheet = Sheet(10.0, start_ns=d.recording.start_ns)
    plot_skid_steering(sheet, with_states(d.estimate, calibrated=False))
    band = sheet.panels["skid_yaw_scale"].figure.renderers[0].data_source.data
    assert band["y2"] - band["y1"] == pytest.approx(4 * 0.05, rel=1e-5)


def test_diagnostics_carry_the_states(drive: Any) -> None:
    told = written_estimate(with_states(drive().estimate, calibrated=True)).diagnostics[-1][-1]
    assert told.name == "terrafusion/states"
    assert set(told.values) == {part for name in LINEAR[1:] for part in (name, f"sigma_{name}")}
    assert float(told.values["icr_x_m"]) == pytest.approx(0.05)


def test_the_command_calibrates_on_demand(tmp_path: Path, no_report: None) -> None:
    turning = Scenario(
        "turning",
        20.0,
        route=(RouteLeg("asphalt"),),
        drive=(DriveSegment(1.0), DriveSegment(9.0, 1.0, 0.3), DriveSegment(10.0, 1.0, -0.3)),
    )
    write_log_folder(simulate(turning, seed=1), tmp_path / "log")
    for switch in ([], ["--calibrate"]):
        out = tmp_path / f"out{len(switch)}"
        result = CliRunner().invoke(app, ["replay", str(tmp_path / "log"), "--out", str(out), *switch])
        assert result.exit_code == 0, result.output
        assert ("GNSS antenna, further forward, m:" in result.output) == bool(switch)
        with (out / "estimate.csv").open(encoding="utf-8", newline="") as lines:
            last = list(csv.DictReader(lines))[-1]
        assert ("radius_scale" in last) == bool(switch)
        assert float(last["sigma_yaw_scale"]) > 0.0
