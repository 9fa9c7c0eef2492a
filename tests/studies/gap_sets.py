"""Sets of the twin's own runs on which the diagnosis is developed, and its calibration head.

    python -m tests.studies.gap_sets make 0 40 --out sets
    python -m tests.studies.gap_sets train sets/*.json --out head.yaml
    python -m tests.studies.gap_sets score sets/*.json

A set is one robot on one soil, its numbers off by up to 10 % in half of the sets, 5 to 20 references on one
random drive and 1 to 3 runs on another, with no effect, one, or two of any form at 1.5 to 6 typical sizes.
A set with one effect is also judged without its form, and without it: then its cause is another law, or
outside the catalogue. Sets from `ODD` to `HELD_OUT` have a cause that no catalogue has. Nothing here is of
the plant of the blind check. Numbers below `HELD_OUT` are for development, those above for judging it.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.effects.catalogue import catalogue, parameters
from terrafusion.twin.gap.answer.verdict import (
    FINEST_P,
    credible_members,
    credible_sets,
    most_probable,
    null_probability,
)
from terrafusion.twin.gap.blind.rates import Rate, Reliability, reliability
from terrafusion.twin.gap.data.candidates import Candidates
from terrafusion.twin.gap.data.threads import one_blas_thread
from terrafusion.twin.gap.infer.calibration import Head, calibration_head, probabilities
from terrafusion.twin.gap.infer.detection import detect
from terrafusion.twin.gap.infer.explain import Explanation, explain
from terrafusion.twin.gap.infer.law_misfit import with_law_misfit
from terrafusion.twin.gap.infer.other_drives import learn_offsets
from terrafusion.twin.gap.infer.run_states import learn_state_sigma
from terrafusion.twin.gap.null.drives import drive_coverage
from terrafusion.twin.gap.null.evidence import gather_evidence
from terrafusion.twin.gap.null.score import score
from terrafusion.twin.gap.rollout.residuals import initial_state_sigma
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.scenario.scenario import DriveSegment, RouteLeg, Scenario
from terrafusion.twin.sensors.effects import DELAYS
from terrafusion.twin.simulate import simulate

FIRST_SEED, ODD, HELD_OUT = 51_234, 60, 100
CROSSTALK, LEAK_RADPS_A, SWING_RADPS = 0.04, 3e-3, 0.05
"""Typical sizes of causes that no catalogue has: of the right wheels' speed in the left ones', of yaw rate an
ampere of motor current, and of a yaw rate that swings by itself."""
ROBOTS = (("elevate", "medium_sand"), ("husky", "gravel"), ("warthog", "grass"))
KINDS = {
    "slow": (0.2, 0.6, 0.25),
    "fast": (0.7, 1.3, 0.3),
    "turns": (0.1, 0.8, 0.6),
    "straight": (0.3, 1.2, 0.03),
}
"""Least and greatest speed (m/s), and greatest turn rate (rad/s), of random drives."""
GROUND, SPREAD = ("soil_strength/shear", "soil_strength/bearing"), 0.05
SIZES, LONGEST_S = (1.5, 3.0, 6.0), 26.0
UNKNOWN_SHARE = 0.2  # weight of causes outside the catalogue in training
SIGNIFICANCE = 0.05
LEAST_LAW = (0.1, 0.03)
"""Least errors of sizes on the motion and of others (assumed): the twin's own laws are never as wrong."""


@dataclass(frozen=True)
class SetSpec:
    """What a set consists of: effects by key that all runs have, and that the judged ones have besides."""

    number: int
    robot: str
    soil: str
    drives: tuple[str, str]
    segments: tuple[tuple[DriveSegment, ...], tuple[DriveSegment, ...]]
    references: int
    runs: int
    off: dict[str, float]
    changes: dict[str, float]

    def effects(self) -> tuple[str, ...]:
        """Names of the true effects."""
        return tuple(sorted({key.split("/")[0] for key in self.changes}))


def segments(kind: str, rng: np.random.Generator) -> tuple[DriveSegment, ...]:
    """A random drive."""
    low, high, turn = KINDS[kind]
    out, length = [DriveSegment(1.0)], 2.0
    while length < LONGEST_S:
        duration = float(rng.uniform(2.5, 6.0))
        length += duration
        stop = rng.random() < 0.1
        speed, rate = float(rng.uniform(low, high)), float(rng.uniform(-turn, turn))
        out.append(DriveSegment(duration) if stop else DriveSegment(duration, speed, rate))
    return (*out, DriveSegment(1.0))


def spec(number: int) -> SetSpec:
    """A set, by its number alone."""
    rng = np.random.default_rng([FIRST_SEED, number])
    robot, soil = ROBOTS[number % len(ROBOTS)]
    first = str(rng.choice(list(KINDS)))
    same = bool(rng.random() < 0.2)
    second = first if same else str(rng.choice(list(KINDS)))
    one = segments(first, rng)
    other = one if same else segments(second, rng)
    references, runs, off = int(rng.choice([5, 12, 12, 20])), int(rng.choice([1, 1, 3])), dict[str, float]()
    if rng.random() < 0.5:
        most = {"mass/at_cg": 0.1, "track_width/scale": 0.1, "wheel_radius/scale": 0.02, GROUND[0]: 0.3}
        off = {key: float(rng.uniform(-limit, limit)) for key, limit in most.items()}
    count = 0 if number in range(ODD, HELD_OUT) else int(rng.choice([0, 1, 2], p=[0.25, 0.6, 0.15]))
    changes = dict[str, float]()
    for name in rng.choice(sorted(Candidates.of().effects), count, replace=False):
        changes |= change(str(name), rng)
    return SetSpec(number, robot, soil, (first, second), (one, other), references, runs, off, changes)


def change(effect: str, rng: np.random.Generator) -> dict[str, float]:
    """Parameters of an effect by a random form of it."""
    forms = [form for form in catalogue().values() if form.candidate and form.effect == effect]
    form, size, out = forms[int(rng.integers(len(forms)))], float(rng.choice(SIZES)), dict[str, float]()
    for key, (owner, p) in parameters().items():
        if owner.key == form.key:
            sign = 1.0 if p.low >= 0.0 else float(rng.choice([-1.0, 1.0]))
            part = float(rng.uniform(0.5, 1.0))
            out[key] = float(np.clip(sign * part * size * p.scale, 0.8 * p.low, 0.8 * p.high))
    return out


def run(of: SetSpec, judged: bool, seed: int) -> Recording:
    """One run without truth; the ground's strength varies from run to run."""
    rng, effects = np.random.default_rng(seed), dict(of.off)
    for key, value in (of.changes if judged else {}).items():
        effects[key] = effects.get(key, 0.0) + value
    for key in GROUND:
        effects[key] = effects.get(key, 0.0) + SPREAD * float(rng.standard_normal())
    drive = of.segments[int(judged)]
    length = sum(s.duration_s for s in drive)
    scenario = Scenario(of.drives[int(judged)], length, route=(RouteLeg(of.soil),), drive=drive)
    made = simulate(scenario, vehicle=of.robot, seed=seed, effects=effects)
    if judged and of.number in range(ODD, HELD_OUT):
        made = odd(made, of.number)
    return dataclasses.replace(made, name=f"run {seed}", truth=None, truth_channels=())


def odd(run: Recording, number: int) -> Recording:
    """With a cause that no catalogue has."""
    size = float(np.random.default_rng([FIRST_SEED, number, 1]).uniform(0.5, 2.0))
    assert run.wheels is not None
    assert run.imu is not None
    assert run.motor is not None
    if number % 3 == 0:
        speed = run.wheels.speed.copy()
        speed[:, 0] += size * CROSSTALK * speed[:, 1]
        return dataclasses.replace(run, wheels=dataclasses.replace(run.wheels, speed=speed, angle_rad=None))
    gyro, t_s = run.imu.gyro_radps.copy(), 1e-9 * (run.imu.t_ns - run.start_ns)
    if number % 3 == 1:
        current = np.interp(run.imu.t_ns, run.motor.t_ns, run.motor.current_a.sum(axis=1))
        gyro[:, 2] += size * LEAK_RADPS_A * current
    else:
        gyro[:, 2] += size * SWING_RADPS * np.sin(2.0 * np.pi * 0.4 * t_s)
    return dataclasses.replace(run, imu=dataclasses.replace(run.imu, gyro_radps=gyro))


def make(number: int, jobs: int = 1) -> dict[str, Any]:
    """What the diagnosis finds in a set, before its head: with all candidates and without the true effect."""
    of = spec(number)
    base = 10_000_000 + 1000 * number
    references = [run(of, False, base + i) for i in range(of.references)]
    runs = [run(of, True, base + 500 + i) for i in range(of.runs)]
    vehicle = load_vehicle(of.robot)
    candidates = Candidates.of().sized_for(vehicle)
    with one_blas_thread():
        evidence = gather_evidence(runs, references, vehicle, of.soil, candidates, jobs=jobs)
        sigma = learn_state_sigma(evidence.references, initial_state_sigma(candidates))
        robot = learn_offsets([score(r, sigma) for r in evidence.references], candidates.count)
        drives = drive_coverage(evidence.runs, evidence.references, evidence.model)
        evidence, robot = with_law_misfit(evidence, sigma, robot)
        found = detect([score(r, sigma) for r in evidence.runs], robot, candidates, 0)
        seen = found.p_value <= SIGNIFICANCE
        out = {"number": number, "truth": of.changes, "p": found.p_value}
        out["other_drives"] = drives is not None and drives.limits()
        left = {"known": ()}
        if len(of.effects()) == 1 and seen:
            forms = {"/".join(key.split("/")[:2]) for key in of.changes}
            others = {h.form for h in candidates.hypotheses if h.effect == of.effects()[0]}
            left |= {"outside": of.effects()} | ({"shifted": tuple(forms)} if len(others) > 1 else {})
        for name, without in left.items():
            out[name] = stored(explain(evidence, sigma, robot, close=seen, without=without), candidates)
    return out


def stored(found: Explanation, candidates: Candidates) -> dict[str, Any]:
    """An explanation as JSON has it; sizes are those of the best laws of each single effect."""
    sizes = {}
    for effects, fit in found.fits.items():
        if len(effects) == 1 and len(fit.laws[0].columns) == 1:
            (column,) = fit.laws[0].columns
            scale = float(candidates.scale[column])
            sigma = math.sqrt(float(fit.covariance[0][0, 0]))
            sizes[candidates.keys[column]] = (float(fit.values[0][0]) * scale, sigma * scale)
    evidence = {"+".join(k): v for k, v in found.evidence.items() if math.isfinite(v)}
    alike = {effect: sorted(some) for effect, some in found.alike.items()}
    return {"evidence": evidence, "outside": found.outside, "sizes": sizes, "alike": alike}


def restored(found: Mapping[str, Any]) -> Explanation:
    """The explanation without its fits."""
    evidence = {tuple(k.split("+")): v for k, v in found["evidence"].items()}
    alike = {effect: {*some} for effect, some in found["alike"].items()}
    return Explanation(evidence, {}, found["outside"], alike, lambda fit: [])


def p_value(one: Mapping[str, Any]) -> float:
    """Of the gap in a set, as fine as the verdict takes it."""
    return max(float(one["p"]), FINEST_P[bool(one["other_drives"])])


def questions(sets: Sequence[Mapping[str, Any]]) -> list[tuple[Explanation, float, tuple[str, ...] | None]]:
    """Explanations of gaps that are seen, with the true effects; None for a cause outside the candidates."""
    out: list[tuple[Explanation, float, tuple[str, ...] | None]] = []
    for one in sets:
        truth = tuple(sorted({key.split("/")[0] for key in one["truth"]}))
        odd_one = one["number"] in range(ODD, HELD_OUT)
        if one["p"] <= SIGNIFICANCE and (truth or odd_one):
            p = p_value(one)
            out.append((restored(one["known"]), p, None if odd_one else truth))
            out += [(restored(one["shifted"]), p, truth)] if "shifted" in one else []
            out += [(restored(one["outside"]), p, None)] if "outside" in one else []
    return out


def train(sets: Sequence[Mapping[str, Any]]) -> Head:
    """The head of least surprise about the true sets of effects, and the scatter of sizes."""
    from scipy.optimize import minimize

    asked, effects = questions(sets), len(Candidates.of().effects)
    outsiders = sum(truth is None for _, _, truth in asked)
    weight = UNKNOWN_SHARE / (1.0 - UNKNOWN_SHARE) * (len(asked) - outsiders) / max(outsiders, 1)

    def surprise(x: np.ndarray) -> float:
        head, total = Head(1.0 + math.exp(x[0]), x[1], 0.0, 0.0), 0.0
        for found, p, truth in asked:
            known, unknown = probabilities(found, effects, head, p)
            own = unknown if truth is None else sum(q for s, q in known.items() if {*s} & {*truth})
            total -= (weight if truth is None else 1.0) * math.log(max(own, 1e-4))
        return total + 0.05 * float(np.square(x - start) @ (1.0, 0.1))

    start = np.array([0.0, -3.0])
    x = minimize(surprise, start, method="Nelder-Mead", options={"maxiter": 400}).x
    motion, sensor = law_errors(sets)
    return Head(1.0 + math.exp(x[0]), float(x[1]), motion, sensor)


def law_errors(sets: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Root mean square error of sizes beyond their sigma, as a share of the size, of effects on the motion
    and of others of the sensors: of single effects whose own law is the best."""
    moving, out = {*Candidates.of().moving, *DELAYS}, dict[bool, list[float]]({True: [], False: []})
    for one in sets:
        if len(one["truth"]) == 1 and one["p"] <= SIGNIFICANCE:
            ((key, true),) = one["truth"].items()
            if key in one["known"]["sizes"]:
                value, sigma = one["known"]["sizes"][key]
                share = ((value - true) ** 2 - sigma**2) / true**2
                out[key in moving].append(float(np.clip(share, 0.0, 0.25)))
    return tuple(
        max(math.sqrt(float(np.mean(some))) if some else 0.0, least)
        for some, least in zip(out.values(), LEAST_LAW, strict=True)
    )  # type: ignore[return-value]


def scores(sets: Sequence[Mapping[str, Any]], head: Head) -> dict[str, Rate]:
    """Rates of right answers, by the package's rules."""
    effects, hits = len(Candidates.of().effects), dict[str, list[bool]]()
    for one in sets:
        truth = {key.split("/")[0] for key in one["truth"]}
        seen = one["p"] <= SIGNIFICANCE
        if one["number"] in range(ODD, HELD_OUT):
            hits.setdefault("odd seen", []).append(seen)
            if seen:
                found = probabilities(restored(one["known"]), effects, head, p_value(one))
                hits.setdefault("odd unknown", []).append(found[1] > 0.5)
            continue
        hits.setdefault("seen" if truth else "false alarms", []).append(seen)
        if "shifted" in one:
            known, unknown = probabilities(restored(one["shifted"]), effects, head, p_value(one))
            hits.setdefault("shifted right", []).append(bool(truth & {*max(known, key=lambda s: known[s])}))
            hits.setdefault("shifted falsely unknown", []).append(unknown > 0.5)
        if truth and seen:
            known, unknown = probabilities(restored(one["known"]), effects, head, p_value(one))
            best = max(known, key=lambda s: known[s])
            hits.setdefault("falsely unknown", []).append(unknown > 0.5)
            name = "one of one right" if len(truth) == 1 else "one of a pair right"
            hits.setdefault(name, []).append(bool(truth & {*best}))
            hits.setdefault("named as many", []).append(len(best) == len(truth))
        if "outside" in one:
            hits.setdefault("unknown", []).append(
                probabilities(restored(one["outside"]), effects, head, p_value(one))[1] > 0.5
            )
    return {name: Rate(sum(some), len(some)) for name, some in hits.items()}


def certainty(sets: Sequence[Mapping[str, Any]], head: Head) -> Reliability:
    """What is stated of the first class, by the package's rules, beside whether it holds a true effect."""
    effects, stated, true = len(Candidates.of().effects), list[float](), list[bool]()
    for found, p, truth in questions(sets):
        if truth is not None:
            known, unknown = probabilities(found, effects, head, p)
            certain = (1.0 - null_probability(p)) * (1.0 - unknown) / sum(known.values())
            known = {name: certain * q for name, q in known.items()}
            best = most_probable(known, found.evidence)
            first = credible_sets({e: credible_members(e, best, known, found.alike) for e in best}, known)[0]
            stated.append(first.probability)
            true.append(bool({*first.effects} & {*truth}))
    return reliability(stated, true)


def certainty_text(found: Reliability) -> str:
    """Calibration errors; none without a detected set of known cause."""
    if found.ece is None or found.brier is None:
        return "no set of known cause was detected"
    return f"ECE {found.ece:.3f}, Brier {found.brier:.3f} of {found.count}"


def main() -> None:
    """Make sets, fit the head, or score it."""
    parser = argparse.ArgumentParser(
        description="Development sets of the diagnosis and its calibration head."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make")
    making.add_argument("first", type=int)
    making.add_argument("end", type=int)
    making.add_argument("--out", type=Path, required=True)
    for name in ("train", "score"):
        part = commands.add_parser(name)
        part.add_argument("sets", type=Path, nargs="+")
        part.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.command == "make":
        given.out.mkdir(parents=True, exist_ok=True)
        for number in range(given.first, given.end):
            path = given.out / f"{number}.json"
            if not path.is_file():
                path.write_text(json.dumps(make(number)), encoding="utf-8")
                print(path, flush=True)
        return
    sets = [json.loads(path.read_text(encoding="utf-8")) for path in given.sets]
    head = calibration_head() if given.command == "score" else train(sets)
    for name, rate in scores(sets, head).items():
        print(f"{name}: {rate.hits} of {rate.count}")
    print(f"stated certainty against outcome: {certainty_text(certainty(sets, head))}")
    if given.command == "train":
        numbers = "".join(f"{name}: {value:.3g}\n" for name, value in dataclasses.asdict(head).items())
        text = f"# Fitted to {len(sets)} sets by\n# python -m tests.studies.gap_sets train\n{numbers}"
        print(text)
        if given.out is not None:
            given.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
