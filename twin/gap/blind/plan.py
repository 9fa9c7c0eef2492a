"""Which trials there are: families, settings, drives, severities, ground, effects; drawn from one seed."""

import dataclasses
import itertools
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.twin.gap.blind.drives import KINDS, drive
from terrafusion.twin.gap.blind.plant.spec import GroundSpread, RunSpec
from terrafusion.twin.gap.blind.sensitivity import D_PRIMES, size_at
from terrafusion.twin.gap.blind.shapes import IN_CATALOGUE, OUT_OF_CATALOGUE, SAME, SHIFTED, Shape, shapes
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import VehicleParams, load_vehicle

VEHICLE = "elevate"
SOILS = ("medium_sand", "grass", "gravel", "loose_sand")
FAMILIES = ("null", "same", "shifted", "outside", "pair")
PLAIN = "same drives"
OTHER_DRIVES = ("profile", "speed", "length", "site", "waypoints")
"""How judged runs differ from the references: other profile, speed, length, a patchier site, way points."""
HARDER = ("robot 10 % off", "wrong soil label", "5 references", "20 references")
REFERENCES = {"5 references": 5, "20 references": 20}
USUAL_REFERENCES, RUNS = 12, 3
STRONG = D_PRIMES[-1]
SITE = GroundSpread(within=0.15, length_m=1.0)
NUMBERS_OFF = 0.1  # 1 sigma of the logarithm of each number of the robot's file


@dataclass(frozen=True)
class CheckSize:
    """How many trials; each has `RUNS` runs, and `USUAL_REFERENCES` but for settings that say otherwise.

    Attributes:
        nulls: without effect, on the references' drives; `other_nulls` on other drives.
        effects: of each form at each of `D_PRIMES`; `other_effects` on other drives, from d' 10 on.
        harder: nulls, and as many effects of d' 25, of each setting of `HARDER`.
        outside: effects outside the catalogue at d' 10 and at d' 25.
        pairs: of effects of d' 25; each of the two is a trial by itself, too.
    """

    nulls: int
    other_nulls: int
    effects: int
    other_effects: int
    harder: int
    outside: int
    pairs: int

    def part(self, share: float) -> "CheckSize":
        """Only `share` (0 to 1] of the trials of every family, rounded up."""
        return CheckSize(*(math.ceil(share * count - 1e-9) for count in dataclasses.astuple(self)))


FULL = CheckSize(nulls=200, other_nulls=200, effects=60, other_effects=40, harder=20, outside=40, pairs=40)
QUICK = CheckSize(nulls=1, other_nulls=1, effects=1, other_effects=0, harder=0, outside=1, pairs=1)


@dataclass(frozen=True)
class Trial:
    """One trial and its truth.

    Attributes:
        trial: opaque name, in random order.
        family, setting: of `FAMILIES`; `PLAIN`, or of `OTHER_DRIVES` or `HARDER`.
        drive: kind of the judged drives; `reference_drive` that of the references.
        d_prime: of each effect; 0 for null.
        shapes, values: keys of `shapes.shapes` that are present, and their sizes.
        seed: of everything that is drawn; the two single trials of a pair share its seed.
        part_of: pair whose one effect this is, or "".
    """

    trial: str
    family: str
    setting: str
    drive: str
    reference_drive: str
    d_prime: float
    soil: str
    shapes: tuple[str, ...]
    values: tuple[float, ...]
    seed: int
    references: int
    part_of: str = ""

    def effects(self) -> tuple[str, ...]:
        """True effects of the catalogue, and names from outside it."""
        return tuple(shapes()[key].effect for key in self.shapes)


def plan(seed: int, scale: CheckSize) -> list[Trial]:
    """All trials, in random order; `trial` names follow the order."""
    drafts = list(_drafts(scale, np.random.default_rng([seed, 1])))
    order = np.random.default_rng([seed, 2]).permutation(len(drafts))
    names = {drafts[index].trial: f"trial-{place + 1:04d}" for place, index in enumerate(order)}
    return [
        dataclasses.replace(drafts[i], trial=names[drafts[i].trial], part_of=names.get(drafts[i].part_of, ""))
        for i in order
    ]


def _drafts(scale: CheckSize, rng: np.random.Generator) -> Iterator[Trial]:
    """Trials with working names, in the order of the plan's cells."""
    numbers, kinds = itertools.count(), itertools.cycle(KINDS)
    others = itertools.cycle(OTHER_DRIVES)

    def trial(family: str, setting: str, d_prime: float, pool: Iterator[Shape] | None) -> Trial:
        reference_drive = next(kinds)
        kind = {"profile": _contrast(reference_drive), "waypoints": "waypoints"}.get(setting, reference_drive)
        if kind == reference_drive == "waypoints" and setting == "waypoints":
            reference_drive = "gentle"
        chosen = [] if pool is None else [next(s for s in pool if size_at(s.key, kind, d_prime) is not None)]
        return Trial(
            f"draft-{next(numbers)}", family, setting, kind, reference_drive, d_prime,
            SOILS[int(rng.integers(len(SOILS)))], tuple(s.key for s in chosen),
            tuple(float(size_at(s.key, kind, d_prime) or 0.0) for s in chosen), int(rng.integers(2**62)),
            REFERENCES.get(setting, USUAL_REFERENCES),
        )  # fmt: skip

    pools = {kind: _in_turn([s for s in IN_CATALOGUE if s.kind == kind], rng) for kind in (SAME, SHIFTED)}
    outside = _in_turn(OUT_OF_CATALOGUE, rng)
    forms = itertools.cycle((SAME, SHIFTED))
    yield from (trial("null", PLAIN, 0.0, None) for _ in range(scale.nulls))
    yield from (trial("null", next(others), 0.0, None) for _ in range(scale.other_nulls))
    for d_prime, form in itertools.product(D_PRIMES, pools):
        yield from (trial(form, PLAIN, d_prime, pools[form]) for _ in range(scale.effects))
        if d_prime > D_PRIMES[0]:
            yield from (trial(form, next(others), d_prime, pools[form]) for _ in range(scale.other_effects))
    for setting in HARDER:
        yield from (trial("null", setting, 0.0, None) for _ in range(scale.harder))
        for form in itertools.islice(forms, scale.harder):
            yield trial(form, setting, STRONG, pools[form])
    for d_prime in D_PRIMES[1:]:
        yield from (trial("outside", PLAIN, d_prime, outside) for _ in range(scale.outside))
    for _ in range(scale.pairs):
        yield from _pair(trial(SAME, PLAIN, STRONG, pools[SAME]), next(numbers), pools[SAME])


def _pair(first: Trial, number: int, pool: Iterator[Shape]) -> Iterator[Trial]:
    """A pair of effects, and each of them alone on the same robot, ground and drives."""
    effect = first.effects()[0]
    other = next(s for s in pool if s.effect != effect and size_at(s.key, first.drive, STRONG) is not None)
    keys = (*first.shapes, other.key)
    values = (*first.values, float(size_at(other.key, first.drive, STRONG) or 0.0))
    pair = dataclasses.replace(first, trial=f"draft-pair-{number}", family="pair", shapes=keys, values=values)
    yield pair
    yield dataclasses.replace(first, part_of=pair.trial)
    yield dataclasses.replace(
        first, trial=f"draft-second-{number}", shapes=keys[1:], values=values[1:], part_of=pair.trial
    )


def _contrast(kind: str) -> str:
    return "exciting" if kind == "gentle" else "gentle"


def _in_turn(pool: Sequence[Shape], rng: np.random.Generator) -> Iterator[Shape]:
    """The pool shuffled, again and again."""
    while True:
        yield from (pool[i] for i in rng.permutation(len(pool)))


def specs(trial: Trial) -> list[RunSpec]:
    """Runs of the plant: the trial's runs, then its references; one robot, one soil."""
    rng = np.random.default_rng([trial.seed, 3])
    changes: dict[str, float] = {}
    for key, value in zip(trial.shapes, trial.values, strict=True):
        turn = np.random.default_rng([trial.seed, 5, *key.encode()])
        for change, turned in shapes()[key].turned(value, turn).items():
            changes[change] = changes.get(change, 0.0) + turned
    vehicle, soil, robot = load_vehicle(VEHICLE), load_soil(trial.soil), int(rng.integers(2**31))
    if trial.setting == "robot 10 % off":
        vehicle = another_robot(vehicle, rng)
    if trial.setting == "wrong soil label":
        soil = dataclasses.replace(soil, name=str(rng.choice([s for s in SOILS if s != soil.name])))
    out = []
    for i in range(RUNS + trial.references):
        judged, own = i < RUNS, np.random.default_rng([trial.seed, 4, i])
        heading, run_seed = own.uniform(-np.pi, np.pi), int(own.integers(2**31))
        segments = drive(trial.drive, own, trial.setting) if judged else drive(trial.reference_drive, own)
        ground = SITE if judged and trial.setting == "site" else GroundSpread()
        out.append(
            RunSpec(
                vehicle, soil, segments, heading, run_seed, robot, dict(changes) if judged else {}, ground
            )
        )
    return out


def another_robot(vehicle: VehicleParams, rng: np.random.Generator) -> VehicleParams:
    """A robot whose numbers differ from those of its file, which the diagnosis has."""

    def off(part: Any, *names: str) -> Any:
        return dataclasses.replace(
            part, **{n: getattr(part, n) * math.exp(NUMBERS_OFF * rng.normal()) for n in names}
        )

    return dataclasses.replace(
        vehicle,
        body=off(vehicle.body, "mass_kg", "yaw_inertia_kgm2", "wheelbase_m", "track_m", "cg_height_m"),
        wheel=off(vehicle.wheel, "radius_m", "width_m", "inertia_kgm2"),
        drive=off(vehicle.drive, "stall_torque_nm", "speed_loop_p_nms", "speed_loop_i_nm"),
    )


def to_text(trials: Sequence[Trial]) -> str:
    """The labels as they are committed to."""
    return json.dumps([dataclasses.asdict(trial) for trial in trials], indent=0, sort_keys=True)
