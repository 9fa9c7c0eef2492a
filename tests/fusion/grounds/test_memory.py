"""Ground memory: clusters without labels, distrust of refuted memory, merging, the file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.grounds.file import load_grounds, save_grounds
from terrafusion.fusion.grounds.ground import FRICTION_MODELS, Ground, Tally
from terrafusion.fusion.grounds.learner import StretchMeter
from terrafusion.fusion.grounds.memory import DWELL, MOST_GROUNDS, GroundMemory, after_drive, merged
from terrafusion.fusion.grounds.signature import SIGNATURE, VIBRATION, SignatureExtractor
from terrafusion.fusion.terrain.features import Window

SMOOTH, ROUGH = 1.2, 2.0


def signature(
    level: float, rng: np.random.Generator, yaw_slip: float = 0.4, spread: float = 0.2
) -> np.ndarray:
    out = np.full(len(SIGNATURE), np.nan)
    out[: len(VIBRATION)] = level + spread * rng.normal(size=len(VIBRATION))
    out[SIGNATURE.index("yaw_slip")] = yaw_slip + 0.05 * rng.normal()
    return out


def drive(memory: GroundMemory, level: float, rng: np.random.Generator, windows: int) -> list[int]:
    """Most probable ground after each window."""
    found = []
    for _ in range(windows):
        memory.recognise(signature(level, rng), 0.5)
        memory.learn("")
        found.append(int(memory.belief.argmax()))
    return found


def two_grounds(seed: int = 0) -> GroundMemory:
    rng, memory = np.random.default_rng(seed), GroundMemory()
    drive(memory, SMOOTH, rng, 120)
    drive(memory, ROUGH, rng, 120)
    return memory.condensed()


@pytest.mark.parametrize("seed", range(5))
def test_two_grounds_are_found_without_labels_and_recognised(seed: int) -> None:
    memory = two_grounds(seed)
    levels = [g.signature.mean[0] for g in memory.grounds]
    assert len(memory) == 2
    assert sorted(levels) == pytest.approx([SMOOTH, ROUGH], abs=0.1)
    rng = np.random.default_rng(100 + seed)
    for level in (ROUGH, SMOOTH):
        wanted = 1 + int(np.argmin(np.abs(np.array(levels) - level)))
        found = drive(memory, level, rng, 40)
        assert np.mean(np.array(found[8:]) == wanted) > 0.95


def test_one_ground_stays_one() -> None:
    memory, rng = GroundMemory(), np.random.default_rng(3)
    drive(memory, SMOOTH, rng, 400)
    assert len(memory.condensed()) == 1


def test_a_ground_met_late_is_learned_beside_one_known_for_long() -> None:
    """Its spread is not known yet; that of the first is small, which says nothing of the second."""
    memory, rng = GroundMemory(), np.random.default_rng(7)
    for level in (SMOOTH,) * 600 + (SMOOTH + 0.4,) * 100:
        memory.recognise(signature(level, rng, spread=0.06), 0.5)
        memory.learn("")
    assert len(memory) == 2
    assert memory.grounds[1].windows > 80


def test_without_fixes_a_ground_is_that_of_today_where_an_earlier_one_felt_the_same() -> None:
    """Tyres are changed overnight: the ground feels as before, and slips by .05, not by .3."""
    rng, slip = np.random.default_rng(11), SIGNATURE.index("slip")

    def driven(memory: GroundMemory, slipping: float, windows: int) -> None:
        for _ in range(windows):
            window = signature(SMOOTH, rng, spread=0.06)
            window[slip] = slipping + 0.01 * rng.normal()
            memory.recognise(window, 0.5)
            memory.learn("")

    monday = GroundMemory()
    driven(monday, 0.3, 400)
    tuesday = monday.condensed()
    driven(tuesday, 0.3, 40)
    assert not tuesday.contradicted()
    tuesday = tuesday.condensed()
    driven(tuesday, 0.05, 60)
    assert tuesday.contradicted()
    for _ in range(40):
        tuesday.recognise(signature(SMOOTH, rng, spread=0.06), 0.5)
    assert tuesday.belief.argmax() == len(tuesday) == 2


def test_a_ground_is_not_made_by_a_few_strange_windows() -> None:
    memory, rng = GroundMemory(), np.random.default_rng(4)
    drive(memory, SMOOTH, rng, 100)
    drive(memory, ROUGH, rng, DWELL // 2)
    drive(memory, SMOOTH, rng, 20)
    assert len(memory) == 1


def test_a_tally_gives_mean_and_variance_less_that_of_the_measurement() -> None:
    rng = np.random.default_rng(5)
    values, tally = rng.normal(0.2, 0.3, size=(1500, 1)), Tally.empty(1)
    for value in values:
        tally = tally.plus(value, noise=0.04)
    assert tally.mean[0] == pytest.approx(values.mean(), abs=1e-9)
    assert tally.square[0] == pytest.approx(
        values.var() - 0.04 * sum(1 / np.arange(1, 1501)) / 1500, abs=0.05
    )


@pytest.mark.parametrize("cut", [1, 300, 600])
def test_tallies_of_two_parts_are_that_of_the_whole(cut: int) -> None:
    values = np.random.default_rng(6).normal(size=(700, 2))
    parts = [Tally.empty(2), Tally.empty(2), Tally.empty(2)]
    for i, value in enumerate(values):
        parts[0] = parts[0].plus(value)
        parts[1 if i < cut else 2] = parts[1 if i < cut else 2].plus(value)
    both = parts[1].merged(parts[2])
    for name in ("count", "mean", "square"):
        np.testing.assert_allclose(getattr(both, name), getattr(parts[0], name), rtol=1e-9)


def state(t_s: float, x_m: float, sigma_m: float = 0.02, status: str = "running") -> State:
    zero = np.zeros(3)
    return State(
        t_ns=round(t_s * 1e9), position_m=np.array([x_m, 0.0, 0.0]),
        quaternion=np.array([0.0, 0.0, 0.0, 1.0]),
        velocity_mps=np.array([1.0, 0.0, 0.0]), angular_velocity_radps=zero, gyro_bias_radps=zero,
        accel_bias_mps2=zero, slip=0.0, terrain={}, status=status, covariance=np.eye(6) * sigma_m**2,
        **{name: _filler(name) for name in _OTHERS},
    )  # fmt: skip


_GIVEN = {
    "t_ns", "position_m", "quaternion", "velocity_mps", "angular_velocity_radps", "gyro_bias_radps",
    "accel_bias_mps2", "slip", "terrain", "status", "covariance",
}  # fmt: skip
_OTHERS = [
    f.name for f in dataclasses.fields(State) if f.name not in _GIVEN and f.default is dataclasses.MISSING
]


def _filler(name: str) -> Any:
    return np.eye(3) if name == "velocity_covariance" else np.eye(6) if name == "twist_covariance" else 0.0


def test_stretches_measure_slip() -> None:
    meter, found = StretchMeter(), []
    for i in range(200):
        stretch = meter.add(state(0.5 * i, 0.5 * i * 0.8), 0.5)
        if stretch is not None:
            found.append(stretch)
    assert len(found) >= 20
    assert [s.slip for s in found] == pytest.approx([0.2] * len(found), abs=1e-9)
    assert [s.side for s in found] == pytest.approx([0.0] * len(found), abs=1e-9)


def test_friction_of_a_ground_is_the_mean_of_its_windows() -> None:
    rng, memory = np.random.default_rng(8), GroundMemory()
    friction = np.eye(FRICTION_MODELS)[3]
    for _ in range(120):
        memory.recognise(signature(SMOOTH, rng), 0.5)
        memory.learn("", friction)
    assert memory.grounds[0].friction[3] > 0.95


def test_robots_of_one_type_share_their_grounds() -> None:
    both = merged([two_grounds(1), two_grounds(2)])
    assert len(both) == 2
    assert both.grounds[0].windows > two_grounds(1).grounds[0].windows


def test_a_memory_given_twice_counts_once() -> None:
    one = two_grounds(1)
    both = merged([one, one.named({"ground 1": "lawn"}), one])
    assert [g.windows for g in both.grounds] == sorted((g.windows for g in one.grounds), reverse=True)


def test_a_memory_beside_the_one_it_began_counts_once(tmp_path: Path) -> None:
    monday, path = two_grounds(1), tmp_path / "grounds.yaml"
    save_grounds(monday, path)
    tuesday, rng = load_grounds(path), np.random.default_rng(9)
    tuesday.grounds = [g.seen(signature(SMOOTH, rng), 1.0, "") for g in tuesday.grounds]
    for given in ([monday, tuesday], [tuesday, monday]):
        windows = [g.windows for g in merged(given).grounds]
        assert windows == sorted((g.windows for g in tuesday.grounds), reverse=True)


def test_a_file_of_robots_without_a_vehicle_file_says_so(tmp_path: Path) -> None:
    memory, path = two_grounds(), tmp_path / "grounds.yaml"
    memory.robot = "my_robot"
    assert save_grounds(memory, path) == f"2 grounds of 'my_robot' to {path}"
    memory.robot = "generic"
    assert "keep a file a robot, or give --vehicle" in save_grounds(memory, path)


def test_drives_that_are_counted_stay_marked(tmp_path: Path) -> None:
    one, path = two_grounds(1), tmp_path / "grounds.yaml"
    one.drives = ("a", "b")
    save_grounds(merged([one.named({"ground 1": "lawn"}), GroundMemory(drives=("b", "c"))]), path)
    known = load_grounds(path).copy()
    assert known.drives == ("a", "b", "c")
    learned = two_grounds(2)
    assert after_drive(known, learned, "b") is known
    assert after_drive(known, learned, "d").drives == ("d",)


def test_a_full_memory_counts_what_it_leaves_out() -> None:
    rng, memory = np.random.default_rng(5), GroundMemory()
    for i in range(MOST_GROUNDS):
        ground = Ground.new(f"ground {i + 1}")
        for _ in range(40):
            ground = ground.seen(signature(ROUGH, rng), 1.0, "")
        memory.grounds.append(ground)
    memory = memory.copy()
    for _ in range(60):
        memory.recognise(signature(SMOOTH, rng), 0.5)
        memory.learn("")
    assert len(memory) == MOST_GROUNDS
    assert memory.left_out > 40


def test_a_new_ground_takes_the_place_of_one_that_is_too_short_to_be_kept() -> None:
    """Changes of ground leave short ones behind, more of them the longer a drive lasts."""
    rng, places, grounds = np.random.default_rng(12), list[int | None](), list[Ground]()
    for i in range(MOST_GROUNDS):
        ground = Ground.new(f"ground {i + 1}")
        for _ in range(10 if i == 3 else 50):
            ground = ground.seen(np.full(len(SIGNATURE), 4.0 + i), 1.0, "")
        grounds.append(ground)
    memory = GroundMemory(grounds)
    for _ in range(60):
        memory.recognise(signature(SMOOTH, rng), 0.5)
        places.append(memory.learn(""))
    assert {place for place in places if place is not None} == {3}
    assert (len(memory), memory.left_out) == (MOST_GROUNDS, 0)
    assert memory.grounds[3].windows > 40


def test_many_grounds_of_several_robots_still_fit_into_a_file(tmp_path: Path) -> None:
    """Those that were seen longest are kept."""
    levels = np.linspace(-4.0, 4.0, MOST_GROUNDS + 3)
    memory = GroundMemory()
    for i, level in enumerate(levels.tolist()):
        ground = Ground.new(f"ground {i + 1}")
        for _ in range(40 + i):
            ground = ground.seen(np.full(len(SIGNATURE), level), 1.0, "")
        memory.grounds.append(ground)
    both = merged([GroundMemory(memory.grounds[:8]), GroundMemory(memory.grounds[8:])])
    save_grounds(both, tmp_path / "grounds.yaml")
    again = load_grounds(tmp_path / "grounds.yaml")
    assert len(again) == MOST_GROUNDS
    assert min(ground.windows for ground in again.grounds) == 43


def test_a_name_given_by_the_user_stays_and_two_of_one_name_become_one() -> None:
    memory = two_grounds().named({"ground 1": "lawn", "ground 2": "ground of stones"})
    assert {g.name for g in merged([two_grounds(1), memory]).grounds} == {"lawn", "ground of stones"}
    assert len(memory.named({"lawn": "ground of stones"})) == 1


def test_a_file_gives_the_same_memory_and_holds_no_position(tmp_path: Path) -> None:
    memory, path = two_grounds(), tmp_path / "grounds.yaml"
    save_grounds(memory, path)
    again = load_grounds(path)
    save_grounds(again, tmp_path / "again.yaml")
    assert path.read_bytes() == (tmp_path / "again.yaml").read_bytes()
    for own, other in zip(memory.grounds, again.grounds, strict=True):
        np.testing.assert_allclose(own.signature.mean, other.signature.mean, rtol=1e-5)
    assert not any(word in path.read_text() for word in ("position", "east", "lat", "x_m"))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("terrafusion.grounds/1", "terrafusion.grounds/9", "schema"),
        ("z_low", "z_lowest", "z_lowest"),
        ("name: ground 2", "name: ground 1", "different name"),
        ("friction_windows", "friktion_windows", "friktion_windows"),
        ("slip: {mean: 0.0", "slip: {mean: 27.0", "'slip' has mean 27; give a share"),
    ],
)
def test_a_wrong_file_is_refused_in_a_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "grounds.yaml"
    save_grounds(two_grounds(), path)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=said):
        load_grounds(path)


def window(speed: float, amplitude: float, rate_hz: float = 100.0, yaw: float = 0.0) -> Window:
    t = np.arange(int(rate_hz)) / rate_hz
    accel = np.zeros((len(t), 3))
    accel[:, 2] = 9.81 + amplitude * np.sin(2.0 * np.pi * 5.0 * t)
    return Window(0.5, t, np.zeros((len(t), 3)), accel, speed, 0.0, speed, yaw, 0.6 * yaw)


def test_vibration_is_a_band_of_its_own_and_missing_rates_are_not_guessed() -> None:
    extractor = SignatureExtractor()
    weak, strong = (extractor.extract(window(1.0, a)) for a in (0.5, 5.0))
    assert strong[0] - weak[0] == pytest.approx(1.0, abs=0.05)
    assert np.isnan(extractor.extract(window(1.0, 1.0, rate_hz=20.0))[1:3]).all()
    assert extractor.extract(window(1.0, 1.0, yaw=0.5))[SIGNATURE.index("yaw_slip")] == pytest.approx(0.4)


def test_a_standing_robot_gives_nothing() -> None:
    assert np.isnan(SignatureExtractor().extract(window(0.0, 0.01))).all()
