"""Suggests a drive that would distinguish two look-alikes: the twin simulates each of a small catalogue and
counts by how many standard deviations the two effects, at the size found, would differ there and in the
judged runs together. Together, since the size of an effect is the same in both: an effect that scales with
the load and one that does not differ as soon as the load changes."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.printable import times
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.twin.calibrate.inputs import DT_S
from terrafusion.twin.calibrate.log import PreparedLog, split_windows
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.observations import Observed
from terrafusion.twin.gap.answer.verdict import Cause, GapVerdict
from terrafusion.twin.gap.data.logs import WINDOW_S
from terrafusion.twin.gap.data.samples import with_observed
from terrafusion.twin.gap.infer.law_misfit import GROUND
from terrafusion.twin.gap.infer.other_drives import RobotOffsets
from terrafusion.twin.gap.infer.predictive import marginalise_robot_offsets, marginalise_run_offsets
from terrafusion.twin.gap.null.evidence import GapEvidence
from terrafusion.twin.gap.null.score import Score, score
from terrafusion.twin.gap.rollout.batch import SOIL_SIGMAS
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, residuals_from, whitened
from terrafusion.twin.gap.rollout.sensitivities import Course, channel_sensitivities, linearise_all, turned
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.scenario.commands import open_loop
from terrafusion.twin.scenario.file import scenario_of
from terrafusion.twin.scenario.scenario import Scenario

BY_HAND = "measurement by hand"
SEPARABLE_SIGMAS = 3.0  # sigmas by which a drive must distinguish two effects
MOST_REPEATS = 10  # if the best drive would have to be repeated more often, none is suggested
LIFTED = "wheels lifted"
PAYLOAD = ", with payload"
PAYLOAD_SHARE = 0.25  # of the robot's mass, at its centre of gravity
STAND_MASS_KG = 1.0  # what a twin on a stand puts on its wheels: next to nothing


@functools.cache
def drives() -> dict[str, Scenario]:
    """Drives that are tried, by name: about 30 s each, level, on the soil of the runs."""
    path = Path(__file__).with_name("next_drives.yaml")
    return {name: scenario_of({"drive": d}, str(path), name) for name, d in read_yaml(path).items()}


@dataclass(frozen=True)
class NextRun:
    """A drive, the two effects that it separates, by how many sigmas one such drive does, and a sentence."""

    scenario: str
    separates: tuple[str, str]
    sigmas: float
    why: str


@dataclass(frozen=True, eq=False)
class Planner:
    """Plans runs of a robot.

    Attributes:
        sigma: (T,) 1 sigma of the states.
        known: (P, P) information of the judged runs on the columns, beyond what scatters from run to run.
    """

    evidence: GapEvidence
    sigma: Array
    robot: RobotOffsets
    known: Array

    @classmethod
    def of(cls, evidence: GapEvidence, sigma: Array, robot: RobotOffsets, scores: Sequence[Score]) -> Self:
        """After judged runs with these scores."""
        return cls(
            evidence, sigma, robot, np.sum([marginalise_run_offsets(s.A, robot) for s in scores], axis=0)
        )

    def next_run(self, verdict: GapVerdict) -> NextRun | None:
        """For the first named cause with look-alikes and the most probable of these; None without one."""
        first = verdict.ambiguous() if verdict.kind == "ambiguous" else None
        if first is None:
            return None
        other = next(c for c in verdict.causes if c.effect == first.members[1])
        return self.propose(first, other)

    def propose(self, one: Cause, other: Cause) -> NextRun:
        """The drive on which two causes differ most; a direct measurement where none separates them."""
        pair, c = (one.effect, other.effect), self.evidence.candidates
        if max(*one.columns, *other.columns) >= c.count:  # nothing tells how it would act on other drives
            why = f"no drive is planned for these laws of {pair[0]} and {pair[1]}: measure one directly"
            return NextRun(BY_HAND, pair, 0.0, why)
        effects = {*pair}
        found = self.forecast(tuple(drives()), effects)

        def sigmas(name: str, repeats: int = 1) -> float:
            return self.separation(one, other, repeats * found[name])

        best = max(found, key=sigmas)
        scenario, apart = best, f"{sigmas(best):.1f} sigma"
        enough = [n for n in range(1, MOST_REPEATS + 1) if sigmas(best, n) >= SEPARABLE_SIGMAS]
        if enough:
            mass = PAYLOAD_SHARE * self.evidence.model.vehicle.body.mass_kg
            load = f" ({mass:.2g} kg more, as near the centre of gravity as possible)" * (PAYLOAD in best)
            parts = in_words(drives()[best], self.evidence.model.vehicle.drive.max_speed_mps)
            why = (
                f"{parts}. Of {len(drives())} drives simulated, this one separates {pair[0]} from {pair[1]} "
                f"best: by {apart}, together with these runs; drive it {times(enough[0])}{load}"
            )
        else:
            scenario, why = (
                BY_HAND,
                (
                    f"none of the drives tried separates {pair[0]} from {pair[1]} (the best, '{best}', by "
                    f"{apart} in the twin): measure one of the two directly"
                ),
            )
        return NextRun(scenario, pair, sigmas(best), why)

    def separation(self, one: Cause, other: Cause, more: Array | float = 0.0) -> float:
        """Sigmas by which runs separate two causes, whichever is true.

        Args:
            more: (P, P) information of further runs, from `forecast`.
        """
        every = marginalise_robot_offsets(self.known + more, self.robot)
        return min(self._remaining_sigmas(every, a, b.effect) for a, b in ((one, other), (other, one)))

    def _remaining_sigmas(self, information: Array, true: Cause, other: str) -> float:
        """Sigmas that remain of the true cause once any form of the other is fitted to it."""
        at, c = np.asarray(true.columns), self.evidence.candidates
        signal = information[:, at] @ true.value
        square = float(true.value @ signal[at])
        forms = (h.columns for h in c.hypotheses if h.effect == other and not c.is_composite(h))
        explained = max(_explained(information, signal, columns) for columns in forms)
        return math.sqrt(max(square - explained, 0.0))

    def forecast(self, names: Sequence[str], effects: set[str]) -> dict[str, Array]:
        """Information (P, P) of drives on some effects; zero where the twin diverges."""
        out = dict.fromkeys(names, np.zeros((len(self.known),) * 2))
        for name, run in forecast_runs(self.evidence, names, effects).items():
            out[name] = information = marginalise_run_offsets(score(run, self.sigma).A, self.robot)
            if name == LIFTED:  # nothing of the ground acts in the air, its strength as a state included
                keys = self.evidence.candidates.keys[: self.evidence.candidates.count]
                ground = [i for i, key in enumerate(keys) if key.split("/")[0] in GROUND]
                information[ground, :] = information[:, ground] = 0.0
        return out


def in_words(scenario: Scenario, max_speed_mps: float) -> str:
    """What a drive commands, one part after the other, no faster than the robot goes."""
    parts = list[str]()
    for s in scenario.drive:
        v_mps = float(np.clip(s.v_mps, -max_speed_mps, max_speed_mps))
        wave = f", {1.0 / s.period_s:.2g} to {1.0 / max(s.end_period_s, 1e-9):.2g} Hz"
        swings = [(v_mps, s.v_amplitude_mps, "m/s"), (s.yaw_rate_radps, s.yaw_rate_amplitude_radps, "rad/s")]
        twist = [f"{x:g}{f' +- {a:g}' if a else ''} {unit}" for x, a, unit in swings if x or a]
        waves = s.v_amplitude_mps or s.yaw_rate_amplitude_radps
        parts += [f"{s.duration_s:.2g} s at {', '.join(twist)}{wave if waves else ''}"] if twist else []
    return "; ".join(parts)


def _explained(information: Array, signal: Array, columns: Sequence[int]) -> float:
    """Square of a signal, given by its inner products (P,) with all columns, that some columns explain."""
    b = np.asarray(columns)
    within = information[np.ix_(b, b)]
    within = within + 1e-9 * np.eye(len(b)) * max(float(np.trace(within)), 1e-12)
    return float(signal[b] @ np.linalg.solve(within, signal[b]))


def forecast_runs(evidence: GapEvidence, names: Sequence[str], effects: set[str]) -> dict[str, WhitenedRun]:
    """Sensitivities of drives not yet driven, their errors zero; None of one where the twin diverges."""
    candidates, courses = evidence.candidates, [course_of(evidence, name, effects) for name in names]
    out = dict[str, WhitenedRun]()
    for name, own, run in zip(names, courses, linearise_all(courses, candidates), strict=True):
        if run is not None:
            found = channel_sensitivities(own.log, run)
            pairs = zip(own.log.observed, found, strict=True)
            log = with_observed(own.log, [dataclasses.replace(o, value=s.value) for o, s in pairs])
            residuals = residuals_from(log, turned(log, found), own.model, candidates, evidence.channels)
            out[name] = whitened(residuals, evidence.noise)
    return out


def course_of(evidence: GapEvidence, name: str, effects: set[str]) -> Course:
    """A drive by the twin, with the columns of some effects."""
    template, model, scenario = evidence.runs[0].log, evidence.model, drives()[name]
    label = template.labels[0]
    if name == LIFTED:
        model, effects = _lifted(model, label), effects - GROUND
    elif PAYLOAD in name:
        payload_kg = model.payload_kg + PAYLOAD_SHARE * model.vehicle.body.mass_kg
        model = dataclasses.replace(model, payload_kg=payload_kg)
    t_s = DT_S * np.arange(round(scenario.duration_s / DT_S) + 1.0)
    prompt = dataclasses.replace(model.vehicle.drive, dead_time_s=0.0)  # the log's commands have none either
    _, inputs = open_loop(scenario, t_s, dataclasses.replace(model.vehicle, drive=prompt))
    windows = split_windows(0.0, scenario.duration_s, WINDOW_S)
    end = float(windows[-1, 1]) * DT_S
    log = PreparedLog(
        name, inputs[:, :2], template.follows, (label,), np.zeros(0), windows,
        np.zeros((len(windows), 3)), tuple(_empty(o, end) for o in template.observed), True, (),
    )  # fmt: skip
    keys = {k for k in evidence.candidates.keys if k.split("/")[0] in effects or k in SOIL_SIGMAS}
    return Course(log, model, log.start, keys)


def _lifted(model: Model, label: str) -> Model:
    """The twin on a stand that carries its body: the wheels have neither load nor friction."""
    firm = load_soil("asphalt")
    shear = dataclasses.replace(firm.shear, friction_angle_rad=1e-6, friction_cap=1e-6)
    air = dataclasses.replace(firm, shear=shear, resistance=dataclasses.replace(firm.resistance, rolling=0.0))
    body = dataclasses.replace(model.vehicle.body, mass_kg=STAND_MASS_KG)
    vehicle = dataclasses.replace(model.vehicle, body=body)
    return dataclasses.replace(model, vehicle=vehicle, payload_kg=0.0, soils={**model.soils, label: air})


def _empty(observed: Observed, end_s: float) -> Observed:
    """Regular samples of a channel up to a time, with the noise of those of a log."""
    slot = np.arange(1, max(2, int(end_s / observed.slot_s)))
    end: Array = slot.astype(float) * observed.slot_s
    length = float(np.median(observed.end_s - observed.begin_s))
    return Observed(
        observed.channel, end - length, end, np.zeros(len(slot)), np.full(len(slot),
        np.median(observed.sigma)), slot, observed.slot_s, observed.least, observed.correlation,
    )  # fmt: skip
