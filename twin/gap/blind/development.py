"""Trials on which the diagnosis is tuned, and the weights of its odds, trained on them.

    python -m terrafusion.twin.gap.blind.development make --site 1 --out development
    python -m terrafusion.twin.gap.blind.development train development/*.json --out choice.yaml

Truth is read here, so none of this may enter a blind check: everything is drawn from seeds of its own, and
the sealed trials are never opened. A site is one robot on one ground with one kind of drive: a few references
and three drives that all of its trials share, so that a trial costs seconds. Shapes take turns over the
sites. Some effects can be kept out of the training (`--without`), to see what the weights make of the rest.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.blind.drives import KINDS, drive
from terrafusion.twin.gap.blind.plan import SEVERITIES, SOILS, VEHICLE, _size
from terrafusion.twin.gap.blind.plant.spec import RunSpec
from terrafusion.twin.gap.blind.shapes import IN_CATALOGUE, OUT_OF_CATALOGUE, OUTSIDE, SAME, SHIFTED, Shape
from terrafusion.twin.gap.choice import LAPSE, Told, Weights
from terrafusion.twin.soil import load_soil
from terrafusion.twin.vehicle import load_vehicle

Array = NDArray[np.float64]

FIRST_SEED = 7_001_000
"""Every draw is made from this number too: a blind check has trial seeds of its own."""
REFERENCES, RUNS = 14, 3
SINGLES, OUTSIDERS = 16, 4
"""Trials of a site: effects of the catalogue, half of them shifted, and others."""
OUTSIDE_COUNTS = 1.5
"""Trials with a cause outside the catalogue count so often in the training: a fifth of all are such."""
SHRINK = 0.002
"""Weight of the squares of the weights, against a log likelihood of one a trial (assumed)."""


@dataclass(frozen=True)
class Trial:
    """One trial, its truth, and what the odds are made from.

    Attributes:
        shape, drive, soil, severity: its truth.
        effect: true effect, or None where it is in no catalogue.
        p_value: of the test for a gap; `told` and `before` are empty where there is none.
        told: what each effect's best law leaves (inside, outside, square), by effect.
        before: the gap as it is.
    """

    shape: str
    drive: str
    soil: str
    severity: float
    effect: str | None
    p_value: float
    told: dict[str, tuple[float, float, float]]
    before: tuple[float, float, float]

    def seen(self) -> bool:
        """Whether there is a gap to explain."""
        return bool(self.told)


def site(number: int) -> tuple[str, str, list[tuple[Shape, float]]]:
    """Kind of drive, ground, and shapes with severities of a site."""
    rng = np.random.default_rng([FIRST_SEED, number, 1])
    kind, soil = KINDS[number % 2], SOILS[(number // 2) % len(SOILS)]
    out = []
    for family, count in ((SAME, SINGLES // 2), (SHIFTED, SINGLES // 2), (OUTSIDE, OUTSIDERS)):
        pool = [s for s in (*IN_CATALOGUE, *OUT_OF_CATALOGUE) if s.kind == family]
        turn = np.random.default_rng([FIRST_SEED, len(family)]).permutation(len(pool))
        chosen = [pool[turn[(number * count + i) % len(pool)]] for i in range(count)]
        out += [(shape, float(rng.choice(SEVERITIES, p=[0.2, 0.35, 0.45]))) for shape in chosen]
    return kind, soil, out


def specs(number: int) -> list[RunSpec]:
    """Runs of a site: its trials', then the references."""
    kind, soil, trials = site(number)
    rng = np.random.default_rng([FIRST_SEED, number, 2])
    vehicle, ground, robot = load_vehicle(VEHICLE), load_soil(soil), int(rng.integers(2**31))

    def one(place: int, seed: int, knobs: Mapping[str, float]) -> RunSpec:
        own = np.random.default_rng([FIRST_SEED, number, 3, place])
        heading = float(own.uniform(-np.pi, np.pi))
        run_seed = int(np.random.default_rng([FIRST_SEED, number, 4, seed]).integers(2**31))
        return RunSpec(vehicle, ground, drive(kind, own), heading, run_seed, robot, dict(knobs))

    out = []
    for t, (shape, severity) in enumerate(trials):
        knobs = shape.turned(_size(shape, kind, severity), rng)
        out += [one(i, RUNS * t + i, knobs) for i in range(RUNS)]
    return out + [one(RUNS + i, RUNS * len(trials) + i, {}) for i in range(REFERENCES)]


def make(number: int) -> list[Trial]:
    """The trials of a site, diagnosed up to the odds."""
    from terrafusion.twin.gap.blind.plant.run import record
    from terrafusion.twin.gap.candidates import Candidates
    from terrafusion.twin.gap.evidence import gather

    kind, soil, trials = site(number)
    recordings = record(specs(number))
    split = RUNS * len(trials)
    candidates = Candidates.of()
    vehicle = load_vehicle(VEHICLE)
    bench = gather(recordings[:split], recordings[split:], vehicle, None, candidates, jobs=1)
    out = []
    for t, (shape, severity) in enumerate(trials):
        mine = slice(RUNS * t, RUNS * (t + 1))
        own = dataclasses.replace(bench, runs=bench.runs[mine], raws=bench.raws[mine])
        effect = None if shape.kind == OUTSIDE else shape.effect
        out.append(Trial(shape.key, kind, soil, severity, effect, *_judged(own)))
        print(f"{shape.key} {severity:g}: p {out[-1].p_value:.2f}", flush=True)
    return out


def _judged(bench: Any) -> tuple[float, dict[str, tuple[float, float, float]], tuple[float, float, float]]:
    """p-value, what each effect leaves, and the gap as it is."""
    from terrafusion.twin.gap.channels import Table
    from terrafusion.twin.gap.choosing import chosen
    from terrafusion.twin.gap.detect import detect
    from terrafusion.twin.gap.diagnosis import SIGNIFICANCE
    from terrafusion.twin.gap.discrepancy import modulated
    from terrafusion.twin.gap.ladder import Fitter
    from terrafusion.twin.gap.null import learn
    from terrafusion.twin.gap.posterior import Pool, beliefs
    from terrafusion.twin.gap.residuals import state_sigmas
    from terrafusion.twin.gap.score import learnt_sigma, score

    candidates = bench.candidates
    sigma, columns = learnt_sigma(bench.references, state_sigmas(candidates)), len(candidates.keys)
    normal = [score(run, sigma) for run in bench.references]
    scores = [
        dataclasses.replace(score(run, sigma), other=modulated(run, bench.model, sigma, columns))
        for run in bench.runs
    ]
    found = detect(scores, normal, candidates, 0)
    if found.p_value > SIGNIFICANCE:
        return found.p_value, {}, (0.0, 0.0, 0.0)
    null = learn(normal, len(scores))
    pool = Pool.of(scores, null)
    table = Table.of(bench.runs, bench.references, normal, sigma, columns)
    fitter = Fitter(bench, scores, sigma, null, pool, table)
    choice, _ = chosen(fitter, beliefs(pool, candidates), True)
    told = {name: _numbers(one) for name, one in choice.told.items()}
    return found.p_value, told, _numbers(choice.before)


def _numbers(told: Told) -> tuple[float, float, float]:
    return told.inside, told.outside, told.square


def utilities(trial: Trial, weights: Weights) -> dict[str | None, float]:
    """Log odds of all causes of a trial; None is the unknown one."""
    before = Told(*trial.before)
    odds: dict[str | None, float] = {k: weights.cause(Told(*v), before) for k, v in trial.told.items()}
    odds[None] = weights.outsider(before)
    return odds


def surprise(trials: Iterable[Trial], weights: Weights) -> float:
    """Negative log likelihood of the true causes; unknown ones count `OUTSIDE_COUNTS` times."""
    total = 0.0
    for trial in trials:
        odds = utilities(trial, weights)
        share = math.exp(odds[trial.effect] - float(np.logaddexp.reduce(list(odds.values()))))
        counts = OUTSIDE_COUNTS if trial.effect is None else 1.0
        total -= counts * math.log((1.0 - LAPSE) * share + LAPSE / len(odds))
    return total


def train(trials: Sequence[Trial]) -> Weights:
    """Weights of least surprise on trials in which a gap was seen."""
    from scipy.optimize import minimize

    seen = [trial for trial in trials if trial.seen()]

    def cost(w: Array) -> float:
        return surprise(seen, Weights(*w.tolist())) + SHRINK * float(w @ w)

    limits = [(0.0, 60.0), (0.0, 1.5), (-20.0, 20.0)]
    return Weights(*minimize(cost, [6.0, 0.8, 0.0], method="L-BFGS-B", bounds=limits).x.tolist())


def read(paths: Iterable[Path]) -> list[Trial]:
    """Trials of some sites."""
    rows = [row for path in paths for row in json.loads(path.read_text(encoding="utf-8"))]
    return [
        Trial(
            **{**row, "told": {k: tuple(v) for k, v in row["told"].items()}, "before": tuple(row["before"])}
        )
        for row in rows
    ]


def write(path: Path, weights: Weights, trials: Sequence[Trial], source: Sequence[Path]) -> None:
    """The weights, with what they come from."""
    digest = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(source))).hexdigest()[:16]
    lines = [
        "# Weights of the odds of causes (see choice.py), made by",
        "# python -m terrafusion.twin.gap.blind.development train",
        f"# from {sum(t.seen() for t in trials)} trials with a gap of {len(source)} sites; sha256 {digest}",
        "weights:",
        *(f"  {name}: {value:.4g}" for name, value in dataclasses.asdict(weights).items()),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main() -> None:
    """Make a site, or train on some."""
    parser = argparse.ArgumentParser(description="Development trials and the weights trained on them.")
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make")
    making.add_argument("--site", type=int, required=True)
    making.add_argument("--out", type=Path, required=True)
    training = commands.add_parser("train")
    training.add_argument("sites", type=Path, nargs="+")
    training.add_argument("--without", nargs="*", default=[], help="true effects that are kept out")
    training.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    if given.command == "make":
        given.out.mkdir(parents=True, exist_ok=True)
        rows = [dataclasses.asdict(trial) for trial in make(given.site)]
        (given.out / f"site-{given.site:03d}.json").write_text(json.dumps(rows), encoding="utf-8")
        return
    trials = [t for t in read(given.sites) if t.shape.split("/")[0] not in given.without]
    write(given.out, train(trials), trials, given.sites)


if __name__ == "__main__":
    main()
