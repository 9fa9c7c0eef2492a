"""Trials on which the diagnosis is tuned, and the weights of its odds, trained on them.

    python -m tests.studies.blind.development make --site 1 --out development
    python -m tests.studies.blind.development train development/*.json --out cause_posterior.yaml
    python -m tests.studies.blind.development cross development/*.json
    python -m tests.studies.blind.development score others/*.json

Truth is read here, so none of this may enter a blind check: everything is drawn from seeds of its own, and
the sealed trials are never opened. A site is one robot on one ground with one kind of drive: a few references
and three drives that all of its trials share, so that a trial costs seconds. Shapes take turns over the
sites. Some effects can be kept out of the training (`--without`), to see what the weights make of the rest;
`cross` judges each site by weights trained on the others.
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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.gap.blind.drives import KINDS, drive
from terrafusion.twin.gap.blind.plan import SEVERITIES, SOILS, VEHICLE, shape_size
from terrafusion.twin.gap.blind.plant.spec import RunSpec
from terrafusion.twin.gap.blind.shapes import (
    IN_CATALOGUE,
    OUT_OF_CATALOGUE,
    OUTSIDE,
    SAME,
    SHIFTED,
    Shape,
    shapes,
)
from terrafusion.twin.gap.infer.cause_posterior import (
    OUTSIDE_SHARE,
    CauseResidual,
    PosteriorWeights,
    probabilities,
)
from terrafusion.twin.gap.infer.goodness_of_fit import PERFECT_FIT, GoodnessOfFit
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vehicle import load_vehicle

if TYPE_CHECKING:
    from terrafusion.twin.gap.null.evidence import GapEvidence

Array = NDArray[np.float64]

FIRST_SEED = 7_001_000
"""Every draw is made from this number too: a blind check has trial seeds of its own."""
REFERENCES, RUNS = 14, 3
SINGLES, OUTSIDERS, NULLS = 12, 6, 2
"""Trials of a site: effects of the catalogue, half of them shifted, causes outside it, and none at all."""
NULL = "null"
"""Stands for the shape of a trial without a gap."""
CROSSED = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
"""Probabilities of an unknown cause above which `cross` counts trials."""
LAPSED = 0.1
"""In training the odds are taken not to hold more often than that: a few trials that no law fits would else
make all others unsure."""
SHRINK = 0.002
"""Weight of the squares of the weights, against a log likelihood of one a trial (assumed)."""


@dataclass(frozen=True)
class Trial:
    """One trial, its truth, and what the odds are made from.

    Attributes:
        shape, drive, soil, severity: its truth.
        effect: true effect, or None where it is in no catalogue, or none at all.
        told: what each effect's best law leaves (inside, outside, most), by effect; empty where no gap is
        seen.
        before: the gap as it is.
        fits: of the likeliest effects: `left`, `above` and `quieter` of `GoodnessOfFit`.
        answer: the diagnosis, by the weights that the package had.
    """

    shape: str
    drive: str
    soil: str
    severity: float
    effect: str | None
    told: dict[str, tuple[float, float, float]]
    before: tuple[float, float, float]
    fits: tuple[float, float, float]
    answer: dict[str, Any]

    def teaches(self) -> bool:
        """Whether there is a gap, and it is seen."""
        return bool(self.told) and self.shape != NULL


def site(number: int) -> tuple[str, str, list[tuple[Shape | None, float]]]:
    """Kind of drive, ground, and shapes with severities of a site; no shape is a trial without a gap."""
    rng = np.random.default_rng([FIRST_SEED, number, 1])
    kind, soil = KINDS[number % 2], SOILS[(number // 2) % len(SOILS)]
    out = list[tuple[Shape | None, float]]()
    for family, count in ((SAME, SINGLES // 2), (SHIFTED, SINGLES // 2), (OUTSIDE, OUTSIDERS)):
        pool = [s for s in (*IN_CATALOGUE, *OUT_OF_CATALOGUE) if s.kind == family]
        turn = np.random.default_rng([FIRST_SEED, len(family)]).permutation(len(pool))
        chosen = [pool[turn[(number * count + i) % len(pool)]] for i in range(count)]
        out += [(shape, float(rng.choice(SEVERITIES, p=[0.2, 0.35, 0.45]))) for shape in chosen]
    return kind, soil, out + [(None, 0.0)] * NULLS


def specs(number: int, references: int = REFERENCES) -> list[RunSpec]:
    """Runs of a site: its trials', then so many references."""
    kind, soil, trials = site(number)
    rng = np.random.default_rng([FIRST_SEED, number, 2])
    vehicle, ground, robot = load_vehicle(VEHICLE), load_soil(soil), int(rng.integers(2**31))

    def one(place: int, seed: int, changes: Mapping[str, float]) -> RunSpec:
        own = np.random.default_rng([FIRST_SEED, number, 3, place])
        heading = float(own.uniform(-np.pi, np.pi))
        run_seed = int(np.random.default_rng([FIRST_SEED, number, 4, seed]).integers(2**31))
        return RunSpec(vehicle, ground, drive(kind, own), heading, run_seed, robot, dict(changes))

    out = []
    for t, (shape, severity) in enumerate(trials):
        changes = {} if shape is None else shape.turned(shape_size(shape, kind, severity), rng)
        out += [one(i, RUNS * t + i, changes) for i in range(RUNS)]
    return out + [one(RUNS + i, RUNS * len(trials) + i, {}) for i in range(references)]


def make(number: int, jobs: int) -> list[Trial]:
    """The trials of a site, diagnosed."""
    from terrafusion.twin.gap.blind.plant.run import record
    from terrafusion.twin.gap.data.candidates import Candidates
    from terrafusion.twin.gap.null.evidence import gather_evidence
    from terrafusion.twin.gap.threads import one_blas_thread

    _, _, trials = site(number)
    recordings, split = record(specs(number)), RUNS * len(trials)
    vehicle = load_vehicle(VEHICLE)
    with one_blas_thread():
        evidence = gather_evidence(
            recordings[:split], recordings[split:], vehicle, None, Candidates.of(), jobs=jobs
        )
        return diagnosed_trials(number, evidence)


def diagnosed_trials(number: int, evidence: GapEvidence) -> list[Trial]:
    """The trials of a site, from the evidence of all its runs."""
    from terrafusion.twin.gap.diagnose import diagnose_evidence

    kind, soil, trials = site(number)
    out = []
    for t, (shape, severity) in enumerate(trials):
        mine = slice(RUNS * t, RUNS * (t + 1))
        part = dataclasses.replace(evidence, runs=evidence.runs[mine], residuals=evidence.residuals[mine])
        found = diagnose_evidence(part, VEHICLE)
        good = found.verdict.goodness or PERFECT_FIT
        told = {k: _numbers(v) for k, v in found.posterior.residuals.items()} if found.detected else {}
        key, effect = NULL, None
        if shape is not None:
            key, effect = shape.key, None if shape.kind == OUTSIDE else shape.effect
        out.append(
            Trial(
                key, kind, soil, severity, effect, told, _numbers(found.posterior.before),
                (good.left, good.above, good.quieter), _brief(found.to_json()),
            )
        )  # fmt: skip
        print(f"{key} {severity:g}: {found.verdict.kind} {' '.join(found.verdict.named)}", flush=True)
    return out


def _brief(answer: Mapping[str, Any]) -> dict[str, Any]:
    """What of an answer is scored."""
    return {key: answer[key] for key in ("gap", "verdict", "named", "causes", "p_unknown", "shrink")}


def _numbers(told: CauseResidual) -> tuple[float, float, float]:
    return told.inside, told.outside, told.most


def utilities(trial: Trial, weights: PosteriorWeights) -> dict[str | None, float]:
    """Log odds of all causes of a trial; None is the unknown one."""
    before = CauseResidual(*trial.before)
    odds: dict[str | None, float] = {
        k: weights.log_odds(CauseResidual(*v), before) for k, v in trial.told.items()
    }
    odds[None] = weights.unknown_log_odds(before, GoodnessOfFit(*trial.fits))
    return odds


def surprise(trials: Iterable[Trial], weights: PosteriorWeights, outside: float = 1.0) -> float:
    """Negative log likelihood of the true causes; each one outside the catalogue counts `outside` times."""
    total = 0.0
    for trial in trials:
        odds = utilities(trial, weights)
        share = math.exp(odds[trial.effect] - float(np.logaddexp.reduce(list(odds.values()))))
        count = outside if trial.effect is None else 1.0
        total -= count * math.log((1.0 - LAPSED) * share + LAPSED / len(odds))
    return total


def train(trials: Sequence[Trial]) -> PosteriorWeights:
    """Weights of least surprise on trials in which a gap was seen.

    A site has more causes outside the catalogue than `OUTSIDE_SHARE`: each counts less.
    """
    from scipy.optimize import minimize

    some = [trial for trial in trials if trial.teaches()]
    outsiders = sum(trial.effect is None for trial in some)
    outside = OUTSIDE_SHARE / (1.0 - OUTSIDE_SHARE) * (len(some) - outsiders) / max(outsiders, 1)

    def cost(w: Array) -> float:
        return surprise(some, PosteriorWeights(*w.tolist()), outside) + SHRINK * float(w @ w)

    limits = [(0.0, 60.0), (0.0, 1.5), (-20.0, 20.0), (0.0, 10.0), (0.0, 10.0)]
    return PosteriorWeights(
        *minimize(cost, [6.0, 0.8, 0.0, 1.0, 1.0], method="L-BFGS-B", bounds=limits).x.tolist()
    )


def unknown_chance(trial: Trial, weights: PosteriorWeights) -> float:
    """Probability of an unknown cause, given that there is a gap."""
    odds = utilities(trial, weights)
    outsider = odds.pop(None)
    return probabilities({str(effect): value for effect, value in odds.items()}, outsider)[1]


def crossed(sites: Sequence[Sequence[Trial]]) -> tuple[list[float], list[float]]:
    """`unknown_chance` of trials with effects of the catalogue, and of those with other causes, where a gap
    is seen, by weights trained on all other sites."""
    known, outside = list[float](), list[float]()
    for i, mine in enumerate(sites):
        weights = train([trial for j, some in enumerate(sites) if j != i for trial in some])
        for trial in (t for t in mine if t.teaches()):
            (outside if trial.effect is None else known).append(unknown_chance(trial, weights))
    return known, outside


def scores(trials: Sequence[Trial]) -> dict[str, Any]:
    """Scores of the answers, as a blind check has them."""
    from terrafusion.twin.gap.blind.plan import Trial as Planned
    from terrafusion.twin.gap.blind.score import score

    planned, answers = [], {}
    for i, t in enumerate(trials):
        family = t.shape if t.shape == NULL else shapes()[t.shape].kind
        keys = () if t.shape == NULL else (t.shape,)
        planned.append(Planned(f"{i}", family, t.drive, t.severity, t.soil, keys, (), i, RUNS, REFERENCES))
        answers[f"{i}"] = {"answer": t.answer, "seconds": 0.0}
    return score(planned, answers)


def deviations(trials: Iterable[Trial]) -> list[float]:
    """By how many of its sigmas each size that is told differs from the true one: of effects by the
    catalogue's own law that come first, where one parameter tells them (no sign: a change turns either
    way)."""
    out = []
    for trial in trials:
        first = trial.answer["causes"][0]
        if not trial.teaches() or not trial.shape.endswith(SAME) or first["effect"] != trial.effect:
            continue
        told = list(first["parameters"].values())
        if len(told) == 1 and told[0]["sigma"] is not None:
            true = shape_size(shapes()[trial.shape], trial.drive, trial.severity)
            out.append((abs(told[0]["value"]) - true) / told[0]["sigma"])
    return out


def lines(found: Mapping[str, Any]) -> list[str]:
    """The scores that matter here, in words."""
    out = [
        f"seen {family}: {sum(c['hits'] for c in mine)} of {sum(c['count'] for c in mine)}"
        for family in (SAME, SHIFTED, OUTSIDE)
        if (mine := [c for c in found["power"] if c["family"] == family])
    ]
    rates = {"false alarms": found["false_alarms"]["all"]}
    for family in (SAME, SHIFTED):
        rates[f"first class right, {family}"] = found["top1"][family]
        rates[f"of three, {family}"] = found["top3"][family]
        rates[f"falsely unknown, {family}"] = found["unknown"][f"false_{family}"]
    rates["unknown, outside"] = found["unknown"]["recall"]
    out += [f"{name}: {one['hits']} of {one['count']}" for name, one in rates.items()]
    ece = {name: one["ece"] for name, one in found["confidence"].items()}
    return out + [f"ECE {name}: {value:.2f}" for name, value in ece.items() if value is not None]


def read(paths: Iterable[Path]) -> list[Trial]:
    """Trials of some sites."""
    rows = [row for path in paths for row in json.loads(path.read_text(encoding="utf-8"))]
    return [
        Trial(
            **row
            | {"told": {k: tuple(v) for k, v in row["told"].items()}}
            | {key: tuple(row[key]) for key in ("before", "fits")}
        )
        for row in rows
    ]


def write(path: Path, weights: PosteriorWeights, trials: Sequence[Trial], sites: int) -> None:
    """The weights, with what they come from: the digest is that of all but the answers, which depend on the
    weights of their time."""
    told = [dataclasses.asdict(dataclasses.replace(trial, answer={})) for trial in trials]
    digest = hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]
    lines = [
        "# Weights of the odds of causes (see cause_posterior.py), made by",
        "# python -m tests.studies.blind.development train",
        f"# from {sum(t.teaches() for t in trials)} trials with a gap of {sites} sites;",
        f"# sha256 {digest}",
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
    making.add_argument("--jobs", type=int, default=1)
    scoring = commands.add_parser("score")
    scoring.add_argument("sites", type=Path, nargs="+")
    crossing = commands.add_parser("cross")
    crossing.add_argument("sites", type=Path, nargs="+")
    training = commands.add_parser("train")
    training.add_argument("sites", type=Path, nargs="+")
    training.add_argument("--without", nargs="*", default=[], help="true effects that are kept out")
    training.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    if given.command == "make":
        given.out.mkdir(parents=True, exist_ok=True)
        rows = [dataclasses.asdict(trial) for trial in make(given.site, given.jobs)]
        (given.out / f"site-{given.site:03d}.json").write_text(json.dumps(rows), encoding="utf-8")
        return
    if given.command == "score":
        print("\n".join(lines(scores(read(given.sites)))))
        far = np.abs(deviations(read(given.sites)))
        for most in (1.0, 2.0, 3.0):
            print(f"sizes within {most:g} sigma: {int((far < most).sum())} of {len(far)}")
        return
    if given.command == "cross":
        known, outside = crossed([read([path]) for path in sorted(given.sites)])
        for most in CROSSED:
            false, told = (sum(p > most for p in some) for some in (known, outside))
            print(f"above {most:g}: falsely {false} of {len(known)}, rightly {told} of {len(outside)}")
        return
    trials = [t for t in read(sorted(given.sites)) if t.shape.split("/")[0] not in given.without]
    write(given.out, train(trials), trials, len(given.sites))


if __name__ == "__main__":
    main()
