"""The study's batch: terrain x friction x slope x payload, each with the 300 s profile; and energy a metre.

The twin's effective friction is the cap of its shear force (`SoilParams.shear.friction_cap`).
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate_run
from tests.studies.source_study.published import FRICTION, SCENARIO, VEHICLE

SLOPES_DEG = (0.0, 5.0, 10.0, 15.0)
PAYLOADS_KG = (0.0, 30.0, 60.0)
QUICK_SLOPES_DEG = (0.0, 5.0)
MOBILE_SHARE = 0.5
"""Least share of the commanded distance of a mobile run, for which energy a metre is counted."""
SHEAR_MODULI_M = (0.002, 0.005, 0.010, 0.015, 0.020, 0.025)
"""Stiff to soft sand (Wong: 10 to 25 mm for sand): how slip is varied at equal load and slope."""
QUICK_MODULI_M = (0.002, 0.015, 0.025)
SLIP_TERRAIN, SLIP_SLOPE_DEG = "loose_sand", 5.0


@dataclass(frozen=True)
class BatchCell:
    """Conditions of one run; `shear_modulus_m` None leaves the soil's own."""

    terrain: str
    friction: float
    slope_deg: float = 0.0
    payload_kg: float = 0.0
    shear_modulus_m: float | None = None

    def soil(self) -> SoilParams:
        """The library's soil with the cell's friction and shear modulus."""
        soil = load_soil(self.terrain)
        shear = dataclasses.replace(soil.shear, friction_cap=self.friction)
        if self.shear_modulus_m is not None:
            shear = dataclasses.replace(shear, shear_modulus_m=self.shear_modulus_m)
        return dataclasses.replace(soil, shear=shear)


@dataclass(frozen=True)
class BatchResult:
    """What came of a cell.

    Attributes:
        advance: net distance uphill over the commanded one; negative for a robot that slides back.
        slip: mean of the study's proxy |1 - v_odom / v_gt|, percent; NaN for a run that never moves.
        slip_ratio: mean of the usual |w R - u| / max(|w R|, |u|), percent.
        energy_per_m_j: drawn from the battery over the distance driven, NaN for a run that is not mobile.
        immobilised_at_s: when it came to rest for good, None when it did not.
    """

    cell: BatchCell
    advance: float
    slip: float
    slip_ratio: float
    energy_per_m_j: float
    immobilised_at_s: float | None

    @property
    def mobile(self) -> bool:
        """Whether the robot made at least half of the commanded distance."""
        return self.advance >= MOBILE_SHARE


def grid(quick: bool = False) -> tuple[BatchCell, ...]:
    """The batch: both ends of each range of Tab. 3 and its middle, all slopes and payloads.

    The quick one leaves out the middle and the steep slopes, and has payload on
    level ground only.
    """
    cells = []
    for terrain, (low, high) in FRICTION.items():
        if quick:
            cells += [BatchCell(terrain, mu, slope) for mu in (low, high) for slope in QUICK_SLOPES_DEG]
            cells.append(BatchCell(terrain, high, 0.0, max(PAYLOADS_KG)))
        else:
            conditions = itertools.product((low, 0.5 * (low + high), high), SLOPES_DEG, PAYLOADS_KG)
            cells += [BatchCell(terrain, *values) for values in conditions]
    return tuple(cells)


def slip_cells(quick: bool = False) -> tuple[BatchCell, ...]:
    """One load on one slope, from little slip to much: sand from stiff to soft in shear."""
    friction = load_soil(SLIP_TERRAIN).shear.friction_cap
    moduli = QUICK_MODULI_M if quick else SHEAR_MODULI_M
    return tuple(BatchCell(SLIP_TERRAIN, friction, SLIP_SLOPE_DEG, 0.0, modulus) for modulus in moduli)


def run_cell(cell: BatchCell) -> BatchResult:
    """Drive the study's profile under the cell's conditions."""
    scenario = load_scenario(SCENARIO)
    run = simulate_run(
        scenario, vehicle=VEHICLE, terrain=cell.terrain, slope_deg=cell.slope_deg,
        payload_kg=cell.payload_kg, soils={cell.terrain: cell.soil()}, noiseless=True,
    )  # fmt: skip
    wanted_m = float(abs(scenario.commanded(run.t_s)[:, 0]).sum()) * float(run.t_s[1])
    truth = run.recording.truth
    if truth is None:
        raise ValueError("the twin's recording lacks truth")
    ahead = math.radians(scenario.heading_deg)
    moved = truth.position_m[-1] - truth.position_m[0]
    level_m = moved[0] * math.cos(ahead) + moved[1] * math.sin(ahead)
    advance = float(level_m) / math.cos(math.radians(cell.slope_deg)) / wanted_m
    return BatchResult(
        cell=cell,
        advance=advance,
        slip=100.0 * run.summary.mean_abs_slip,
        slip_ratio=100.0 * run.summary.mean_slip_ratio,
        energy_per_m_j=run.summary.energy_per_m_j if advance >= MOBILE_SHARE else math.nan,
        immobilised_at_s=run.summary.immobilised_at_s,
    )


def least_growth(results: Sequence[BatchResult], name: str) -> float:
    """Least factor of energy a metre from one value of a field to the next, all else equal; NaN if none."""
    return min(
        (b.energy_per_m_j / a.energy_per_m_j for a, b in neighbours(results, name) if a.mobile and b.mobile),
        default=math.nan,
    )


def share_of_pairs(
    results: Sequence[BatchResult], name: str, holds: Callable[[BatchResult, BatchResult], bool]
) -> float:
    """Percent of the neighbouring pairs for which `holds(lower, higher)`; NaN without any pair."""
    outcomes = [holds(a, b) for a, b in neighbours(results, name)]
    return 100.0 * sum(outcomes) / len(outcomes) if outcomes else math.nan


def neighbours(results: Sequence[BatchResult], name: str) -> list[tuple[BatchResult, BatchResult]]:
    """Pairs of results that differ in one field of their cells only, by one step of the grid, lower first."""
    groups: dict[tuple[object, ...], list[BatchResult]] = {}
    for result in results:
        others = tuple(value for key, value in vars(result.cell).items() if key != name)
        groups.setdefault(others, []).append(result)
    pairs = []
    for group in groups.values():
        ordered = sorted(group, key=lambda result: getattr(result.cell, name))
        pairs += list(itertools.pairwise(ordered))
    return pairs


def steepening(results: Sequence[BatchResult], slip: str) -> float:
    """How much steeper energy a metre rises with slip in the upper half of the slips than in the lower.

    `slip` names the measure, "slip" or "slip_ratio". One means proportion; above one is out of proportion.
    """
    mobile = sorted((r for r in results if r.mobile), key=lambda r: getattr(r, slip))
    if len(mobile) < 3:
        return math.nan
    x = [getattr(r, slip) for r in mobile]
    middle = min(range(1, len(x) - 1), key=lambda i: abs(x[i] - 0.5 * (x[0] + x[-1])))
    rise = [r.energy_per_m_j for r in mobile]
    lower = (rise[middle] - rise[0]) / (x[middle] - x[0])
    upper = (rise[-1] - rise[middle]) / (x[-1] - x[middle])
    return upper / lower


def slip_cost(results: Sequence[BatchResult]) -> float:
    """Energy a metre of the mobile run that slips most over that of the one that slips least; NaN if none."""
    mobile = sorted((r for r in results if r.mobile), key=lambda r: r.slip)
    return mobile[-1].energy_per_m_j / mobile[0].energy_per_m_j if mobile else math.nan
