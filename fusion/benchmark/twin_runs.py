"""Simulated runs of the benchmark.

A case is a family of runs, a plant and a seed. Commands, route, slope, heading and outage depend on family
and seed alone, so that all plants drive the same; soils and sensor noise are drawn for each plant. The
policy, the terrain model and the tuning use seeds far below `FIRST_SEED`; those from 100 000 on served
development.
"""

import dataclasses
import zlib
from dataclasses import dataclass

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.scratch import scratch_folder
from terrafusion.fusion.benchmark.methods import true_labels
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.noise.labels import GroundLabels
from terrafusion.fusion.training.simulated_runs import GROUNDS, SOIL_SCATTER, scattered_soil
from terrafusion.twin.effects.alternative_terramechanics import second_terramechanics
from terrafusion.twin.model.ground import Variation
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.simulate import simulate_run

FIRST_SEED = 200_000
PERTURBATION = 0.3
"""Relative error of every soil number of the plant "perturbed"; its sign is drawn."""
CORRELATED = Variation(strength_sigma=0.3, length_m=4.0)
"""Ground of the plant "second": a variation of 30 % of the strength is usual (Phoon and Kulhawy 1999: 10 to
50 %); its length of a few metres is assumed."""
LEAD_S = (40.0, 50.0)
"""Range of the outage's start: heading and slip are observable by then."""
TAIL_S = 2.0
LEG_M, MUD_LEG_M = (12.0, 30.0), (6.0, 12.0)
"""Length of a ground on the route; on more mud the robot would get stuck."""
MUD = "mud"

PLANTS = {
    "twin": "the twin's laws, soils drawn as in training",
    "perturbed": "the twin's laws, every soil number 30 % too high or too low",
    "second": "other laws (Reece, Ding, Kondner) on ground whose strength varies from place to place",
}


@dataclass(frozen=True)
class Family:
    """Runs of one kind.

    Attributes:
        grounds: of the route; in random order if `mixed`, else one of them for the whole run.
        outages_s: lengths of the outage, one a seed in turn.
        slope_deg: range of the slope.
    """

    about: str
    grounds: tuple[str, ...]
    mixed: bool
    outages_s: tuple[float, ...]
    slope_deg: tuple[float, float] = (0.0, 0.0)


FAMILIES = {
    "mixed": Family("a new ground every few metres, 60 s without GNSS", GROUNDS, True, (60.0,)),
    "slopes": Family(
        "the same without mud on a slope of 3 to 8 deg, 60 s without GNSS",
        ("asphalt", "medium_sand", "loose_sand"), True, (60.0,), (3.0, 8.0),
    ),
    "outages": Family("a new ground every few metres, 30, 60 or 120 s without GNSS", GROUNDS, True,
                      (120.0, 30.0, 60.0)),
    "firm": Family("asphalt, 120 s without GNSS", ("asphalt",), False, (120.0,)),
    "unseen": Family(
        "one ground that policy and detector never saw, 60 s without GNSS",
        ("gravel", "grass", "ploughed_soil", "snow"), False, (60.0,),
    ),
}  # fmt: skip
FIELD = "field"
"""The family of field logs, see `field_logs`."""


@dataclass(frozen=True)
class BenchmarkCase:
    """One simulated run."""

    family: str
    plant: str
    seed: int

    @property
    def key(self) -> str:
        """Name of the case and of its file."""
        return f"{self.family}-{self.plant}-{self.seed}"

    def stream(self, *words: str) -> np.random.Generator:
        """Random numbers of this seed for one purpose."""
        return np.random.default_rng([self.seed, *(zlib.crc32(word.encode()) for word in words)])


@dataclass(frozen=True, eq=False)
class BenchmarkRun:
    """A recording, its outage (None: the whole run is scored) and its true ground where known.

    `unit` names the independent unit: the seed, or the log from which several outages are taken. A run
    without reference is not `judged`: only its divergence is checked.
    """

    family: str
    plant: str
    unit: str
    name: str
    recording: Recording
    outage: Outage | None
    labels: GroundLabels | None
    seed: int = 0
    judged: bool = True


def simulate_case(case: BenchmarkCase) -> BenchmarkRun:
    """Simulate a case, repeatably."""
    family = FAMILIES[case.family]
    rng = case.stream(case.family)
    outage = Outage(
        round(float(rng.uniform(*LEAD_S)), 1), family.outages_s[case.seed % len(family.outages_s)]
    )
    seconds = outage.start_s + outage.seconds + TAIL_S
    route = _route(family, seconds, rng)
    scenario = Scenario(
        name=case.key,
        description=f"benchmark, {family.about}",
        duration_s=seconds,
        drive=_wander(seconds, rng),
        max_accel_mps2=0.5,
        route=route,
        slope_deg=float(rng.uniform(*family.slope_deg)),
        aspect_deg=float(rng.uniform(-180.0, 180.0)),
        heading_deg=float(rng.uniform(-180.0, 180.0)),
        variation=CORRELATED if case.plant == "second" else None,
    )
    soils = soils_of(case, {leg.terrain for leg in route})
    effects = second_terramechanics() if case.plant == "second" else {}
    seed = int(case.stream(case.family, case.plant, "noise").integers(2**31))
    recording = simulate_run(scenario, soils=soils, effects=effects, seed=seed).recording
    unit = f"seed {case.seed}"
    return BenchmarkRun(
        case.family, case.plant, unit, unit, recording, outage, true_labels(recording), case.seed
    )


def soils_of(case: BenchmarkCase, names: set[str]) -> dict[str, SoilParams]:
    """Soils of a case: scattered as in training, or every parameter off by `PERTURBATION`."""
    rng = case.stream(case.family, case.plant, "soil")
    with scratch_folder() as folder:
        scattered = {n: load_soil(scattered_soil(n, rng, folder)) for n in sorted(names)}
    return {n: perturbed(load_soil(n), rng) if case.plant == "perturbed" else s for n, s in scattered.items()}


def perturbed(soil: SoilParams, rng: np.random.Generator) -> SoilParams:
    """The soil with each parameter that training scatters `PERTURBATION` higher or lower."""
    changed = {}
    for section, keys in SOIL_SCATTER.items():
        part = getattr(soil, section)
        factors = {key: 1.0 + PERTURBATION * float(rng.choice((-1.0, 1.0))) for key in keys}
        changed[section] = dataclasses.replace(part, **{k: getattr(part, k) * f for k, f in factors.items()})
    return dataclasses.replace(soil, **changed)


def _route(family: Family, seconds: float, rng: np.random.Generator) -> tuple[RouteLeg, ...]:
    """Grounds in random order without repetition, longer than the robot can drive."""
    ground = str(rng.choice(family.grounds))
    if not family.mixed:
        return (RouteLeg(ground),)
    legs, length = [], 0.0
    while length < 1.3 * seconds:
        legs.append(RouteLeg(ground, float(rng.uniform(*(MUD_LEG_M if ground == MUD else LEG_M)))))
        length += legs[-1].length or 0.0
        ground = str(rng.choice([other for other in family.grounds if other != ground]))
    return (*legs, RouteLeg(ground))


def _wander(seconds: float, rng: np.random.Generator) -> tuple[DriveSegment, ...]:
    """A stop, a straight (to observe the heading), then straights, weaving, turns and short stops."""
    segments = [DriveSegment(3.0), DriveSegment(12.0, 1.0)]
    while sum(s.duration_s for s in segments) < seconds:
        speed = float(rng.uniform(0.7, 1.2))
        straight, turn = float(rng.uniform(6.0, 16.0)), float(rng.uniform(4.0, 8.0))
        weave, sign = float(rng.uniform(0.0, 0.25)), float(rng.choice((-1.0, 1.0)))
        segments += [
            DriveSegment(
                straight, speed, yaw_rate_amplitude_radps=weave, period_s=float(rng.uniform(6.0, 15.0))
            ),
            DriveSegment(turn, 0.9, sign * float(rng.uniform(0.2, 0.35))),
        ]
        if rng.random() < 0.15:
            segments.append(DriveSegment(3.0))
    return tuple(segments)
