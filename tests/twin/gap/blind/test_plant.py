"""The plant of the blind check: its laws, its integrator, its agreement with the twin on firm ground."""

from __future__ import annotations

import ast
import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis.strategies import floats

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.gap.blind.plant import contact
from terrafusion.twin.gap.blind.plant.field import PlantSoilField
from terrafusion.twin.gap.blind.plant.machine import Machine, motor_current
from terrafusion.twin.gap.blind.plant.parameters import CHANGES
from terrafusion.twin.gap.blind.plant.run import record, simulate
from terrafusion.twin.gap.blind.plant.spec import RunSpec, Segment, stacked_numbers
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle
from tests.differences import differences
from tests.studies.blind.plant_against_twin import steady_differences

PLANT = Path(__file__).parents[4] / "twin" / "gap" / "blind" / "plant"
DRIVE = (Segment(1.0), Segment(3.0, 1.0), Segment(3.0, 0.8, 0.5), Segment(2.0, 0.0, -0.8), Segment(1.0))


def spec(soil: str = "medium_sand", drive: tuple[Segment, ...] = DRIVE, **more: object) -> RunSpec:
    options: dict[str, Any] = {"noiseless": True, **more}
    return RunSpec(load_vehicle("elevate"), load_soil(soil), drive, **options)


def machine(*soils: str, **state: float | np.ndarray) -> Machine:
    """One robot a soil with the motors' demand at zero unless it is told, in a given state."""
    some = [spec(soil) for soil in soils]
    found = Machine(stacked_numbers(some), PlantSoilField(some))
    for name, value in state.items():
        found.s[name] = np.zeros_like(found.s[name]) + value
    return found


Runs = dict[str, dict[str, np.ndarray]]


@pytest.fixture(scope="module")
def driven() -> Runs:
    """Runs of 10 s, in one call: on three grounds, mirrored, and at rest."""
    mirrored = tuple(dataclasses.replace(s, yaw_rate_radps=-s.yaw_rate_radps) for s in DRIVE)
    still = (Segment(10.0),)
    specs = {
        "medium_sand": spec("medium_sand"),
        "loose_sand": spec("loose_sand"),
        "grass": spec("grass"),
        "mirrored": spec("grass", mirrored),
        "level": spec(drive=still),
        "tilted": spec(drive=still, changes={"slope": 0.05}),
    }
    return dict(zip(specs, simulate([*specs.values()]), strict=True))


def test_it_takes_only_records_from_the_twin() -> None:
    """No equation of the twin: vehicle and soil records, nothing else."""
    allowed = {"terrafusion.twin.model.soil", "terrafusion.twin.model.vehicle"}
    for path in PLANT.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("terrafusion.twin."):
                own = node.module.startswith("terrafusion.twin.gap.blind.plant")  # type: ignore[union-attr]
                assert own or node.module in allowed, f"{path.name} imports {node.module}"


def test_stress_integrals_become_bekker_without_a_rear_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """With the peak at the bottom and n = 1 the integrals are 2/3 and 1/4: Bekker's."""
    monkeypatch.setattr(contact, "PEAK_SHARE", 1e-9)
    vertical, along = contact.stress_integrals.__wrapped__(1.0)
    assert vertical == pytest.approx(2.0 / 3.0, rel=1e-6)
    assert along == pytest.approx(0.25, rel=1e-6)


@given(floats(0.01, 20.0))
def test_shear_has_a_hump_and_a_residue(x: float) -> None:
    """The mean stress rises like half the initial slope, never above the peak, towards the residue."""
    mean = float(contact.mean_shear_over_share(np.array(x))) * x
    assert 0.0 < mean < 1.0
    assert mean <= 0.5 * contact.INITIAL_SLOPE * x * 1.001
    early = float(contact.mean_shear_over_share(np.array(1e-3)))
    assert early == pytest.approx(0.5 * contact.INITIAL_SLOPE, rel=5e-3)
    late = float(contact.mean_shear_over_share(np.array(400.0))) * 400.0
    assert late == pytest.approx(contact.RESIDUAL, abs=0.01)


def test_a_coasting_robot_never_gains_energy() -> None:
    """No motor, level ground: never more kinetic energy than at the start, whatever that was."""
    soils = ("asphalt", "loose_sand") * 10
    sizes = np.repeat([0.0, 0.01, 0.1, 0.5, 1.0], 4)
    u, v, r = sizes * np.random.default_rng(0).uniform(-1.0, 1.0, (3, len(soils)))
    coasting = machine(*soils, u=1.5 * u, v=0.3 * v, r=1.5 * r)
    coasting.n["loop_p"], coasting.n["loop_i"] = 0.0 * coasting.n["loop_p"], 0.0 * coasting.n["loop_i"]
    rest = np.zeros((2, 2, len(soils)))
    coasting.step(rest, 0.01, 4)
    energies = [coasting.energy_j()]
    for _ in range(100):
        coasting.step(rest, 0.01, 4)
        energies.append(coasting.energy_j())
    # A contact's shear holds energy and gives it back while the robot rocks to rest: from the start on,
    # nothing exceeds what there was, and what swings dies away.
    assert (np.max(energies, axis=0) <= energies[0] * (1.0 + 1e-9) + 1e-12).all()
    assert (np.max(energies[50:], axis=0) <= np.max(energies[:50], axis=0)).all()


def test_motors_pay_for_all_energy(driven: Runs) -> None:
    """Work of the motors exceeds the kinetic energy gained, at any time."""
    for run in (driven["medium_sand"], driven["loose_sand"]):
        kinetic = 16.0 * (run["u"] ** 2 + run["v"] ** 2) + 0.5 * 2.37 * run["r"] ** 2
        kinetic += 0.05 * (run["speed"] ** 2).sum(axis=1)
        assert (run["motor_work"] - kinetic).min() > -0.05


def test_left_and_right_are_alike(driven: Runs) -> None:
    """A mirrored drive makes the mirrored motion, to rounding."""
    a, b = driven["grass"], driven["mirrored"]
    for name, sign in (("x", 1), ("u", 1), ("y", -1), ("yaw", -1), ("v", -1), ("r", -1)):
        np.testing.assert_allclose(a[name], sign * b[name], atol=1e-8)
    np.testing.assert_allclose(a["speed"][:, [0, 2]], b["speed"][:, [1, 3]], atol=1e-8)


def test_rest_is_rest(driven: Runs) -> None:
    """Nothing commanded: no motion on level ground; on a slope it holds within 1 mm in 10 s."""
    level, tilted = driven["level"], driven["tilted"]
    assert np.abs(level["u"]).max() == 0.0
    assert np.hypot(tilted["x"][-1], tilted["y"][-1]) < 1e-3


def test_slip_needs_force() -> None:
    """Without resistance a wheel rolls at the hub's speed; the slip grows with the drag to overcome."""
    drags = (-load_soil("asphalt").resistance.rolling, 0.0, 0.05)
    runs = simulate([spec("asphalt", (Segment(8.0, 1.0),), changes={"rolling": drag}) for drag in drags])
    slips = [1.0 - h["u"][-1] / (h["speed"][-1].mean() * 0.175) for h in runs]
    assert slips[0] < slips[1] < slips[2]
    free = machine("asphalt", u=1.0, speed=1.0 / 0.175)
    free.n["rolling"], free.n["loop_p"] = 0.0 * free.n["rolling"], 0.0 * free.n["loop_p"]
    free.n["loop_i"] = 0.0 * free.n["loop_i"]
    free.step(np.zeros((2, 2, 1)), 0.01, 4)
    assert abs(free.s["force_x"]).max() < 0.1  # what asphalt is compacted by, of 78 N of load


def test_it_settles_at_the_speed_the_motors_allow() -> None:
    """Full throttle downhill in thin air: no faster than the no-load speed at the battery's voltage."""
    vehicle = load_vehicle("elevate")
    fast = dataclasses.replace(vehicle, drive=dataclasses.replace(vehicle.drive, max_speed_mps=9.0))
    h = simulate([RunSpec(fast, load_soil("asphalt"), (Segment(15.0, 9.0),), noiseless=True)])[0]
    top = vehicle.drive.no_load_speed_radps / vehicle.drive.gear_ratio * 25.4 / 24.0
    assert 0.9 * top < h["speed"][-1].mean() < top


def test_half_the_step_changes_little_and_half_of_that_less() -> None:
    """First order: the difference falls by about two with the step, and is small at the default."""
    drive = (Segment(0.5), Segment(1.5, 1.0), Segment(1.5, 0.8, 0.5), Segment(1.0, 0.0, -0.8))
    runs = [simulate([spec(drive=drive)], substeps=k)[0] for k in (4, 8, 16)]
    first, second = (
        max(np.abs(a["x"] - b["x"]).max(), np.abs(a["y"] - b["y"]).max()) for a, b in itertools.pairwise(runs)
    )
    assert first < 0.02
    assert 1.5 < first / second < 2.7


def test_every_knob_turns_something_and_zero_is_absent() -> None:
    """A change of zero leaves every bit; any other value changes the log."""
    sizes = {"suction_pa": 2000.0, "tack_pa": 2000.0, "cda_m2": 2.0, "cda_gust_m2": 2.0, "gust_n": 20.0}
    sizes |= {"limit": 0.9, "limit_foldback": 0.9, "sag_ohm": 2.0, "sag_root": 5.0}
    changes = [{}, dict.fromkeys(CHANGES, 0.0), *({change: sizes.get(change, 0.1)} for change in CHANGES)]
    specs = [spec(noiseless=False, changes=some) for some in changes]
    base, without, *made = record(specs, names=["a"] * len(specs))
    assert differences(base, without) == []
    idle = [change for change, log in zip(CHANGES, made, strict=True) if not differences(base, log)]
    assert idle == []


def test_batched_runs_equal_single_ones() -> None:
    """What else is computed in one call does not matter, to the bit."""
    drive = (Segment(0.5), Segment(2.0, 0.8, 0.5), Segment(1.0, 0.0, -0.8))
    many = [spec(drive=drive, noiseless=False, seed=i) for i in range(3)]
    together = record(many)
    for i, one in enumerate(many):
        alone = record([one], names=[f"run-{i + 1}"])[0]
        assert differences(together[i], alone) == []


def test_the_ground_varies_as_it_is_told() -> None:
    """Within a run by a field of the place, between runs by one draw each."""
    specs = [spec(noiseless=False, seed=i) for i in range(300)]
    patches = PlantSoilField(specs)
    x = np.linspace(0.0, 200.0, 80)
    logs = np.stack([patches.at(np.full((4, 300), at), np.zeros((4, 300)))[0, 0] for at in x])
    assert logs.mean(axis=0).std() == pytest.approx(0.08, rel=0.2)
    assert (logs - logs.mean(axis=0)).std() == pytest.approx(0.10, rel=0.15)
    near = patches.at(np.full((4, 300), 0.05), np.zeros((4, 300)))[0, 0] - logs[0]
    assert near.std() < 0.01


def test_unknown_knobs_and_clogging_mud_are_refused() -> None:
    with pytest.raises(ConfigError, match="unknown parameter"):
        spec(changes={"warp": 1.0})
    with pytest.raises(ConfigError, match="mud"):
        spec("mud")
    with pytest.raises(ConfigError, match="equally long"):
        simulate([spec(), spec(drive=(Segment(1.0),))])


AGREES = {"asphalt": (0.004, 0.004, 0.04), "medium_sand": (0.006, 0.006, 0.04), "gravel": (0.01, 0.008, 0.04)}
"""Firm ground: tolerance of speed (m/s), yaw rate (rad/s) and wheel speed (rad/s) in steady parts."""


def test_twin_and_plant_agree_on_firm_ground() -> None:
    """The gap without any effect is one of functional forms: small where the ground is firm."""
    found = steady_differences(tuple(AGREES))
    for soil, limits in AGREES.items():
        values = (found[soil]["u"], found[soil]["r"], found[soil]["wheel"])
        assert all(value < limit for value, limit in zip(values, limits, strict=True)), (soil, values)


def test_a_loop_at_its_limit_comes_back() -> None:
    """A spin on strong ground takes all torque there is; what comes after is driven as told."""
    drive = (Segment(1.0), Segment(5.0, 0.0, 2.5), Segment(6.0, 1.6))
    h = simulate([spec("gravel", drive, changes={"strength": 1.2})])[0]
    assert h["speed"][-1].mean() == pytest.approx(1.6 / 0.175, rel=0.01)
    assert np.ptp(h["speed"][-1]) < 0.1  # and no wheel holds a speed of its own


def test_the_battery_gives_the_power_that_the_motors_take() -> None:
    """At rest under torque a motor's current is large and its power small: so is the battery's current."""
    held = machine("asphalt")
    held.s["torque"] = np.full_like(held.s["torque"], 8.0)
    motors = np.abs(motor_current(held.n, held.s["torque"], held.s["speed"])).sum()
    for _ in range(200):
        supplied = held._supply(0.01)
    volts, drawn = float(held.s["supply_v"][0]), float(held.s["drawn_a"][0])
    winding = held.n["supply_v"] ** 2 / (held.n["no_load_radps"] * held.n["stall_nm"])
    heat = float((winding * supplied["current"] ** 2).sum())
    assert volts * drawn == pytest.approx(heat, rel=1e-6)
    assert drawn < 0.5 * motors
    assert volts == pytest.approx(float((held.n["open_v"] - held.n["inner_ohm"] * drawn)[0]), rel=1e-9)
