"""Verdicts: good if nothing speaks against the run, not good where the error is far or far beyond sigma."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from terrafusion.datasets.checks import Finding
from terrafusion.datasets.core.channels import Imu
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.estimate.antenna import AntennaPlaces
from terrafusion.fusion.estimate.corrections import Corrections
from terrafusion.fusion.estimate.estimate import Innovation
from terrafusion.fusion.metrics.baselines import Baselines, OutageBaseline
from terrafusion.fusion.metrics.judged_run import Run
from terrafusion.fusion.metrics.scores import Outage, OutageScore, score
from terrafusion.fusion.metrics.verdict import Verdict, _fix_sigma_m, judge
from terrafusion.twin.model.vehicle import load_vehicle
from tests.studies.verdicts import FAULTS, is_wrong, short_drive

RIG = load_vehicle("elevate").rig()


def verdict(
    d, *, truth=True, estimate=None, baselines=None, findings=(), outages=(), held_out=None,
    corrections=None, **known,
) -> Verdict:  # fmt: skip
    estimate = estimate or d.estimate
    recording = d.recording if truth else dataclasses.replace(d.recording, truth=None)
    scores = score(estimate, recording, held_out=held_out, outages=outages)
    alone, corrections = baselines or Baselines(), corrections or Corrections()
    return judge(
        Run(
            recording,
            estimate,
            scores,
            alone,
            d.fixes,
            findings,
            **({"rig": RIG} | known),
            corrections=corrections,
        )
    )


def with_innovations(d, nis, accepted=True):
    """The estimate with one GNSS innovation a second."""
    t_ns = d.fixes.t_ns[: len(nis)]
    accepted = np.broadcast_to(accepted, len(nis))
    rows = zip(t_ns.tolist(), np.asarray(nis).tolist(), accepted.tolist(), strict=True)
    # A direction of its own each time, so that innovations are independent.
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(nis), 2))
    found = [Innovation(t, "gnss", 12.0 * signs[i], n, 2, ok) for i, (t, n, ok) in enumerate(rows)]
    return dataclasses.replace(d.estimate, innovations=tuple(found))


def consistent(d, **changed):
    return with_innovations(d, np.random.default_rng(3).chisquare(2, 100), **changed)


def test_a_run_within_its_sigma_is_good_and_says_on_what_that_rests(drive):
    d = drive(offset_m=(0.1, 0.1), sigma_m=0.2)
    found = verdict(d, estimate=consistent(d))
    assert found.value == "good", found
    assert found.reasons[0].startswith("The position error is 0.1")
    assert "against the ground truth" in found.reasons[0]
    assert found.lines()[0] == "verdict: good"


def test_far_from_the_truth_is_not_to_be_used(drive):
    found = verdict(drive(offset_m=(15.0, 5.0)))
    assert found.value == "not_to_be_used"
    assert found.words() == "not to be used"
    assert "15.8 m RMS against the ground truth" in found.reasons[0]


def test_errors_against_a_truth_in_another_frame_are_not_judged(drive):
    finding = Finding("truth-frame", "warning", "truth", "the truth is turned", "by 70 deg", "turn it")
    found = verdict(drive(offset_m=(15.0, 5.0)), findings=[finding])
    assert found.value == "doubtful"
    assert found.reasons == ("Errors are not judged: the truth is turned (by 70 deg); turn it.",)


def test_far_on_a_long_way_is_doubtful(drive):
    d = drive(seconds=300.0, offset_m=(11.0, 0.0), sigma_m=9.0)
    assert verdict(d, estimate=consistent(d)).value == "doubtful"


@pytest.mark.parametrize(("offset_m", "value"), [(0.2, "good"), (0.6, "doubtful")])
def test_an_error_beyond_five_sigma_is_not_good(drive, offset_m, value):
    d = drive(offset_m=(offset_m, 0.0), sigma_m=0.1)
    found = verdict(d, estimate=consistent(d))
    assert found.value == value
    assert ("five times its own sigma" in " ".join(found.reasons)) == (value == "doubtful")


@pytest.mark.parametrize(("until_s", "slip"), [(20.0, True), (60.0, False)])
def test_slip_without_fixes_is_named_where_it_explains_the_error(drive, until_s, slip):
    """The estimate goes on at the speed of the wheels, 0.5 m/s too fast."""
    d = drive(seconds=60.0, turn_radps=0.0, drift_mps=0.5, drift_from_s=20.0, sigma_m=0.5)
    used = d.fixes.between(int(d.fixes.t_ns[0]), int(d.fixes.t_ns[0] + until_s * 1e9))
    found = " ".join(verdict(dataclasses.replace(d, fixes=used)).reasons)
    assert "five times its own sigma" in found
    assert ("without fixes from 19 s on the robot moved 41.0 m, the estimate 61.0 m" in found) == slip
    assert ("the wheels slipped more" in found, "IMU mounting" in found) == (slip, not slip)


def test_a_sigma_too_small_is_named(drive):
    d = drive(noise_m=0.35, sigma_m=0.1)
    assert "NEES" in " ".join(verdict(d, estimate=consistent(d)).reasons)


def test_innovations_beyond_their_bound_are_doubtful_without_any_reference(drive):
    d = drive()
    chi = np.random.default_rng(5).chisquare(2, 100)
    assert verdict(d, truth=False, estimate=with_innovations(d, chi)).value == "good"
    found = verdict(d, truth=False, estimate=with_innovations(d, 4.0**2 * chi))
    assert found.value == "doubtful"
    assert "GNSS innovations are 4" in found.reasons[0]
    assert "`terrafusion inspect`" in found.reasons[0]


def test_a_single_wild_fix_is_none_of_its_business(drive):
    d = drive()
    chi = np.random.default_rng(5).chisquare(2, 100)
    chi[40] = 900.0
    assert verdict(d, truth=False, estimate=with_innovations(d, chi, chi < 900.0)).value == "good"


def test_fixes_rejected_in_a_row_are_named_with_time_and_size(drive):
    d = drive()
    chi = np.random.default_rng(5).chisquare(2, 100)
    chi[40:48] = 900.0
    found = verdict(d, truth=False, estimate=with_innovations(d, chi, np.r_[chi[:47] < 900.0, [True] * 53]))
    assert found.value == "doubtful"
    assert "8 fixes in a row from 40 s on lie 17.0 m off the estimate, which then moved to them" in " ".join(
        found.reasons
    )


def test_most_fixes_rejected_is_not_to_be_used(drive):
    d = drive()
    estimate = with_innovations(d, np.full(100, 50.0), np.arange(100) % 5 == 0)
    assert verdict(d, truth=False, estimate=estimate).value == "not_to_be_used"


def test_a_baseline_that_does_better_is_named(drive):
    d = drive(offset_m=(2.8, 0.0), sigma_m=2.0)
    assert verdict(d, estimate=consistent(d), baselines=Baselines(2.0, 2.5)).value == "good"
    found = verdict(d, estimate=consistent(d), baselines=Baselines(1.0, 2.5))
    assert found.value == "doubtful"
    assert "lain dead reckoning has an error of 1.00 m" in found.reasons[0]


def test_many_outages_lost_to_dead_reckoning_are_no_chance(drive):
    d = drive()
    lost = tuple(OutageScore(i, 30.0, 30.0, 4.0, 2.0, 13.0) for i in range(6))
    rivals = Baselines(outages=tuple(OutageBaseline(i, 1.0, None) for i in range(6)))
    scores = dataclasses.replace(score(consistent(d), d.recording), outages=lost)
    run = Run(d.recording, consistent(d), scores, rivals, d.fixes, (), RIG)
    assert "6 of 6 outages" in judge(run).reasons[0]
    few = dataclasses.replace(run, scores=dataclasses.replace(scores, outages=lost[:4]))
    few = dataclasses.replace(few, baselines=Baselines(outages=rivals.outages[:4]))
    assert judge(few).value == "good"


def test_an_outage_that_ends_far_off_is_doubtful(drive):
    d = drive(drift_mps=0.6, drift_from_s=60.0, sigma_m=8.0)
    found = verdict(d, estimate=consistent(d), outages=[Outage(40.0, 40.0)])
    assert found.value != "good"
    assert any("40 s without GNSS from 40 s on end 1" in reason for reason in found.reasons)


def test_what_is_not_known_is_doubtful(drive):
    d = drive(sigma_m=40.0)
    assert "known to 40 m only" in verdict(d, estimate=consistent(d)).reasons[0]


@pytest.mark.parametrize(
    ("fixes", "remedy"), [(True, "drive on"), (False, "without fixes nothing corrects it")]
)
def test_an_unknown_heading_has_a_remedy_that_helps(drive, fixes, remedy):
    d = drive()
    P = d.estimate.trajectory.covariance.copy()
    P[-1, 5, 5] = 1.0
    estimate = dataclasses.replace(
        d.estimate, trajectory=dataclasses.replace(d.estimate.trajectory, covariance=P)
    )
    used = d.fixes if fixes else None
    reasons = judge(
        Run(d.recording, estimate, score(estimate, d.recording), Baselines(), used, (), RIG)
    ).reasons
    assert any("57 deg" in reason and reason.endswith(remedy + ".") for reason in reasons)


def test_a_path_that_fixes_never_placed_is_not_to_be_used(drive):
    d = drive()
    local = dataclasses.replace(d.estimate, status=np.full(len(d.estimate.status), "no_gnss", dtype=object))
    assert verdict(d, truth=False, estimate=local).value == "not_to_be_used"


def test_nothing_to_check_against_is_doubtful_without_sensors_that_vouch(drive):
    d = drive()
    alone = dataclasses.replace(d.estimate, innovations=())
    run = Run(
        dataclasses.replace(d.recording, truth=None),
        alone,
        score(alone, Recording("r", 0)),
        Baselines(),
        None,
        (),
        RIG,
    )
    assert judge(run).value == "doubtful"
    assert "nothing to check the path against" in judge(run).reasons[0].lower()


@pytest.mark.parametrize(("share", "value"), [(None, "good"), (0.05, "good"), (0.15, "doubtful")])
def test_wheels_that_slip_cannot_vouch(drive, share, value):
    d = drive(sigma_m=1.0)
    t_ns = d.recording.wheels.t_ns
    imu = Imu(t_ns, np.zeros((len(t_ns), 3)), np.tile([0.0, 0.0, 9.81], (len(t_ns), 1)))
    log = dataclasses.replace(d.recording, truth=None, imu=imu)
    agreeing = Innovation(int(d.fixes.t_ns[0]), "wheels", np.zeros(1), 0.5, 1, True)
    n = len(d.estimate.status)
    slipping = None if share is None else np.arange(n) < share * n
    estimate = dataclasses.replace(d.estimate, innovations=(agreeing,), slipping=slipping)
    found = judge(Run(log, estimate, score(estimate, Recording("r", 0)), Baselines(), None, (), RIG))
    assert found.value == value, found
    assert ("the wheels slipped 15 % of the time" in found.reasons[0]) == (value == "doubtful")


def test_findings_of_the_log_checks_count_by_their_kind(drive):
    d = drive()

    def of(code: str, severity: str) -> str:
        finding = Finding(code, severity, "wheels", "what", "evidence", "fix")
        return verdict(d, estimate=consistent(d), findings=[finding]).value

    assert of("uneven-sampling", "warning") == "good"
    assert of("wheel-radius", "warning") == "doubtful"
    assert of("gyro-scale", "warning") == "good"
    assert of("yaw-sign", "error") == "doubtful"


@pytest.mark.parametrize("seed", [400, 403, 410, 415])
def test_a_clean_drive_of_the_twin_is_good(seed):
    from terrafusion.fusion.replay import replay

    log = short_drive(seed)
    for known in (log, dataclasses.replace(log, truth=None)):
        run = replay(known, settings={"self_calibrate": False})
        assert run.verdict.value == "good", run.verdict


@pytest.mark.parametrize("fault", ["fixes 50 m off, 10 s", "gyro sign", "IMU turned, 90 deg about z"])
def test_a_fault_is_not_good(fault):
    from terrafusion.fusion.replay import replay

    far = False
    for seed in (402, 400) if fault == "gyro sign" else (402,):  # the fixes prevail on the first drive
        log = FAULTS[fault](short_drive(seed))
        for known in (log, dataclasses.replace(log, truth=None)):
            run = replay(known, settings={"self_calibrate": False})
            far |= is_wrong(score(run.estimate, log, antenna_m=run.vehicle.sensors.gnss.antenna_m))
            assert run.verdict.value != "good", run.verdict
    assert far or fault != "gyro sign"


def test_a_gyro_at_the_end_of_its_range_is_not_good_even_where_nothing_else_shows_it():
    from terrafusion.fusion.replay import replay

    log = dataclasses.replace(short_drive(402), truth=None)
    assert log.imu is not None
    most = 0.5 * float(np.abs(log.imu.gyro_radps[:, 2]).max())
    clipped = dataclasses.replace(log.imu, gyro_radps=np.clip(log.imu.gyro_radps, -most, most))
    run = replay(dataclasses.replace(log, imu=clipped), settings={"self_calibrate": False})
    assert run.verdict.value == "doubtful"
    assert "end of a range" in " ".join(run.verdict.reasons)


@pytest.mark.parametrize(
    ("delay_s", "value"),
    [
        ((0.3, 0.05), "doubtful"),
        ((-0.3, 0.05), "doubtful"),
        ((0.3, 0.14), "doubtful"),
        ((0.3, 0.15), "good"),
        ((0.01, 0.001), "good"),
    ],
)
def test_a_likely_delay_beyond_the_sigma_of_the_position_is_not_good(drive, delay_s, value):
    d = drive(noise_m=0.01, sigma_m=0.03)
    corrections = Corrections(uncorrected_delay_s=delay_s)
    found = verdict(d, truth=False, estimate=consistent(d), corrections=corrections)
    assert found.value == value, found
    assert ("the fixes seem 0.30 s" in found.reasons[0].lower()) == (value == "doubtful")
    assert verdict(d, estimate=consistent(d), corrections=corrections).value == "good", "its errors are small"


def places(d, lever_m=(0.0, 0.0, 0.0), late_s=0.0, from_s=20.0):
    """An antenna, or a delay, that the drive showed from then on."""
    found = AntennaPlaces.fixed((0.0, 0.0, 0.0))
    return found.then(d.recording.start_ns + int(from_s * 1e9), lever_m, round(late_s * 1e9))


@pytest.mark.parametrize(
    ("antenna", "value"),
    [
        ({"lever_m": (0.3, 0.0, 0.0)}, "doubtful"),
        ({"lever_m": (0.16, 0.0, 0.0)}, "doubtful"),
        ({"lever_m": (0.14, 0.0, 0.0)}, "good"),
        ({"lever_m": (0.3, 0.0, 0.0), "from_s": 0.5}, "good"),
        ({"late_s": 0.5}, "doubtful"),
        ({"late_s": 0.05}, "good"),
    ],
)
def test_results_before_a_correction_beyond_their_sigma_are_not_good(drive, antenna, value):
    d = drive(noise_m=0.01, sigma_m=0.03)
    corrections = Corrections(antenna=places(d, **antenna))
    found = verdict(d, truth=False, estimate=consistent(d), corrections=corrections)
    assert found.value == value, found
    if value == "doubtful":
        assert found.reasons[0].startswith(
            "Up to 20 s the results rest on numbers that the drive then refuted"
        )
        assert "`terrafusion calibrate LOG --sensors`" in found.reasons[0]
    assert verdict(d, estimate=consistent(d), corrections=corrections).value == "good", "the truth tells"


@pytest.mark.parametrize(
    ("antenna", "axis", "value"),
    [
        ({"late_s": 0.5}, 0, "good"),
        ({"late_s": 0.5}, 1, "doubtful"),
        ({"lever_m": (0.3, 0.0, 0.0)}, 0, "good"),
        ({"lever_m": (0.0, 0.3, 0.0)}, 0, "doubtful"),
    ],
)
def test_a_correction_is_judged_by_the_sigma_along_its_shift(drive, antenna, axis, value):
    """A robot that drives east; `axis`: along which its sigma, m, holds any shift."""
    d = drive(noise_m=0.01, sigma_m=0.03)
    path = d.estimate.trajectory
    P = path.covariance.copy()
    P[:, axis, axis] = 1.0
    wide = dataclasses.replace(path, covariance=P)
    estimate = dataclasses.replace(consistent(d), trajectory=wide)
    found = verdict(d, truth=False, estimate=estimate, corrections=Corrections(antenna=places(d, **antenna)))
    assert found.value == value, found


@pytest.mark.parametrize(("imu", "value"), [("six_axis", "doubtful"), ("gyro_z", "good")])
@pytest.mark.parametrize("code", ["imu-forward", "accel-mirrored"])
def test_axes_that_the_graph_does_not_use_are_no_reason(drive, code, imu, value):
    found = Finding(code, "warning", "imu", "x does not point forward", "90 deg", "turn it")
    d = drive()
    assert verdict(d, truth=False, estimate=consistent(d), findings=[found], imu=imu).value == value


@pytest.mark.parametrize(("kind", "value"), [("ackermann", "doubtful"), ("differential", "good")])
def test_a_car_whose_wheelbase_nobody_gave_is_not_good(drive, kind, value):
    d, rig, assumed = drive(), dataclasses.replace(RIG, drive=kind), frozenset(["wheelbase_m", "imu_m"])
    found = verdict(d, truth=False, estimate=consistent(d), rig=rig, assumed=assumed)
    assert found.value == value
    assert ("wheelbase_m" in " ".join(found.reasons)) == (value == "doubtful")
    assert verdict(d, truth=False, estimate=consistent(d), rig=rig).value == "good"


@pytest.mark.parametrize(("after_s", "value"), [(15.0, "doubtful"), (0.5, "good")])
def test_what_a_turned_imu_bent_before_its_angle_was_known_is_not_good(drive, after_s, value):
    d = drive()
    found = Finding("imu-forward", "error", "imu", "x does not point forward", "90 deg", "turn it")
    since_ns = d.recording.start_ns + int(after_s * 1e9)
    corrections = Corrections(frozenset(["imu_yaw_rad"]), since_ns)
    judged = verdict(d, truth=False, estimate=consistent(d), findings=[found], corrections=corrections)
    assert judged.value == value
    assert ("the angle of the IMU" in judged.reasons[0]) == (value == "doubtful")
    assert "forward" not in " ".join(judged.reasons)


@pytest.mark.parametrize(
    ("sigma_rad", "sigma_m", "value"),
    [(1.8, 0.02, "doubtful"), (0.7, 0.02, "good"), (None, 0.02, "good"), (1.8, 0.5, "good")],
)
def test_an_imu_of_any_angle_is_not_good_where_that_matters(drive, sigma_rad, sigma_m, value):
    d = drive(noise_m=0.01, sigma_m=sigma_m, turn_radps=0.5)
    corrections = Corrections(imu_sigma_rad=sigma_rad)
    found = verdict(d, truth=False, estimate=consistent(d), corrections=corrections)
    assert found.value == value, found
    assert ("`imu_yaw_rad`" in found.reasons[0]) == (value == "doubtful")
    assert verdict(d, estimate=consistent(d), corrections=corrections).value == "good", "the truth tells"


@pytest.mark.parametrize(("rejected", "value"), [(4, "doubtful"), (3, "good")])
def test_a_fix_that_the_estimate_gives_in_to_is_one_of_those_against_it(drive, rejected, value):
    d = drive()
    chi = np.random.default_rng(5).chisquare(2, 100)
    chi[40 : 41 + rejected] = 20.0
    accepted = np.ones(100, dtype=bool)
    accepted[40 : 40 + rejected] = False
    assert verdict(d, truth=False, estimate=with_innovations(d, chi, accepted)).value == value


@pytest.mark.parametrize(
    ("channel", "value"), [("imu", "doubtful"), ("wheels", "doubtful"), ("gnss", "good")]
)
def test_a_clock_of_wheels_or_imu_that_is_off_is_not_good(drive, channel, value):
    d = drive(offset_m=(0.1, 0.1), sigma_m=0.2)
    late = Finding(
        "clock-offset", "warning", channel, "its times are 0.29 s late", "correlation 0.96", "move them"
    )
    assert verdict(d, estimate=consistent(d), findings=[late]).value == value


def test_the_sigma_of_fixes_is_the_typical_horizontal_one() -> None:
    sigma = np.array([[0.1, 0.3, 9.0], [0.4, 0.2, 9.0], [2.0, 1.0, 9.0], [np.inf, 1.0, 9.0]])
    assert _fix_sigma_m(SimpleNamespace(sigma_enu_m=sigma)) == 0.4  # type: ignore[arg-type]
    assert _fix_sigma_m(None) == 0.0


def test_wild_fixes_that_were_rejected_do_not_count_as_agreement(drive):
    d = drive(offset_m=(0.1, 0.1), sigma_m=0.2)
    nis = np.random.default_rng(3).chisquare(2, 100)
    nis[[20, 60]] = 1e5
    found = verdict(d, estimate=with_innovations(d, nis, accepted=nis < 1e3))
    assert found.value == "good", found
    assert found.reasons[1].endswith("innovations are 1.0 times their sigma; 2 of 100 were rejected.")


@pytest.mark.parametrize(
    ("nis", "reported", "asked"), [(0.05, False, True), (1.0, False, False), (0.05, True, False)]
)
def test_a_sigma_that_was_assumed_far_too_large_is_asked_for(drive, nis, reported, asked):
    d = drive(offset_m=(0.1, 0.1), sigma_m=0.2)
    notes = () if reported else ("gnss: 100 fixes have no sigma; taken from their class",)
    d = dataclasses.replace(d, recording=dataclasses.replace(d.recording, notes=notes))
    found = verdict(d, estimate=with_innovations(d, np.full(100, 2.0 * nis)))
    assert any("gnss_sigma_m" in reason for reason in found.reasons) == asked
