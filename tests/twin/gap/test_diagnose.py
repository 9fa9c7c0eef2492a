"""Each verdict occurs on the right data, through the whole diagnosis and without any truth channel."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from terrafusion.datasets.core.recording import Overrides, Recording
from terrafusion.fusion.reports.gap_text import answer as screen
from terrafusion.fusion.reports.plots.gap import plot_shrink
from terrafusion.fusion.reports.plots.sheet import Sheet
from terrafusion.twin.gap.answer.corrected import values_of, write_corrected
from terrafusion.twin.gap.answer.diagnosis import GapDiagnosis
from terrafusion.twin.gap.answer.next_run import (
    BY_HAND,
    LIFTED,
    PAYLOAD,
    Planner,
    drives,
    forecast_runs,
)
from terrafusion.twin.gap.answer.verdict import UNKNOWN
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.diagnose import diagnose, diagnose_evidence
from terrafusion.twin.gap.infer.calibration import calibration_head
from terrafusion.twin.gap.infer.other_drives import learn_offsets
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.residuals import initial_state_sigma
from terrafusion.twin.model.vehicle import load_vehicle, with_overrides
from terrafusion.twin.scenario.scenario import DriveSegment
from tests.twin.gap.runs import DRIVE, run, runs

pytestmark = pytest.mark.usefixtures("fitted_once")

SCHEMA = json.loads((Path(__file__).parents[3] / "docs/schemas/diagnosis.schema.json").read_text("utf-8"))
VEHICLE = load_vehicle("elevate")
WIDE = {"wheel_radius/scale": 0.03}
FEW = ("wheel_radius", "gyro_bias")


@pytest.fixture(scope="module")
def references() -> list[Recording]:
    """Six: with two judged runs 28 choices, the fewest that can be significant at 5 %."""
    return runs(100, 6)


@pytest.fixture(scope="module")
def wide(references: list[Recording]) -> GapDiagnosis:
    """Wheels 3 % larger than the twin's."""
    return diagnose(runs(300, 2, WIDE), references, VEHICLE)


@pytest.fixture(scope="module")
def few(references: list[Recording]) -> GapDiagnosis:
    """The same with two candidates, for what does not hang on how many there are."""
    return diagnose(runs(300, 3, WIDE), references, VEHICLE, effects=FEW)


def checked(d: GapDiagnosis) -> dict:
    answer = d.to_json()
    jsonschema.validate(answer, SCHEMA)
    probabilities = [c["probability"] for c in answer["causes"]]
    assert probabilities == sorted(probabilities, reverse=True)
    present = 1.0 - answer["p_unknown"] - answer["p_null"]  # of one effect, or of two together
    assert probabilities[0] <= present + 1e-6
    assert present - 1e-6 <= sum(probabilities) <= 2.0 * present + 1e-6
    return answer


def test_no_gap_runs_like_the_references(references: list[Recording]) -> None:
    answer = checked(diagnose(runs(200, 2), references, VEHICLE))
    assert answer["verdict"] == "no_gap"
    assert answer["named"] == []
    assert not answer["gap"]["detected"]


def test_no_gap_where_all_runs_share_a_commissioning_error() -> None:
    wrong = {"track_width/scale": 0.1, "gyro_scale/scale": 0.02}
    answer = checked(diagnose(runs(800, 2, wrong), runs(810, 6, wrong), VEHICLE))
    assert answer["verdict"] == "no_gap"


def test_effect_a_wider_track(references: list[Recording]) -> None:
    answer = checked(diagnose(runs(720, 2, {"track_width/scale": 0.1}), references, VEHICLE))
    assert answer["verdict"] == "effect"
    assert answer["named"] == ["track_width"]
    assert not answer["gap"]["uncalibrated"]
    assert answer["causes"][0]["parameters"]["track_width/scale"]["value"] == pytest.approx(0.1, abs=0.012)
    assert {c["effect"] for c in answer["causes"]} == set(Candidates.of().effects)
    assert answer["next_run"] is None


def test_ambiguous_larger_wheels_and_grousers(wide: GapDiagnosis) -> None:
    answer = checked(wide)
    assert answer["verdict"] == "ambiguous"
    assert len(answer["named"]) == 1
    assert set(answer["causes"][0]["class"]) == {"wheel_radius", "encoder_scale", "grousers"}
    by_name = {cause["effect"]: cause for cause in answer["causes"]}
    number = by_name["wheel_radius"]["parameters"]["wheel_radius/scale"]
    assert number["value"] == pytest.approx(0.03, abs=0.004)
    assert (
        calibration_head().law_motion * number["value"] <= number["sigma"] < 0.02
    )  # the robot's law may be another
    following = answer["next_run"]
    assert following["scenario"] in (*drives(), BY_HAND)  # only a tape measure tells some of them apart
    assert set(following["separates"]) < set(answer["causes"][0]["class"])


def test_an_encoder_in_the_loop_is_in_the_set_of_what_it_resembles(references: list[Recording]) -> None:
    """A larger wheel drives alike but for how it sinks."""
    answer = checked(diagnose(runs(310, 2, {"encoder_scale/in_loop": 0.06}), references, VEHICLE))
    assert "encoder_scale" in answer["sets"][0]["effects"]
    assert {*answer["sets"][0]["effects"]} <= {"encoder_scale", "wheel_radius", "grousers", "encoder_dropout"}


def test_ambiguous_encoder_scale_and_lost_counts_with_a_second_effect(references: list[Recording]) -> None:
    both = {"gyro_scale/scale": 0.08, "encoder_dropout/share": 0.03}
    answer = checked(diagnose(runs(700, 2, both), references, VEHICLE))
    assert answer["verdict"] == "ambiguous"
    assert len(answer["named"]) == 2
    assert "gyro_scale" in answer["named"]
    by_name = {c["effect"]: c["class"] for c in answer["causes"]}
    (other,) = set(answer["named"]) - {"gyro_scale"}
    assert {"encoder_scale", "encoder_dropout"} <= set(by_name[other])
    assert answer["next_run"]["scenario"] == BY_HAND  # lost counts are a scale whatever is driven


def test_a_small_effect_is_named_beside_a_large_one(references: list[Recording]) -> None:
    """Of the whole gap it explains almost nothing, of what the large one leaves nearly all."""
    both = {"wheel_radius/scale": 0.1, "imu_yaw_misalignment/rotation": 0.15}
    found = diagnose(runs(740, 2, both), references, VEHICLE)
    answer = checked(found)
    assert set(answer["named"]) == {"wheel_radius", "imu_yaw_misalignment"}
    said = " ".join(" ".join(screen(found)).split())
    assert said.startswith("Gap caused by 2 effects together (9")
    assert all(key in said for key in both)
    values = {k: v for c in answer["causes"][:2] for k, v in c["parameters"].items()}
    for key, value in both.items():
        assert values[key]["value"] == pytest.approx(value, rel=0.2)


def test_parameters_ground_of_stiffer_bearing(references: list[Recording]) -> None:
    """The ground varies among the references too: it takes more of them to call a change of it a gap."""
    softer = runs(400, 2, {"soil_strength/bearing": 0.9})
    answer = checked(diagnose(softer, [*references, *runs(106, 4)], VEHICLE))
    assert answer["verdict"] == "parameters"
    assert answer["named"] == ["soil_strength"]


def test_unknown_an_encoder_that_hears_the_other(references: list[Recording]) -> None:
    """An effect that no catalogue has."""
    odd = [_with_encoder_crosstalk(run) for run in runs(600, 2)]
    answer = checked(diagnose(odd, references, VEHICLE))
    assert answer["verdict"] == "unknown"
    assert answer["named"] == []
    assert answer["p_unknown"] > max(UNKNOWN, answer["causes"][0]["probability"])


def _with_encoder_crosstalk(run: Recording) -> Recording:
    """3 % of the right wheels' speed on the left ones'."""
    assert run.wheels is not None
    speed = run.wheels.speed.copy()
    speed[:, 0] += 0.03 * speed[:, 1]
    return dataclasses.replace(run, wheels=dataclasses.replace(run.wheels, speed=speed, angle_rad=None))


def test_motor_current_in_the_gyro_is_near_a_bias(references: list[Recording]) -> None:
    """No catalogue has it; a bias explains its mean, and a second effect may pass for the rest."""
    odd = [_with_crosstalk(run) for run in runs(600, 2)]
    answer = checked(diagnose(odd, references, VEHICLE))
    assert answer["gap"]["detected"]
    assert {"gyro_bias"} <= {c["effect"] for c in answer["causes"][:2]}


def _with_crosstalk(run: Recording) -> Recording:
    """2 mrad/s of yaw rate an ampere of all motors."""
    assert run.imu is not None
    assert run.motor is not None
    gyro = run.imu.gyro_radps.copy()
    gyro[:, 2] += 2e-3 * np.interp(run.imu.t_ns, run.motor.t_ns, run.motor.current_a.sum(axis=1))
    return dataclasses.replace(run, imu=dataclasses.replace(run.imu, gyro_radps=gyro))


def test_unknown_a_gyro_that_swings_by_itself(references: list[Recording]) -> None:
    """An effect that no catalogue has, and that looks like none in it."""
    odd = [_swinging(run) for run in runs(600, 2)]
    answer = checked(diagnose(odd, references, VEHICLE))
    assert answer["verdict"] == "unknown"
    assert answer["named"] == []
    assert answer["p_unknown"] > 0.5


def _swinging(run: Recording) -> Recording:
    """50 mrad/s at 0.4 Hz on the yaw rate."""
    assert run.imu is not None
    gyro = run.imu.gyro_radps.copy()
    gyro[:, 2] += 0.05 * np.sin(2.0 * np.pi * 0.4 * 1e-9 * (run.imu.t_ns - run.start_ns))
    return dataclasses.replace(run, imu=dataclasses.replace(run.imu, gyro_radps=gyro))


SLOW_TURNS = dataclasses.replace(
    DRIVE,
    duration_s=24.0,
    drive=tuple(
        DriveSegment(*s) for s in ((6.0, 0.8, 0.4), (6.0, 1.2, -0.5), (6.0, 0.4, 0.9), (6.0, 0.3, -0.9))
    ),
)
"""Half of it slow turns that no reference made; it sets off with its first command."""


def test_no_gap_on_a_clean_drive_that_no_reference_made(references: list[Recording]) -> None:
    found = diagnose([run(i, drive=SLOW_TURNS) for i in (610, 611)], references, VEHICLE)
    assert found.detection.p_value > 0.05
    assert found.verdict.kind == "no_gap"
    said = " ".join(" ".join(screen(found)).split())
    assert said.startswith("No gap as far as the references tell, which cover ")
    assert "Make these references" in said


def test_undecided_where_drives_differ_and_nothing_explains_the_gap(
    references: list[Recording],
) -> None:
    found = diagnose([_swinging(run(i, drive=SLOW_TURNS)) for i in (610, 611)], references, VEHICLE)
    answer = checked(found)
    assert answer["gap"]["p_value"] <= 0.05
    assert answer["verdict"] == "no_gap"
    assert not answer["gap"]["detected"]
    assert answer["named"] == []
    said = " ".join(" ".join(screen(found)).split())
    assert said.startswith("Undecided: the runs differ from the references, and so do the drives")
    assert "Your drives differ from your references" in said
    assert "turning -0.9 rad/s" in said


def test_undecided_on_patchier_ground_where_the_test_is_not_sure(few: GapDiagnosis) -> None:
    """An effect that is clear stays one."""
    patchier = dataclasses.replace(few.evidence, patchier=2.0)
    least = few.detection.p_value
    assert checked(diagnose_evidence(patchier, "elevate", significance=10.0 * least))["named"]
    found = diagnose_evidence(patchier, "elevate", significance=2.0 * least)
    answer = checked(found)
    assert (answer["verdict"], answer["named"], answer["gap"]["detected"]) == ("no_gap", [], False)
    assert "and so does the ground, which varies more" in " ".join(" ".join(screen(found)).split())
    none = diagnose_evidence(patchier, "elevate", significance=0.5 * least)
    assert screen(none)[0].startswith("No gap, but the ground varies more along the path")


def test_sets_and_drives_of_an_answer(wide: GapDiagnosis) -> None:
    answer = checked(wide)
    assert set(answer["sets"][0]["effects"]) == {"wheel_radius", "encoder_scale", "grousers"}
    assert answer["sets"][0]["named"]
    assert answer["drives"] == {
        "covered": pytest.approx(1.0),
        "missing": [],
    }  # references made the same drive


def test_where_and_shrink_in_units_of_the_channels(wide: GapDiagnosis) -> None:
    """Speed, and so position in a window of 10 s, is 3 % off: a decimetre or so of 10 m after the fit."""
    cell = next(c for c in wide.where if c.channel == "gnss_position")
    assert cell.p_value <= 0.05
    assert 0.02 < cell.error < 0.3
    assert cell.reference < 0.5 * cell.error
    before, after, floor = wide.shrinkage.physical["gnss_position"]
    assert floor is not None
    assert before > 2.5 * floor
    assert after < 1.1 * floor


def test_lifted_wheels_carry_no_load(wide: GapDiagnosis) -> None:
    e = wide.evidence
    columns = [e.candidates.keys.index(f"motion_resistance/{form}") for form in ("in_motion", "with_speed")]
    strength = {
        name: np.abs(run.by_parameter[:, columns]).max()
        for name, run in forecast_runs(e, (LIFTED, "speed staircase"), {"motion_resistance"}).items()
    }
    assert strength[LIFTED] == 0.0
    assert strength["speed staircase"] > 0.1


def _separations(d: GapDiagnosis, one: str, other: str, *names: str) -> list[float]:
    """Sigmas that two effects of typical size differ by with each drive beside the judged runs; "": none."""
    e, sigma = d.evidence, initial_state_sigma(d.evidence.candidates)
    robot = learn_offsets([score(r, sigma) for r in e.references], e.candidates.count)
    planner = Planner.of(e, sigma, robot, [score(r, sigma) for r in e.runs])
    by_name = {c.effect: c for c in d.verdict.causes}
    causes = [dataclasses.replace(by_name[n], value=np.ones(len(by_name[n].columns))) for n in (one, other)]
    more = [planner.forecast((n,), {one, other})[n] if n else 0.0 for n in names]
    return [planner.separation(causes[0], causes[1], m) for m in more]


def test_lifted_wheels_tell_a_gear_from_the_ground(wide: GapDiagnosis) -> None:
    before, after = _separations(wide, "drivetrain_friction", "motion_resistance", "", LIFTED)
    assert before < 0.7
    assert after > 1.0  # references have not shown this robot with its wheels lifted
    before, after = _separations(wide, "motion_resistance", "grousers", "", LIFTED)
    assert after == pytest.approx(before, rel=0.01)  # neither shows in the air


def test_a_payload_tells_what_scales_with_the_load(wide: GapDiagnosis) -> None:
    name = "spins, then straight"
    pair = ("drivetrain_friction", "motion_resistance")
    before, plain, loaded = _separations(wide, *pair, "", name, name + PAYLOAD)
    assert before <= plain
    assert loaded > 1.5 * plain
    assert "four headings" in drives()


def test_the_gap_shrinks_on_runs_left_out(wide: GapDiagnosis) -> None:
    s = wide.to_json()["shrink"]
    assert s["after"] < s["before"]
    assert s["after"] < 1.2 * s["floor"]
    assert s["recalibration_only"] > s["after"]
    assert set(s["per_channel"]) >= {"gnss_position", "yaw_rate", "wheel_left"}


def test_the_map_names_a_cell_of_the_gap(wide: GapDiagnosis) -> None:
    cells = wide.to_json()["where"]
    assert cells[0]["p_value"] <= 0.05
    assert sum(c["share"] for c in cells) == pytest.approx(1.0, abs=1e-6)


@pytest.fixture(scope="module")
def fresh() -> list[Recording]:
    """Runs that no fit has seen."""
    return runs(320, 2, WIDE)


@pytest.fixture(scope="module")
def unreferred(fresh: list[Recording]) -> GapDiagnosis:
    """Against the uncorrected twin alone."""
    return diagnose(fresh, [], VEHICLE)


def test_without_references_it_answers_and_says_that_it_is_uncalibrated(unreferred: GapDiagnosis) -> None:
    answer = checked(unreferred)
    assert answer["gap"]["uncalibrated"]
    assert answer["gap"]["detected"]
    assert answer["reference_runs"] == []
    assert answer["where"] == []
    assert any("that takes 2 references" in line for line in screen(unreferred))
    assert "% certain, if the twin is right" in " ".join(screen(unreferred))
    assert answer["shrink"]["floor"] is None
    assert answer["causes"][0]["effect"] in ("wheel_radius", "encoder_scale", "grousers")


def test_a_plot_names_references_where_there_are_any(wide: GapDiagnosis, unreferred: GapDiagnosis) -> None:
    for found, labels in ((wide, ["before", "after", "references"]), (unreferred, ["before", "after"])):
        sheet = Sheet()
        plot_shrink(sheet, found)
        assert [*sheet.panels["shrink"].legend] == labels


@pytest.mark.parametrize("first", [410, 430])
def test_without_references_the_twins_own_runs_are_no_gap(first: int) -> None:
    """Whatever its sensors drew for the run: an offset and a gain of each current sensor among it."""
    answer = checked(diagnose(runs(first, 2), [], VEHICLE))
    assert answer["gap"]["uncalibrated"]
    assert answer["verdict"] == "no_gap"


def test_the_same_input_gives_the_same_bits(fresh: list[Recording]) -> None:
    one, other = (json.dumps(diagnose(fresh, [], VEHICLE, effects=FEW).to_json()) for _ in range(2))
    assert one == other


def test_the_corrected_twin_has_a_smaller_gap_on_fresh_runs(
    few: GapDiagnosis, fresh: list[Recording], unreferred: GapDiagnosis, tmp_path: Path
) -> None:
    target = tmp_path / "corrected.yaml"
    said = write_corrected(few, "elevate", target)
    corrected = load_vehicle(target)
    shift = values_of(few)["wheel_radius/scale"]
    assert corrected.wheel.radius_m == pytest.approx(VEHICLE.wheel.radius_m * (1.0 + shift))
    assert any("radius_m" in line for line in said)
    assert with_overrides(corrected, Overrides(wheel_radius_m=0.175)).wheel == corrected.wheel

    after = diagnose(fresh, [], corrected)
    assert unreferred.detected
    assert after.detection.statistic < 0.4 * unreferred.detection.statistic
    assert unreferred.shrinkage is not None
    assert after.shrinkage is not None
    assert after.shrinkage.before < 0.75 * unreferred.shrinkage.before
    assert not after.detected


ACROSS = {"cross_slope/uniform": 0.0873}
"""The robot crabs: it points elsewhere than its track."""


@pytest.fixture(scope="module")
def across(references: list[Recording]) -> GapDiagnosis:
    """On a slope of 5 deg to the left."""
    return diagnose(runs(310, 2, ACROSS), references, VEHICLE)


def test_a_slope_is_taken_in_the_direction_it_has_to_a_robot_that_crabs(across: GapDiagnosis) -> None:
    answer = checked(across)
    assert answer["named"] == ["cross_slope"]
    assert values_of(across)["cross_slope/uniform"] == pytest.approx(0.0873, abs=0.004)
    assert across.shrinkage is not None
    assert across.shrinkage.after < 1.3


def test_an_effect_that_is_no_number_of_the_vehicle_goes_into_its_file(
    across: GapDiagnosis, tmp_path: Path
) -> None:
    target, fresh = tmp_path / "corrected.yaml", runs(330, 2, ACROSS)
    assert any("cross_slope/uniform" in line for line in write_corrected(across, "elevate", target))
    corrected = load_vehicle(target)
    assert corrected.effects == values_of(across)
    before, after = (diagnose(fresh, [], vehicle) for vehicle in (VEHICLE, corrected))
    assert after.detection.statistic < 0.1 * before.detection.statistic
    assert before.shrinkage is not None
    assert after.shrinkage is not None
    assert before.shrinkage.before > 5.0
    assert after.shrinkage.before < 1.0  # noise variances
    assert not after.detected


def test_what_the_twin_has_already_is_a_candidate_beside_those_named(across: GapDiagnosis) -> None:
    on_it = dataclasses.replace(VEHICLE, effects=values_of(across))
    found = diagnose(runs(330, 2, {"gyro_bias/constant": 0.05}), [], on_it, effects=("gyro_bias",))
    assert found.evidence.candidates.effects == ("gyro_bias", "cross_slope")
    assert {*found.verdict.named} == {"gyro_bias", "cross_slope"}
    assert values_of(found)["cross_slope/uniform"] < -0.07  # these runs are on level ground


def test_what_the_twin_has_may_have_gone() -> None:
    """Lost counts are never negative, but there can be fewer than the twin has."""
    on_it = dataclasses.replace(VEHICLE, effects={"encoder_dropout/share": 0.06})
    found = diagnose(runs(330, 2), [], on_it, effects=("encoder_dropout", "gyro_bias"))
    assert found.verdict.named == ("encoder_dropout",)
    assert values_of(found)["encoder_dropout/share"] == pytest.approx(-0.06, abs=0.01)


@pytest.mark.parametrize("effects", [("gyro_bias",), None])
def test_without_references_a_large_effect_does_not_pass_for_noise(effects: tuple[str, ...] | None) -> None:
    """Also where all candidates are of the sensors."""
    found = diagnose(runs(330, 2, {"gyro_bias/constant": 0.05}), [], VEHICLE, effects=effects)
    assert found.verdict.named == ("gyro_bias",)
    assert values_of(found)["gyro_bias/constant"] == pytest.approx(0.05, abs=0.005)
