"""What the terrain detector is given, and what becomes of the noise by it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import terrafusion as tf
from terrafusion.datasets.core.errors import DataError
from terrafusion.fusion.benchmark.outage_plan import until
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.estimator.notes import notes_of
from terrafusion.fusion.grounds.memory import GroundMemory
from terrafusion.fusion.noise.labels import GroundLabels
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import replay
from terrafusion.fusion.terrain.features import Window
from terrafusion.fusion.weighting.adaptive import TerrainNoise
from terrafusion.twin.model.vehicle import as_vehicle


@pytest.mark.parametrize("wheels_hz", [5.0, 20.0])
def test_windows_have_the_time_and_acceleration_that_passed(wheels_hz: float) -> None:
    """Steadily 0.2 m/s2 for 20 s; wheels at 5 Hz make keyframes, and so windows, 0.6 s apart."""
    estimator = Estimator(EstimatorConfig(as_vehicle("husky").rig(), "husky"))
    seen: list[Window] = []
    detector = estimator.weights.detector
    update = detector.update
    detector.update = lambda window: (seen.append(window), update(window))[1]  # type: ignore[method-assign]
    estimator.set_start([0.0, 0.0, 0.0], 0.0)
    times = [(t, "imu") for t in np.arange(0.0, 20.0, 0.01)]
    times += [(t, "wheels") for t in np.arange(0.0, 20.0, 1.0 / wheels_hz)]
    for t, sensor in sorted(times):
        t_ns = 10**18 + round(t * 1e9)
        if sensor == "imu":
            estimator.add_imu(t_ns, [0.0, 0.0, 0.0], [0.2, 0.0, 9.81])
        else:
            estimator.add_wheels(t_ns, 0.2 * t, 0.2 * t)
    assert len(seen) > 20
    passed = 0.5 if wheels_hz == 20.0 else 0.6
    assert [w.dt_s for w in seen[1:]] == pytest.approx([passed] * (len(seen) - 1))
    rates = [w.wheel_speed_rate_mps2 for w in seen[3:]]
    assert rates == pytest.approx([0.2] * len(rates), abs=0.02)


RECORDED = {
    "slip_mean": ("wheels", ""),
    "slip_sigma": ("wheels", ""),
    "wheel_sigma_mps": ("wheels", "m/s"),
    "side_slip_sigma": ("wheels", ""),
    "gyro_inflation": ("imu", ""),
    "gyro_yaw_inflation": ("imu", ""),
    "accel_inflation": ("imu", ""),
    "gnss_inflation": ("gnss", ""),
}


def noise_of(vehicle: str = "husky", **options: object) -> TerrainNoise:
    return TerrainNoise(EstimatorConfig(as_vehicle(vehicle).rig(), vehicle, **options))  # type: ignore[arg-type]


def test_a_policy_of_other_grounds_than_the_detector_knows_is_noted() -> None:
    rig, shipped = as_vehicle("elevate").rig(), load_policy()
    lawn = dataclasses.replace(
        shipped, classes={"lawn": shipped.classes["asphalt"], "unknown": shipped.classes["unknown"]}
    )
    for policy, noted in ((shipped, False), (lawn, True)):
        notes = notes_of(Estimator(EstimatorConfig(rig, "elevate", policy=policy)))
        assert any("none of the grounds that the terrain model knows" in note for note in notes) is noted


def test_a_switch_is_the_share_that_changed_ground_since_it_was_last_asked() -> None:
    weights = noise_of("elevate")
    before = np.array(list(weights.posterior().values()))
    weights.external(0, {name: float(name == "mud") for name in weights.posterior()})
    after = np.array(list(weights.posterior().values()))
    assert weights.take_switch() == pytest.approx(0.5 * np.abs(after - before).sum())
    assert weights.take_switch() == 0.0
    fixed = noise_of("elevate", mode="fixed")
    fixed.external(0, {name: float(name == "mud") for name in fixed.posterior()})
    assert fixed.take_switch() == 0.0


@pytest.mark.parametrize(("label", "renewed"), [("asphalt", False), ("gravel", True), ("", True)])
def test_a_label_rules_over_changes_among_grounds_that_the_robot_found(label: str, renewed: bool) -> None:
    """Slips of 0 and 0.4 were found on two grounds; no class describes gravel."""
    weights = noise_of("husky", labels=GroundLabels((0,), (label,)) if label else None)
    weights.begin(0)
    for ground in (1, 2):
        weights._ground_slip.recognise(np.eye(3)[ground])
        for _ in range(120):
            weights._ground_slip.learn(0.4 * (ground - 1), 0.02, 0.0, 0.5)
    weights.take_switch()
    weights._ground_slip.recognise(np.eye(3)[1])
    assert (weights.take_switch() > 0.1) == renewed


@pytest.mark.parametrize("robot", ["husky", "elevate"])
def test_slip_that_the_robot_shows_is_that_of_ground_no_class_describes(robot: str) -> None:
    fixed, adaptive = noise_of(robot, mode="fixed"), noise_of(robot)
    for weights in (fixed, adaptive):
        weights.learn_grade_slip(0.1)
        weights.learn_slip(0.3, 0.07, 0.2, 5)
    assert fixed.noise.slip_per_grade == 0.1
    assert (fixed.noise.slip_mean, fixed.noise.slip_sigma, fixed.noise.slip_time_s) == (0.3, 0.07, 0.2)
    knows_its_grounds = robot == "elevate"
    assert (adaptive.noise.slip_mean == pytest.approx(0.3)) != knows_its_grounds
    assert (adaptive.noise.slip_sigma == pytest.approx(0.07)) != knows_its_grounds
    assert (adaptive.noise.slip_per_grade == pytest.approx(0.1)) != knows_its_grounds
    assert adaptive.noise.slip_time_s == pytest.approx(0.2), "of all grounds"


def test_no_slip_lasts_longer_than_the_policy_says() -> None:
    weights = noise_of("husky", mode="fixed")
    weights.learn_slip(0.0, 0.05, 1000.0, 0)
    assert weights.noise.slip_time_s == weights.policy.fixed.slip_time_s
    weights = noise_of("elevate")
    times_s = weights.policy.slips()[3]
    for own_s in (1000.0, 10.0):
        weights.learn_slip(0.0, 0.05, own_s, 0)
        share = np.array(list(weights.posterior().values()))
        assert weights.noise.slip_time_s == pytest.approx(share @ np.minimum(times_s, own_s))


def test_changes_of_the_noise_are_recorded_from_a_tenth_on_with_their_reason() -> None:
    weights = noise_of("elevate")
    weights.external(0, {"mud": 0.9, "asphalt": 0.1})
    assert weights.take_changes() == []  # not begun
    weights.begin(7)
    now, pooled = dataclasses.asdict(weights.noise), dataclasses.asdict(weights.policy.fixed)
    names = {change.reason.split(":")[0]: change for change in weights.take_changes()}
    for name, before in pooled.items():
        if name in RECORDED:
            moved = abs(now[name] - before) > 0.1 * max(abs(before), 0.02)
            assert (name in names) == moved, name
    assert "slip_mean" in names
    for name, change in names.items():
        assert (change.t_ns, change.before, change.after) == (7, pooled[name], now[name])
        assert (change.sensor, change.unit) == RECORDED[name]
        p = weights.posterior()
        best = max(p, key=p.__getitem__)
        assert change.reason == f"{name}: terrain {best} p = {p[best]:.2f} (external source)"
    weights.begin(8)
    assert {change.t_ns for change in weights.take_changes()} == {8}
    assert weights.take_changes() == []


def test_a_fast_camera_counts_as_much_as_a_slow_one() -> None:
    said = {"mud": 0.6, "loose_sand": 0.4}
    after = []
    for hz in (2, 30):
        weights = noise_of("elevate")
        for k in range(hz + 1):
            weights.external(round(k / hz * 1e9), said)
        after.append(list(weights.posterior().values()))
    assert after[0] == pytest.approx(after[1], abs=1e-3)


def test_pictures_of_one_ground_count_once_while_the_robot_stands() -> None:
    """After a minute before one place, a camera that was half sure of mud had made it 0.999."""
    weights, empty = noise_of("elevate"), np.zeros((0, 3))
    weights.window = Window(0.5, np.zeros(0), empty, empty, 0.0, 0.0, 0.0, 0.0, 0.0)
    for k in range(120):
        weights.external(k * 500_000_000, {"mud": 0.5, "asphalt": 0.4, "loose_sand": 0.1})
    assert weights.posterior()["mud"] == pytest.approx(0.5, abs=0.03)
    weights.window = dataclasses.replace(weights.window, speed_mps=1.0, wheel_speed_mps=1.0)
    for k in range(120, 180):
        weights.external(k * 500_000_000, {"mud": 0.5, "asphalt": 0.4, "loose_sand": 0.1})
    assert weights.posterior()["mud"] > 0.9


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"lava": 1.0}, "unknown class 'lava'.*the policy knows .*mud"),
        ([0.5, 0.5], "names no classes"),
        ({"mud": float("nan")}, "probabilities"),
        ({"mud": -1.0}, "probabilities"),
    ],
)
def test_probabilities_that_are_none_are_refused(given: object, said: str) -> None:
    weights = noise_of()
    before = weights.posterior()
    with pytest.raises(DataError, match=said):
        weights.external(0, given)  # type: ignore[arg-type]
    assert weights.posterior() == before


def test_what_probabilities_miss_to_one_is_unknown_ground() -> None:
    """A camera that gave mud 5 % and nothing else was taken to be certain of it."""
    partial, whole, rounded, sure = (noise_of() for _ in range(4))
    for k in range(5):
        partial.external(k * 500_000_000, {"mud": 0.05})
        whole.external(k * 500_000_000, {"mud": 0.05, "unknown": 0.95})
        rounded.external(k * 500_000_000, {"mud": 0.992})
        sure.external(k * 500_000_000, {"mud": 1.0})
    assert partial.posterior() == whole.posterior()
    assert partial.posterior()["mud"] < 0.05
    assert rounded.posterior() == sure.posterior()


def test_the_window_of_the_detector_is_that_of_the_last_second() -> None:
    """Wheels on a circle: 1.0 and 1.5 m/s on a track of 0.55 m."""
    seen = list[Window]()
    rig = as_vehicle("husky").rig()
    estimator = Estimator(EstimatorConfig(rig, "husky"))
    detector = estimator.weights.detector
    update = detector.update
    detector.update = lambda window: (seen.append(window), update(window))[1]  # type: ignore[method-assign]
    estimator.set_start([0.0, 0.0, 0.0], 0.0)
    rate = 0.5 / rig.track_m
    for i in range(600):
        t_ns = 10**18 + i * 10_000_000
        estimator.add_imu(t_ns, [0.0, 0.0, rate], [0.0, 0.0, 9.81])
        if i % 5 == 0:
            estimator.add_wheels(t_ns, 1.0, 1.5)
    last = seen[-1]
    assert last.wheel_speed_mps == pytest.approx(1.25)
    assert last.yaw_rate_wheels_radps == pytest.approx(rate)
    assert last.yaw_rate_gyro_radps == pytest.approx(rate, rel=0.01)
    assert last.imu_t_s[-1] - last.imu_t_s[0] == pytest.approx(1.0, abs=0.02)
    assert (last.slip, last.slip_sigma) == (None, None)  # no fixes: the slip is what its prior says


@pytest.mark.parametrize(("robot", "shakes_like_the_policy"), [("elevate", True), ("warthog", False)])
def test_a_label_says_how_the_imu_shakes_of_the_robot_of_the_policy_alone(
    robot: str, shakes_like_the_policy: bool
) -> None:
    """A Warthog on real asphalt was 3.05 m off after 30 s without fixes with the label, 0.52 m without."""
    weights = noise_of(robot, labels=GroundLabels((0,), ("asphalt",)))
    weights.begin(0)
    asphalt, pooled = weights.policy.classes["asphalt"], noise_of(robot, mode="fixed").noise
    shaken = noise_of("elevate").policy.classes["asphalt"] if shakes_like_the_policy else pooled
    assert weights.noise.slip_mean == pytest.approx(asphalt.slip_mean)
    assert weights.noise.gyro_axes() == pytest.approx(shaken.gyro_axes())
    assert weights.noise.accel_inflation == pytest.approx(shaken.accel_inflation)


@pytest.mark.parametrize("robot", ["elevate", "husky"])
def test_a_label_without_credit_leaves_what_the_detector_makes_of_the_ground(robot: str) -> None:
    """A class that is as likely as not has no weight on a robot that the model does not know."""
    told, alone = noise_of(robot, labels=GroundLabels((0,), ("mud",))), noise_of(robot)
    told.detector.credit._odds = -60.0
    evidence = np.log([0.01, 0.01, 0.45, 0.01, 0.45]) - np.log(alone.detector.probabilities)
    for weights in (told, alone):
        weights.detector._filter.update(evidence)
        weights.begin(0)
    assert dataclasses.astuple(told.noise) == pytest.approx(dataclasses.astuple(alone.noise))
    assert "(label)" not in told.take_changes()[0].reason


def test_noise_begins_on_the_level() -> None:
    weights = noise_of("elevate")
    weights.begin(0)
    p = np.array(list(weights.posterior().values()))
    assert weights.noise == weights.policy.blend(p, 0.0, weights.policy.slips())


def test_grounds_are_learned_where_no_model_knows_them_or_a_memory_is_given() -> None:
    assert noise_of("elevate").learned_grounds() is None
    for memory in (
        noise_of("husky").learned_grounds(),
        noise_of("elevate", grounds=GroundMemory()).learned_grounds(),
    ):
        assert memory is not None
        assert len(memory) == 0


def test_each_keyframe_tells_which_ground_the_robot_found() -> None:
    drive = until(tf.simulate("figure_eight", terrain="asphalt", seed=3), 15.0)
    found = replay(drive, vehicle="husky", findings=())
    assert found.estimate.found_ground is not None
    assert {*found.found_shares} == {*found.estimate.found_ground} - {""} != set()
    assert set(found.estimate.ground()) <= {*found.found_shares, *found.estimate.classes}


@pytest.mark.parametrize(("label", "believed"), [("asphalt", True), ("mud", False)])
def test_a_label_that_wheels_and_imu_contradict_is_not_believed(label: str, believed: bool) -> None:
    """The terrain model knows the robot; a wrong label must not teach the slip of its ground either."""
    drive = until(tf.simulate("figure_eight", terrain="asphalt", seed=3), 20.0)
    seen = list[TerrainNoise]()
    told = replay(
        drive,
        settings={"labels": GroundLabels((drive.start_ns,), (label,))},
        findings=(),
        watch=lambda estimator: seen.append(estimator.weights),
    )
    assert told.estimate.dominant_terrain()[-1] == "asphalt"
    assert (seen[-1].detector.credit.value == 1.0) == believed
    policy, classes = seen[-1].policy, seen[-1].detector.classes
    mud = classes.index("mud")
    assert seen[-1]._driven.posterior()[0][mud] == policy.slips()[0][mud]
