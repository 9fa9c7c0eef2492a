"""The opponent of the blind check: joint bounded least squares, as engineers identify a simulator today.

The parameters of each effect's first form are all free at once. The twin is calibrated to the references,
each reference gives one estimate more (their scatter goes into sigma), and the judged runs are fitted
together (bounded Gauss-Newton with a line search) on rollouts of the same twin. An effect is claimed where
change over sigma is significant (Student's t, Bonferroni over all parameters); the largest is ranked first.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.calibrate.noise import ResidualNoise
from terrafusion.twin.gap.data.candidates import SOIL_STRENGTH, Candidates
from terrafusion.twin.gap.data.logs import prepared
from terrafusion.twin.gap.data.poses import aligned_start
from terrafusion.twin.gap.rollout.residuals import WhitenedRun, residuals_from, whitened
from terrafusion.twin.gap.rollout.sensitivities import channel_sensitivities, linearise, moved_to, turned
from terrafusion.twin.gap.rollout.shared_errors import ChannelNoise
from terrafusion.twin.model.vehicle import VehicleParams

SIGNIFICANCE = 0.05
PRIOR = 3.0  # 1 sigma of every parameter in typical sizes: bounds what the data leave open
CALIBRATION_RUNS, FEWEST_REFERENCES, STEPS = 3, 3, 4
SHARES, ENOUGH = (1.0, 0.5, 0.25, 0.1), 1e-3  # of a step that are tried; least relative gain of a further one
LEAST_SIGMA = 0.2  # least sigma of a channel in that of its data sheet


@dataclass(frozen=True)
class LeastSquaresAnswer:
    """What the fit claims, in the form of `diagnosis.json` as far as it is scored."""

    content: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        return self.content


class _Fit:
    """Residuals of logs and their derivatives by all parameters x (P,), in typical sizes."""

    def __init__(self, model: Model, candidates: Candidates, channels: Sequence[str]) -> None:
        self.model, self.candidates, self.channels = model, candidates, channels
        self.keys, self.scale = candidates.keys, candidates.scale
        self.low, self.high = candidates.bounds(range(len(self.keys)))
        # White, in that of the data sheets.
        self.noise = ChannelNoise(dict.fromkeys(channels, ResidualNoise(1.0)))

    def of(self, log: PreparedLog, x: Array, derivatives: bool = True) -> WhitenedRun:
        """A log against the twin with parameters x, the pose at each window's start projected out."""
        effects = dict(zip(self.keys, (x * self.scale).tolist(), strict=True))
        model = dataclasses.replace(self.model, effects={**self.model.effects, **effects})
        run = linearise(log, model, self.candidates, log.start, None if derivatives else ())
        found = turned(log, channel_sensitivities(log, run))
        found = moved_to(log, found, log.start, aligned_start(log, [s.value for s in found], log.start))
        raw = residuals_from(log, found, model, self.candidates, self.channels)
        return whitened(raw.without_nuisance(), self.noise)

    def calibrated(self, logs: Sequence[PreparedLog]) -> Array:
        """Parameters (P,) of the logs together; sets each channel's noise to the residual they leave."""
        x = self.one_step(np.zeros(len(self.keys)), logs)
        left = [self.of(log, x, False) for log in logs]
        for i, channel in enumerate(self.channels):
            error = np.concatenate([run.error[run.channel == i] for run in left])
            self.noise[channel] = ResidualNoise(max(float(np.sqrt(np.mean(error**2))), LEAST_SIGMA))
        return x

    def one_step(self, x: Array, logs: Sequence[PreparedLog]) -> Array:
        """Bounded Gauss-Newton step from x on the logs together."""
        return self._step(x, logs)[0]

    def minimum(self, x: Array, logs: Sequence[PreparedLog]) -> tuple[Array, Array]:
        """Bounded least squares from x: parameters (P,) of the logs together, and information (P, P) there.

        Gauss-Newton with a line search: the trust regions of `scipy.optimize.least_squares` stall where
        parameters start on their bounds.
        """
        cost = self._cost(x, logs)
        for _ in range(STEPS):
            goal, information = self._step(x, logs)
            trials = ((self._cost(y, logs), y) for y in (x + share * (goal - x) for share in SHARES))
            before, (cost, x) = cost, next((found for found in trials if found[0] < cost), (cost, x))
            if cost > (1.0 - ENOUGH) * before:
                break
        return x, information

    def _cost(self, x: Array, logs: Sequence[PreparedLog]) -> float:
        squares = sum(float(self.of(log, x, False).gram[-1, -1]) for log in logs)
        return squares + float(np.sum((x / PRIOR) ** 2))

    def _step(self, x: Array, logs: Sequence[PreparedLog]) -> tuple[Array, Array]:
        from scipy.optimize import lsq_linear

        runs = [self.of(log, x) for log in logs]
        gram = sum((run.gram[run.states :, run.states :] for run in runs), np.zeros((len(x) + 1,) * 2))
        information, explained = gram[:-1, :-1] + np.eye(len(x)) / PRIOR**2, gram[:-1, -1] - x / PRIOR**2
        factor = np.linalg.cholesky(information).T
        goal = factor @ x + np.linalg.solve(factor.T, explained)
        return np.asarray(lsq_linear(factor, goal, (self.low, self.high)).x), information


def first_forms(every: Candidates) -> Candidates:
    """The first form of each effect."""
    forms = {h.effect: h for h in reversed(every.hypotheses)}
    kept = [forms[effect] for effect in every.effects]
    columns = [i for h in kept for i in h.columns]
    keys = tuple(every.keys[i] for i in columns)
    hypotheses = (dataclasses.replace(h, columns=tuple(columns.index(i) for i in h.columns)) for h in kept)
    return Candidates(
        keys, every.scale[columns], every.low[columns], every.high[columns],
        tuple(every.units[i] for i in columns), tuple(hypotheses),
        tuple(k for k in every.moving if k in keys), every.world_fixed & {*keys}, np.zeros(len(keys)),
    )  # fmt: skip


def joint_least_squares(
    runs: Sequence[Recording], references: Sequence[Recording], vehicle: VehicleParams, *, seed: int = 0
) -> LeastSquaresAnswer:
    """The opponent's answer; arguments as those of `diagnose` (nothing is drawn from the seed).

    Raises:
        DataError: too few references, or a log lacks a channel that is needed.
        TerrafusionError: the twin diverges.
    """
    if len(references) < FEWEST_REFERENCES:
        raise DataError(f"{len(references)} references", remedy=f"give at least {FEWEST_REFERENCES}")
    candidates = first_forms(Candidates.of())
    logs, model, _ = prepared([*runs, *references], vehicle, None)
    logs = [dataclasses.replace(log, input_step_s=0.0) for log in logs]  # commands at the times logged
    judged, normal = logs[: len(runs)], logs[len(runs) :]
    fit = _Fit(model, candidates, [o.channel for o in logs[0].observed])
    base = fit.calibrated(normal[:CALIBRATION_RUNS])
    single = np.array([fit.one_step(base, [log]) for log in normal])
    x, information = fit.minimum(base, judged)
    scatter = single.var(axis=0, ddof=1)
    variance = np.maximum(np.diag(np.linalg.inv(information)), scatter / len(judged))
    sigma = np.sqrt(variance + scatter / len(single))
    return LeastSquaresAnswer(_claims(fit, x - single.mean(axis=0), sigma, len(single)))


def _claims(fit: _Fit, change: Array, sigma: Array, references: int) -> dict[str, Any]:
    """The answer from changes (P,) and sigmas (P,), in typical sizes."""
    from scipy.stats import t as student

    limit = float(student.ppf(1.0 - SIGNIFICANCE / (2.0 * len(change)), references - 1))
    z, forms = np.abs(change) / sigma, {h.effect: h.columns for h in fit.candidates.hypotheses}
    strength = {effect: float(z[list(columns)].max()) for effect, columns in forms.items()}
    ranked = sorted(strength, key=lambda e: -strength[e])
    likelihood = np.exp([0.5 * (strength[e] ** 2 - strength[ranked[0]] ** 2) for e in ranked])
    sizes = {"value": change, "sigma": sigma}
    named = [e for e in ranked if strength[e] > limit]
    causes = [
        {
            "effect": e, "class": [e], "probability": float(p), "explained_share": None,
            "parameters": {
                fit.keys[i]: {name: float(x[i] * fit.scale[i]) for name, x in sizes.items()} for i in forms[e]
            },
        }
        for e, p in zip(ranked, likelihood / likelihood.sum(), strict=True)
    ]  # fmt: skip
    verdict = "no_gap" if not named else "parameters" if named == [SOIL_STRENGTH] else "effect"
    gap = {"detected": bool(named), "statistic": strength[ranked[0]]}
    return {"gap": gap, "verdict": verdict, "causes": causes, "named": named, "shrink": None}
