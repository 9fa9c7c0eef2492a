"""Fixes that come late, out of order, wrong, or from a receiver that lies; gates that cannot lock out."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import Innovation, State
from terrafusion.fusion.estimator.dead_reckoning import DeadReckoning, FixPair
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.fix_noise import WHITE_SHARE
from terrafusion.fusion.estimator.gates import GateDecision, GnssGate
from terrafusion.fusion.inputs.streams import ImuStream, WheelStream
from terrafusion.fusion.inputs.validation import checked_fix
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate

GATE = float(chi2.ppf(0.999, 2))
Message = tuple[int, int, str, int]
"""Time of arrival, time stamp, channel, row."""


@dataclasses.dataclass(frozen=True)
class Fed:
    estimator: Estimator
    states: list[State]
    innovations: list[Innovation]

    def end(self) -> np.ndarray:
        return self.states[-1].position_m


def winding(
    seconds: float = 30.0, seed: int = 2, terrain: str = "asphalt", vehicle: str = "elevate"
) -> Recording:
    drive = (
        DriveSegment(2.0),
        DriveSegment(seconds, v_mps=1.0, v_amplitude_mps=0.3, yaw_rate_amplitude_radps=0.3, period_s=9.0),
    )
    route = (RouteLeg(terrain),)
    return simulate(Scenario("winding", seconds, drive=drive, route=route), seed=seed, vehicle=vehicle)


@pytest.fixture(scope="module")
def drive() -> Recording:
    return winding()


def messages(recording: Recording) -> list[Message]:
    """All samples in time order."""
    channels = {"wheels": recording.wheels, "gnss": recording.gnss, "imu": recording.imu}
    rows = [
        (int(t), int(t), name, i)
        for name, channel in channels.items()
        if channel is not None
        for i, t in enumerate(channel.t_ns)
    ]
    order = list(channels)
    return sorted(rows, key=lambda row: (row[0], order.index(row[2])))


def feed(recording: Recording, arriving: list[Message], mode: str = "fixed") -> Fed:
    """Give messages in order of arrival."""
    vehicle = load_vehicle(recording.vehicle or "elevate")
    states: list[State] = []
    innovations: list[Innovation] = []
    config = EstimatorConfig(vehicle.rig(), vehicle.name, mode)
    estimator = Estimator(config, on_state=states.append, on_innovation=innovations.append)
    imu, wheels, gnss = recording.imu, recording.wheels, recording.gnss
    assert imu is not None
    assert wheels is not None
    assert gnss is not None
    sides = wheels.side_speeds_mps(vehicle.wheel.radius_m)
    for _, t_ns, name, i in sorted(arriving, key=lambda message: message[0]):
        if name == "wheels":
            estimator.add_wheels(t_ns, *sides[i].tolist())
        elif name == "gnss":
            estimator.add_gnss(t_ns, gnss.enu_m[i], gnss.sigma_enu_m[i], fix=int(gnss.fix[i]))
        else:
            estimator.add_imu(t_ns, imu.gyro_radps[i], imu.accel_mps2[i])
    estimator.finish()
    return Fed(estimator, states, innovations)


@functools.cache
def plainly_driven(mode: str = "fixed") -> Fed:
    """The drive of the fixture `drive`, nothing changed."""
    recording = winding()
    return feed(recording, messages(recording), mode)


def with_fixes(recording: Recording, enu_m: np.ndarray, sigma_m: np.ndarray | float) -> Recording:
    gnss = recording.gnss
    assert gnss is not None
    sigma = np.broadcast_to(sigma_m, enu_m.shape).astype(float)
    return dataclasses.replace(
        recording, gnss=dataclasses.replace(gnss, enu_m=enu_m, sigma_enu_m=np.array(sigma))
    )


def errors_m(recording: Recording, states: list[State]) -> np.ndarray:
    truth = recording.truth
    assert truth is not None
    there = truth.positions_at(np.array([s.t_ns for s in states]))
    return np.hypot(*(np.array([s.position_m for s in states]) - there)[:, :2].T)


# --- late and out of order -----------------------------------------------------------------------------


@pytest.mark.parametrize("terrain", ["asphalt", "loose_sand"])
def test_fixes_up_to_5_s_late_and_out_of_order_give_the_same_result(terrain: str) -> None:
    """At the end both have seen the same; both start from the same fixes (another start is 2 cm off)."""
    recording = winding(terrain=terrain)
    rng = np.random.default_rng(7)
    inorder = messages(recording)
    end = inorder[-1][0]

    def late(message: Message) -> Message:
        arrival, t_ns, name, i = message
        started = t_ns - recording.start_ns > 6e9
        delay = round(rng.uniform(0.0, 5e9)) if name == "gnss" and started else 0
        return (min(arrival + delay, max(arrival, end - 500_000_000)), t_ns, name, i)

    shuffled = [late(m) for m in inorder]
    fixes = [m for m in sorted(shuffled) if m[2] == "gnss"]
    assert any(a[1] > b[1] for a, b in itertools.pairwise(fixes))
    here, there = feed(recording, inorder), feed(recording, shuffled)
    assert there.estimator.gnss.too_late == here.estimator.gnss.too_late
    assert np.linalg.norm(here.end() - there.end()) < 0.01


def test_a_fix_exactly_5_s_late_is_used(drive: Recording) -> None:
    arriving = [
        (a + (5_000_000_000 if name == "gnss" else 0), t, name, i) for a, t, name, i in messages(drive)
    ]
    end = max(a for a, _, name, _ in arriving if name == "imu")
    fed = feed(drive, [m for m in arriving if m[0] <= end])
    assert fed.estimator.gnss.too_late == plainly_driven().estimator.gnss.too_late
    assert errors_m(drive, fed.states)[-1] < 0.3


def test_a_fix_that_is_far_too_late_is_counted(drive: Recording) -> None:
    arriving = messages(drive)
    k = next(i for i, m in enumerate(arriving) if m[2] == "gnss" and m[1] - drive.start_ns > 10e9)
    _, t_ns, name, i = arriving[k]
    arriving[k] = (t_ns + 8_000_000_000, t_ns, name, i)
    prompt = plainly_driven().estimator.gnss.too_late
    assert feed(drive, arriving).estimator.gnss.too_late == prompt + 1


def test_wheels_and_imu_out_of_order_change_little(drive: Recording) -> None:
    rng = np.random.default_rng(3)
    arriving = [
        (a + (round(rng.uniform(0.0, 40e6)) if name != "gnss" else 0), t, name, i)
        for a, t, name, i in messages(drive)
    ]
    here, there = plainly_driven(), feed(drive, arriving)
    came = [m[1] for m in sorted(arriving) if m[2] == "imu"]
    assert sum(a > b for a, b in itertools.pairwise(came)) > 500
    # At the very start nothing is known of the lateness yet; after that the keyframes wait for it.
    assert there.estimator.imu.late.too_late <= 3
    assert np.linalg.norm(here.end() - there.end()) < 0.01


@pytest.mark.parametrize("mode", ["fixed", "adaptive"])
def test_a_jitter_of_1_us_moves_the_end_by_less_than_1_mm(drive: Recording, mode: str) -> None:
    rng = np.random.default_rng(5)
    jittered = [(a, t + round(rng.uniform(-1000, 1000)), name, i) for a, t, name, i in messages(drive)]
    moved = plainly_driven(mode).end() - feed(drive, jittered, mode).end()
    assert 0.0 < np.linalg.norm(moved) < 1e-3


def test_a_stream_sorts_what_comes_late_and_counts_what_comes_too_late() -> None:
    imu = ImuStream()
    for t in (0, 30, 10, 20, 40):
        imu.add(t * 1_000_000, [0.1 * t, 0.0, 0.0], [0.0, 0.0, 9.8])
    assert [float(g[0]) for g in imu.gyro] == pytest.approx([0.0, 1.0, 2.0, 3.0, 4.0])
    assert imu.late.wait_ns == 20_000_000
    assert imu.covers(20_000_000)
    assert not imu.covers(21_000_000)
    imu.late.used_ns = 35_000_000
    imu.add(32_000_000, np.zeros(3), [0.0, 0.0, 9.8])
    assert imu.late.too_late == 1
    assert len(imu.t_ns) == 5


@given(st.permutations(range(8)))
def test_wheel_distances_do_not_depend_on_the_order_of_arrival(order: list[int]) -> None:
    speeds = [0.0, 0.5, 0.7, 1.0, 0.2, -0.3, -0.1, 0.4]
    sorted_, shuffled = WheelStream(), WheelStream()
    for stream, sequence in ((sorted_, range(8)), (shuffled, order)):
        for i in sequence:
            stream.add(i * 50_000_000, speeds[i], 0.5 * speeds[i])
    a, b = sorted_.travelled(0, 350_000_000), shuffled.travelled(0, 350_000_000)
    assert a == pytest.approx(b, abs=1e-12)


# --- gates ---------------------------------------------------------------------------------------------


@settings(max_examples=300)
@given(
    history=st.lists(
        st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(1e-2, 10.0)), max_size=60
    ),
    offset=st.tuples(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0)),
    drift=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
    seed=st.integers(0, 1000),
)
def test_good_fixes_are_never_locked_out(
    history: list[tuple[float, float, float]],
    offset: tuple[float, float],
    drift: tuple[float, float],
    seed: int,
) -> None:
    """Whatever came before and however wrong the estimate is and moves: one of ten good fixes is let in."""
    gate = GnssGate(GATE)
    for x, y, sigma in history:
        gate.test(np.array([x, y]), np.eye(2) * sigma**2)
    rng = np.random.default_rng(seed)
    sigma = 0.02
    good = [np.array(offset) + i * np.array(drift) + rng.normal(0.0, sigma, 2) for i in range(10)]
    verdicts = [gate.test(fix, np.eye(2) * sigma**2)[0] for fix in good]
    assert any(v is not GateDecision.REJECT for v in verdicts)


def test_whatever_comes_the_gate_opens_in_the_end() -> None:
    gate = GnssGate(GATE)
    rng = np.random.default_rng(1)
    verdicts = [gate.test(rng.normal(0, 500.0, 2), np.eye(2))[0] for _ in range(40)]
    assert GateDecision.REACQUIRE in verdicts[30:]


# --- receivers that lie --------------------------------------------------------------------------------


def nis_after(fed: Fed, start_ns: int, after_s: float) -> np.ndarray:
    return np.array(
        [i.nis for i in fed.innovations if i.sensor == "gnss" and i.t_ns - start_ns > after_s * 1e9]
    )


@pytest.mark.parametrize(("claimed_m", "true_m"), [(3.0, 30.0), (0.01, 0.5)])
def test_a_receiver_that_lies_is_weighted_by_its_scatter(claimed_m: float, true_m: float) -> None:
    honest = winding(60.0, seed=6)
    gnss = honest.gnss
    assert gnss is not None
    rng = np.random.default_rng(8)
    t = (gnss.t_ns - honest.start_ns) * 1e-9
    lie = rng.normal(0.0, true_m, gnss.enu_m.shape) * (t > 15.0)[:, None]
    claims = np.where(t > 15.0, claimed_m, 0.02)[:, None]
    recording = with_fixes(honest, gnss.enu_m + lie, claims)
    fed = feed(recording, messages(recording))
    found = fed.estimator.gnss.fix_noise
    taken_m = max(claimed_m, found.sheet_sigma_m)  # no receiver is better than its data sheet
    assert taken_m * found.scale == pytest.approx(true_m, rel=0.5)
    late = nis_after(fed, honest.start_ns, 25.0)
    assert 0.3 < late.mean() / 2.0 < 2.0
    assert errors_m(honest, fed.states).max() < 2.0


def test_an_honest_receiver_is_taken_at_its_word() -> None:
    assert plainly_driven().estimator.gnss.fix_noise.scale == 1.0


def test_noise_that_is_new_at_every_fix_is_told_from_a_drift(drive: Recording) -> None:
    """As much error in all: taken for a drift it would be believed twice over."""
    truth, gnss = drive.truth, drive.gnss
    assert truth is not None
    assert gnss is not None
    antenna = truth.points_at(gnss.t_ns, load_vehicle("elevate").rig().sensors.gnss.antenna_m)
    noise = np.random.default_rng(3).normal(0.0, 0.1, antenna.shape)
    white = with_fixes(drive, antenna + noise, np.full((len(antenna), 1), 0.1))
    fed = feed(white, messages(white))
    assert fed.estimator.gnss.fix_noise.white > 0.5
    late = nis_after(fed, drive.start_ns, 15.0) * fed.estimator.weights.noise.gnss_inflation**2
    assert 0.6 < late.mean() / 2.0 < 1.5
    slow = with_fixes(drive, antenna + np.array([0.1, -0.07, 0.0]), np.full((len(antenna), 1), 0.1))
    assert feed(slow, messages(slow)).estimator.gnss.fix_noise.white == WHITE_SHARE


def test_one_spike_of_707_m_moves_the_pose_by_less_than_10_cm(drive: Recording) -> None:
    gnss = drive.gnss
    assert gnss is not None
    enu = gnss.enu_m.copy()
    enu[len(enu) // 2] += [500.0, 500.0, 0.0]
    spiked = with_fixes(drive, enu, gnss.sigma_enu_m)
    a, b = plainly_driven(), feed(spiked, messages(spiked))
    moved = np.array([s.position_m for s in a.states]) - np.array([s.position_m for s in b.states])
    assert np.hypot(*moved[:, :2].T).max() < 0.1
    assert b.estimator.gnss.rejected == a.estimator.gnss.rejected + 1


# --- outages and classes of fix ------------------------------------------------------------------------


def steps_in_sigmas(states: list[State]) -> tuple[np.ndarray, np.ndarray]:
    """Times (N,) and how far each state is from where the one before it was going, over its own sigma."""
    out = []
    for a, b in itertools.pairwise(states):
        dt = (b.t_ns - a.t_ns) * 1e-9
        step = (b.position_m - a.position_m - 0.5 * dt * (a.velocity_mps + b.velocity_mps))[:2]
        P = a.covariance[:2, :2] + dt**2 * a.velocity_covariance[:2, :2]
        out.append(float(np.sqrt(step @ np.linalg.solve(P, step))))
    return np.array([s.t_ns for s in states[1:]]), np.array(out)


@pytest.mark.parametrize("terrain", ["asphalt", "loose_sand"])
def test_the_pose_is_continuous_across_an_outage_within_its_sigma(terrain: str) -> None:
    """The first fix after 20 s without one moves the pose by no more than three of the sigmas it had."""
    recording = winding(45.0, seed=9, terrain=terrain)
    start = recording.start_ns
    arriving = [m for m in messages(recording) if m[2] != "gnss" or not 15e9 < m[1] - start < 35e9]
    fed = feed(recording, arriving, "adaptive")
    t, steps = steps_in_sigmas(fed.states)
    assert steps[(t - start) > 5e9].max() < 3.0
    assert errors_m(recording, fed.states)[-20:].max() < 0.15


def test_a_change_of_class_is_no_jump() -> None:
    """RTK, then 10 s of a stand-alone receiver 2 m off, then RTK again."""
    recording = winding(40.0, seed=10)
    gnss = recording.gnss
    assert gnss is not None
    t = (gnss.t_ns - recording.start_ns) * 1e-9
    single = (t > 15.0) & (t < 25.0)
    rng = np.random.default_rng(2)
    enu = gnss.enu_m + single[:, None] * (np.array([1.5, -1.3, 0.0]) + rng.normal(0.0, 0.3, gnss.enu_m.shape))
    sigma = np.where(single, 1.5, 0.02)[:, None] * np.ones(3)
    changed = dataclasses.replace(
        gnss, enu_m=enu, sigma_enu_m=sigma, fix=np.where(single, Fix.SINGLE, gnss.fix).astype(np.uint8)
    )
    worse = dataclasses.replace(recording, gnss=changed)
    fed = feed(worse, messages(worse), "adaptive")
    when, steps = steps_in_sigmas(fed.states)
    assert steps[(when - recording.start_ns) > 5e9].max() < 3.0
    assert errors_m(recording, fed.states).max() < 0.5
    assert errors_m(recording, fed.states)[-50:].max() < 0.1


@pytest.mark.parametrize("sigma", [None, [np.nan] * 3, [1e-9] * 3, [1e6] * 3, [0.0] * 3])
@pytest.mark.parametrize(("fix", "expected"), [("fixed", 0.02), (Fix.FLOAT, 0.5), (1, 3.0)])
def test_a_senseless_claim_gives_way_to_the_class(sigma: object, fix: object, expected: float) -> None:
    taken = checked_fix(0, np.zeros(3), sigma, None, float("nan"), fix)  # type: ignore[arg-type]
    assert taken is not None
    assert taken.sigma_m.tolist() == [expected, expected, 2.0 * expected]


def test_a_sensible_claim_stays_and_no_fix_is_none() -> None:
    taken = checked_fix(0, np.zeros(3), [0.1, 0.2, 0.3], None, float("nan"), "dgps")
    assert taken is not None
    assert taken.sigma_m.tolist() == [0.1, 0.2, 0.3]
    assert checked_fix(0, np.full(3, np.nan), None, None, float("nan"), "none") is None


@pytest.mark.parametrize(
    ("fix", "match"), [("rtk", "unknown class"), (9, "unknown class"), (None, "not positive")]
)
def test_a_fix_without_a_sigma_or_of_an_unknown_class_is_refused(fix: object, match: str) -> None:
    with pytest.raises(DataError, match=match):
        checked_fix(0, np.zeros(3), None, None, float("nan"), fix)  # type: ignore[arg-type]


def test_fixes_of_a_robot_that_stood_show_no_heading_whatever_else_was_seen() -> None:
    # Three fixes far off take each other's part until only those at rest are left: one place, no direction.
    rest = [(0j, 0.1 * complex(np.cos(k), np.sin(k))) for k in range(9)]
    wild = [(1 + 0j, -2 + 31j), (2 + 0j, -18 - 22j), (3 + 0j, -24 - 38j)]
    track = DeadReckoning(np.zeros(3))
    track.pairs = [FixPair(i, z, fix, 1.0) for i, (z, fix) in enumerate([*rest, *wild])]
    assert track.heading_correction(0.1, 1.0) is None


def with_wheels(recording: Recording, more_mps: np.ndarray) -> Recording:
    """The same drive with all wheels faster by `more_mps`, one for each of their samples."""
    wheels = recording.wheels
    assert wheels is not None
    speed = wheels.speed + more_mps[:, None] / load_vehicle("elevate").wheel.radius_m
    return dataclasses.replace(recording, wheels=dataclasses.replace(wheels, speed=speed))


@pytest.mark.parametrize("mode", ["adaptive", "fixed", "robust", "innovation"])
def test_a_counter_of_the_wheels_that_jumps_moves_the_pose_by_less_than_2_cm(
    drive: Recording, mode: str
) -> None:
    """Wherever in a keyframe or between two it falls."""
    assert drive.wheels is not None
    t_ns = drive.wheels.t_ns
    more_mps = np.zeros(len(t_ns))
    for jump_m, at_s in ((0.1, 12.0), (0.2, 16.02), (-0.5, 20.05), (5.0, 24.0)):
        k = int(np.searchsorted(t_ns, drive.start_ns + round(at_s * 1e9)))
        more_mps[k] = jump_m / (float(t_ns[k] - t_ns[k - 1]) * 1e-9)
    spoilt = feed(with_wheels(drive, more_mps), messages(drive), mode)
    pairs = zip(plainly_driven(mode).states, spoilt.states, strict=True)
    assert max(np.linalg.norm(a.position_m - b.position_m) for a, b in pairs) < 0.02


def test_wheels_that_break_loose_for_a_second_hardly_move_the_pose(drive: Recording) -> None:
    """1 m/s faster within 0.1 s, where no fix tells: half a metre more on their counter."""
    assert drive.wheels is not None
    t_s = (drive.wheels.t_ns - drive.start_ns) * 1e-9
    loose = with_wheels(drive, np.interp(t_s, [20.0, 20.1, 20.5, 20.6], [0.0, 1.0, 1.0, 0.0]))
    heard = [m for m in messages(drive) if m[2] != "gnss" or m[1] - drive.start_ns < 18e9]
    plain, spoilt = (feed(recording, heard) for recording in (drive, loose))
    pairs = zip(plain.states, spoilt.states, strict=True)
    assert max(np.linalg.norm(a.position_m - b.position_m) for a, b in pairs) < 0.1


@pytest.mark.parametrize("terrain", ["loose_sand", "mud"])
def test_wheels_that_set_off_on_loose_ground_are_no_fault(terrain: str) -> None:
    recording = winding(terrain=terrain)
    fed = feed(recording, messages(recording), "adaptive")
    assert fed.estimator.wheels_rejected == 0
    assert max(abs(s.slip) for s in fed.states) > 0.05
