"""Which trials there are: families, drives, severities, ground, effects; drawn from one seed."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.twin.gap.blind.drives import KINDS, drive
from terrafusion.twin.gap.blind.plant.spec import RunSpec
from terrafusion.twin.gap.blind.severity import half_power
from terrafusion.twin.gap.blind.shapes import IN_CATALOGUE, OUT_OF_CATALOGUE, SAME, SHIFTED, Shape, shapes
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle

VEHICLE = "elevate"
SOILS = ("medium_sand", "grass", "gravel", "loose_sand")
SEVERITIES = (0.5, 1.5, 4.0)
FAMILIES = ("null", "same", "shifted", "outside", "pair")
PAIR_SEVERITY = 4.0


@dataclass(frozen=True)
class CheckSize:
    """How many trials, and how much data each has.

    Attributes:
        nulls: in all, shared by the drives.
        effects: of the catalogue in each cell (family x drive x severity), in turn; 37 is each once.
        outside, pairs: trials a cell; pairs have no severity of their own.
        severities: of the single effects.
        runs, references: a trial.
    """

    nulls: int
    effects: int
    outside: int
    pairs: int
    runs: int
    references: int
    severities: tuple[float, ...] = SEVERITIES

    def part(self, share: float) -> CheckSize:
        """The same data a trial, but only `share` (0 to 1] of the trials of every family, rounded up."""
        counts = {name: math.ceil(share * getattr(self, name)) for name in COUNTS}
        return dataclasses.replace(self, **counts)


COUNTS = ("nulls", "effects", "outside", "pairs")
FULL = CheckSize(nulls=200, effects=37, outside=24, pairs=40, runs=3, references=20)
QUICK = CheckSize(nulls=4, effects=2, outside=1, pairs=1, runs=3, references=12, severities=(4.0,))


@dataclass(frozen=True)
class Trial:
    """One trial and its truth.

    Attributes:
        trial: opaque name, in random order.
        family, drive, severity, soil: its cell of the plan; severity is 0 for null.
        shapes: keys of `shapes.shapes` that are present.
        values: their sizes.
        seed: of everything that is drawn.
    """

    trial: str
    family: str
    drive: str
    severity: float
    soil: str
    shapes: tuple[str, ...]
    values: tuple[float, ...]
    seed: int
    runs: int
    references: int

    def effects(self) -> tuple[str, ...]:
        """True effects of the catalogue, and names from outside it."""
        return tuple(shapes()[key].effect for key in self.shapes)

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self) | {"effects": list(self.effects())}

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Trial:
        known = {spec.name for spec in dataclasses.fields(cls)}
        own: dict[str, Any] = {key: entry[key] for key in known}
        lists = {key: tuple(own[key]) for key in ("shapes", "values")}
        return cls(**{**own, **lists})


def plan(seed: int, scale: CheckSize) -> list[Trial]:
    """All trials, in random order."""
    cells = list(_cells(scale, np.random.default_rng([seed, 1])))
    rng = np.random.default_rng([seed, 2])
    trials = []
    for place, index in enumerate(rng.permutation(len(cells))):
        family, kind, severity, chosen = cells[index]
        own = int(rng.integers(2**62))
        values = tuple(shape_size(shape, kind, severity) for shape in chosen)
        soil, name = SOILS[int(rng.integers(len(SOILS)))], f"trial-{place + 1:04d}"
        trials.append(
            Trial(
                name, family, kind, severity, soil, tuple(s.key for s in chosen), values, own, scale.runs,
                scale.references,
            )
        )  # fmt: skip
    return trials


def _cells(scale: CheckSize, rng: np.random.Generator) -> Iterator[tuple[str, str, float, tuple[Shape, ...]]]:
    for i in range(scale.nulls):
        yield "null", KINDS[i % len(KINDS)], 0.0, ()
    for kind in KINDS:
        for severity in scale.severities:
            for family in (SAME, SHIFTED):
                pool = [shape for shape in IN_CATALOGUE if shape.kind == family]
                yield from ((family, kind, severity, (s,)) for s in _in_turn(pool, scale.effects, rng))
            for shape in _in_turn(OUT_OF_CATALOGUE, scale.outside, rng):
                yield "outside", kind, severity, (shape,)
        same = [shape for shape in IN_CATALOGUE if shape.kind == SAME]
        for _ in range(scale.pairs):
            first, second = rng.choice(len(same), size=2, replace=False)
            yield "pair", kind, PAIR_SEVERITY, (same[first], same[second])


def _in_turn(pool: Sequence[Shape], count: int, rng: np.random.Generator) -> list[Shape]:
    """`count` shapes: the pool shuffled, again and again."""
    rounds = -(-count // len(pool))
    return [pool[i] for _ in range(rounds) for i in rng.permutation(len(pool))][:count]


def shape_size(shape: Shape, kind: str, severity: float) -> float:
    """`severity` times the half-power point, within the plant's range."""
    return min(severity * half_power(shape.key, kind), shape.most)


def specs(trial: Trial) -> list[RunSpec]:
    """Runs of the plant: the trial's runs, then its references; one robot, one soil."""
    rng = np.random.default_rng([trial.seed, 3])
    chosen = [shapes()[key] for key in trial.shapes]
    changes: dict[str, float] = {}
    for shape, value in zip(chosen, trial.values, strict=True):
        for change, turned in shape.turned(value, rng).items():
            changes[change] = changes.get(change, 0.0) + turned
    vehicle, soil, robot = load_vehicle(VEHICLE), load_soil(trial.soil), int(rng.integers(2**31))
    out = []
    for i in range(trial.runs + trial.references):
        own = np.random.default_rng([trial.seed, 4, i])
        heading, run_seed = own.uniform(-np.pi, np.pi), int(own.integers(2**31))
        with_effect = changes if i < trial.runs else {}
        out.append(
            RunSpec(vehicle, soil, drive(trial.drive, own), heading, run_seed, robot, dict(with_effect))
        )
    return out


def to_text(trials: Sequence[Trial]) -> bytes:
    """The labels as they are sealed."""
    return json.dumps([trial.to_json() for trial in trials], indent=0, sort_keys=True).encode()


def from_text(text: bytes) -> list[Trial]:
    return [Trial.from_json(entry) for entry in json.loads(text)]
