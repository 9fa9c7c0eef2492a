"""Mode "robust": the fixed noise under a robust loss.

Cauchy: rho(r) = c^2/2 log(1 + r^2/c^2) by iteratively reweighted least squares, weight 1 / (1 + r^2/c^2)
of the whitened residual r (Holland and Welsch 1977, Comm. Stat. A 6(9)). A measurement is weighted when it
comes, against the prediction: with prediction variance P and noise R, the residual left by the update that
the weight w allows is nu (R/w) / (P + R/w), so an innovation within the prediction's own uncertainty costs
no weight.

GNC: truncated least squares, rho(r) = min(r^2, c^2), by graduated non-convexity over all fixes of the
window (Yang, Antonante, Tzoumas, Carlone 2020, IEEE RA-L 5(2), eq. 13-14), each time a fix leaves the
weights of the window unsettled. It starts from the present estimate, and its control parameter mu grows
fourfold a step, not by the paper's 1.4, to keep up with the run. Fixes that leave the window keep their
last weight. Wheels have the Cauchy loss here too: a single increment can only be compared with the
prediction.

No loss helps an estimate that went astray, so the gate's re-acquisition stays in force: consecutive fixes
that contradict the estimate and agree with each other are believed.
"""

import dataclasses

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimate.estimate import WeightChange
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.gnss_factor import GnssPosition, linearised
from terrafusion.fusion.graph.wheel_factor import WheelIncrement
from terrafusion.fusion.noise.modes import RobustTuning
from terrafusion.fusion.weighting.weighting import InnovationTest, NoiseInForce, Weighting, inflated

IRLS_STEPS = 10
LEAST_WEIGHT = 1e-6
"""In place of zero: the factor stays, a thousand sigmas wide."""
DOUBTED = 0.5
"""A weight that crosses this is recorded."""
MU_GROWTH = 4.0
GNC_STEPS = 20


class RobustWeighting(Weighting):
    """Weights of single measurements under the configured robust loss."""

    def __init__(self, config: EstimatorConfig, noise: NoiseInForce) -> None:
        self.loss = config.robust_loss
        self.tuning: RobustTuning = getattr(config.tuning, config.robust_loss)
        self.passed_nis = self.tuning.gate_sigma**2
        self._noise = noise
        self._wheels_doubted = False

    def wheels(self, wheels: WheelIncrement, test: InnovationTest) -> WheelIncrement:
        """By the Cauchy loss."""
        w = cauchy_weight(test, self.tuning.wheel_c)
        if (w < DOUBTED) != self._wheels_doubted:
            self._wheels_doubted = not self._wheels_doubted
            before, after = (1.0, w) if self._wheels_doubted else (DOUBTED, w)
            what = "doubted" if self._wheels_doubted else "believed again"
            why = f"cauchy loss: increments {what}, innovation {test.innovation_m[0]:.3f} m"
            self._noise.record(WeightChange(test.t_ns, "wheels", before, after, "", why))
        return inflated(wheels, float(w**-0.5))

    def gnss(self, test: InnovationTest) -> tuple[float, float]:
        """By the Cauchy loss, or by the first step of GNC: all or nothing, against the prediction."""
        if self.loss == "cauchy":
            w = cauchy_weight(test, self.tuning.gnss_c)
        else:
            nis = float(np.sum(test.innovation_m**2 / (test.predicted_m2 + test.noise_m2)))
            w = 1.0 if nis <= self.tuning.gnss_c**2 else LEAST_WEIGHT
        if w < DOUBTED:
            self._record(test.t_ns, 1.0, w, float(np.hypot(*test.innovation_m)))
        return float(w**-0.5), w

    def revisit(self, chain: Chain) -> None:
        """GNC over the fixes of the window, unless their weights are settled."""
        if self.loss != "gnc":
            return
        chain.smooth(len(chain.nodes), iterations=1)
        held = [(k, fix) for k, node in enumerate(chain.nodes, chain.first) for fix in node.fixes]
        c2 = self.tuning.gnss_c**2
        squares = self._squares(chain, held)
        before = np.array([fix.weight for _, fix in held])
        if settled(squares, before, c2):
            return
        mu = c2 / max(2.0 * float(squares.max()) - c2, c2)
        for _ in range(GNC_STEPS):
            wanted = truncated_weights(squares, c2, mu)
            for i, (k, fix) in enumerate(held):
                if wanted[i] != fix.weight:
                    held[i] = (k, reweighted(fix, float(wanted[i])))
                    chain.replace_fix(k, fix, held[i][1])
            chain.smooth(len(chain.nodes), iterations=1)
            squares = self._squares(chain, held)
            if np.all((wanted == 1.0) | (wanted == LEAST_WEIGHT)):
                break
            mu *= MU_GROWTH
        for old, square, (k, fix) in zip(before.tolist(), squares.tolist(), held, strict=True):
            if (old < DOUBTED) != (fix.weight < DOUBTED):
                t_ns = chain.node(k).t_ns
                self._record(t_ns, old, fix.weight, square**0.5, "sigma over the window")

    def _squares(self, chain: Chain, held: list[tuple[int, GnssPosition]]) -> Array:
        """Squared horizontal residuals (n,), whitened by the fixes' own full-weight sigmas."""
        out = np.zeros(len(held))
        for i, (k, fix) in enumerate(held):
            r = linearised(fix, chain.state(k))[0][:2] / fix.sigma_m[:2]
            out[i] = float(r @ r) / fix.weight
        return out

    def _record(self, t_ns: int, before: float, after: float, off: float, unit: str = "m") -> None:
        what = "doubted" if after < DOUBTED else "believed again"
        why = f"{self.loss} loss: fix {what}, {off:.1f} {unit} off"
        self._noise.record(WeightChange(t_ns, "gnss", before, after, "", why))


def cauchy_weight(test: InnovationTest, c: float) -> float:
    """Weight of one measurement whose update settles at the Cauchy loss's minimum, by reweighting."""
    w = 1.0
    for _ in range(IRLS_STEPS):
        noise = test.noise_m2 / w
        left = test.innovation_m * noise / (test.predicted_m2 + noise)
        w = max(1.0 / (1.0 + float(np.sum(left**2 / test.noise_m2)) / c**2), LEAST_WEIGHT)
    return w


def settled(squares: Array, weights: Array, c2: float) -> bool:
    """Whether all-or-nothing weights (n,) are what the residuals ask for, with most fixes believed."""
    believed = weights == 1.0
    consistent = bool(np.all(believed == (squares <= c2)))
    return consistent and 2 * int(believed.sum()) >= len(weights)


def truncated_weights(squares: Array, c2: float, mu: float) -> Array:
    """Weights (n,) of truncated least squares at `mu` (Yang et al. 2020, eq. 14), zero as `LEAST_WEIGHT`."""
    root = np.sqrt(c2 * mu * (mu + 1.0) / np.maximum(squares, 1e-12)) - mu
    inside, outside = squares <= mu / (mu + 1.0) * c2, squares >= (mu + 1.0) / mu * c2
    return np.clip(np.where(inside, 1.0, np.where(outside, 0.0, root)), LEAST_WEIGHT, 1.0)


def reweighted(fix: GnssPosition, weight: float) -> GnssPosition:
    """The fix with another weight on its horizontal part."""
    sigma = fix.sigma_m.copy()
    sigma[:2] *= np.sqrt(fix.weight / weight)
    return dataclasses.replace(fix, sigma_m=sigma, weight=weight)
