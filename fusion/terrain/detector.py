"""`TerrainDetector`: windows in, class probabilities out; `SourceCredit` of what a camera says."""

import math
from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.fusion.terrain.change_alarm import ChangeAlarm
from terrafusion.fusion.terrain.classifier import UNKNOWN, LikelihoodTable, TerrainModel
from terrafusion.fusion.terrain.features import MIN_SPEED_MPS, Window
from terrafusion.fusion.terrain.sequence import PatchFilter

EXTERNAL_TRUST = 0.3
"""Exponent on the evidence of an external source: its frames repeat one another as windows do."""
EXTERNAL_ERROR = 0.1
"""Share of an external source's answers taken to be arbitrary, so that none excludes a class."""
FULL_CREDIT = 3.0
"""Log-odds at the start, and at most; then the source is believed without reserve."""
LEAST_CREDIT = -60.0
"""Log-odds at least: a source that was wrong for long is believed again after about a minute."""
MOST_LOSS = 4.0
"""Most log-odds that one window takes: a ground of a class may be another than those of its training."""
AVERAGED_CHECKS = 3
"""Checks over which claims are averaged: the window spans a change of ground for so long."""


class TerrainDetector:
    """Filters the terrain class along a run.

    Args:
        model: densities and patch length; `TerrainModel.for_vehicle` adapts it to a robot.
        classes: the classes, `unknown` among them, in the order of all probabilities given and
            returned (`Policy.names()`).

    Attributes:
        credit: of an external source.

    Raises:
        ConfigError: `classes` has no `unknown`, a name twice, or lacks a ground of the model's spectrum.
    """

    def __init__(self, model: TerrainModel, classes: tuple[str, ...]) -> None:
        if UNKNOWN not in classes or len(set(classes)) != len(classes):
            raise ConfigError(
                f"terrain classes {', '.join(classes)} must differ and hold '{UNKNOWN}'",
                remedy="mend the policy",
            )
        lacking = () if model.spectrum is None else sorted(set(model.spectrum.grounds) - set(classes))
        if lacking:
            raise ConfigError(
                f"terrain classes {', '.join(classes)} lack {', '.join(lacking)} of the terrain model",
                remedy="add the grounds of the model",
            )
        self.classes = classes
        self._table, self._spectrum = LikelihoodTable(model, classes), model.spectrum
        self._alarm = None if model.spectrum is None else ChangeAlarm(model.spectrum.alarm)
        self._temperature, self._doubt = model.temperature, model.doubt
        self._claims = LikelihoodTable(model.of_claims(), classes)
        self._filter = PatchFilter(len(classes), model.patch_length_m, model.prior(classes))
        self.credit = SourceCredit(len(classes), classes.index(UNKNOWN))

    @property
    def probabilities(self) -> Array:
        """The present class probabilities (k,), a copy."""
        found = self._filter.probabilities
        return np.asarray((1.0 - self._doubt) * found + self._doubt / len(found))

    def update(self, window: Window) -> Array:
        """Class probabilities (k,) after one more window; unchanged while the robot stands."""
        speed = window.ground_speed_mps()
        if speed > MIN_SPEED_MPS:
            self._filter.predict(speed * max(window.dt_s, 0.0))
            log_odds = None if self._spectrum is None else self._spectrum.log_odds(window)
            if self.credit.has_claims:
                self.credit.check(self._claims.of_window(window, log_odds))
            evidence = self._table.of_window(window, log_odds)
            if self._alarm is not None and log_odds is not None:
                if self._alarm.raised(log_odds):
                    self._filter.forget()
                if self._alarm.on_new_ground:
                    evidence = evidence * self._temperature
            self._filter.update(evidence)
        return self.probabilities

    def fuse(self, probabilities: ArrayLike, share: float = 1.0) -> Array:
        """Class probabilities (k,) after an external source (a camera) gave its own (k,).

        They multiply in as evidence relative to equal probabilities, tempered by `EXTERNAL_TRUST` and the
        source's `credit`, after a share `EXTERNAL_ERROR` of them is spread evenly. Frames that come faster
        than windows have a `share` (0 to 1) of the evidence of one, as they see the same ground.

        Raises:
            DataError: not k finite, non-negative numbers with a positive sum.
        """
        q = np.asarray(probabilities, dtype=float)
        k = len(self.classes)
        if q.shape != (k,) or not np.isfinite(q).all() or (q < 0.0).any() or not q.sum() > 0.0:
            raise DataError(
                f"{np.array2string(q, precision=3)} are not {k} class probabilities",
                channel="terrain",
                remedy=f"give one for each of {', '.join(self.classes)}",
            )
        self.credit.claim(q / q.sum())
        q = (1.0 - EXTERNAL_ERROR) * q / q.sum() + EXTERNAL_ERROR / k
        if share > 0.0:
            self._filter.update(EXTERNAL_TRUST * share * self.credit.value * np.log(q))
        return self.probabilities


class SourceCredit:
    """Share, 0 to 1, by which a source is believed: the probability that it tells the ground, over that at
    the start.

    The log-odds of that grow with each window by the Bayes factor of the claimed grounds against grounds
    drawn at random. A robot that the terrain model does not know checks a claim by its slip alone, while
    fixes show it.

    Args:
        k: number of grounds.
        unknown: index of ground without a class, a claim that cannot be checked.
    """

    def __init__(self, k: int, unknown: int) -> None:
        self._drawn, self._unknown = np.full(k, 1.0 / k), unknown
        self._odds = FULL_CREDIT
        self._claims: deque[Array] = deque(maxlen=20)
        self._recent: deque[Array] = deque(maxlen=AVERAGED_CHECKS)

    @property
    def value(self) -> float:
        """The share now."""
        return (1.0 + math.exp(-FULL_CREDIT)) / (1.0 + math.exp(-self._odds))

    @property
    def has_claims(self) -> bool:
        """Whether there are claims to check."""
        return bool(self._claims)

    def claim(self, probabilities: Array) -> None:
        """What the source says now: probabilities (k,) that sum to one."""
        self._claims.append(probabilities)

    def check(self, log_likelihood: Array) -> None:
        """Compare the claims since the last check with the log-likelihoods (k,) of a window."""
        if not self._claims:
            return
        self._recent.append(np.mean(self._claims, axis=0))
        self._claims.clear()
        claimed = np.mean(self._recent, axis=0)
        likelihood = np.exp(log_likelihood - log_likelihood.max())
        checked = 1.0 - float(claimed[self._unknown])
        if not checked > 0.5:
            return
        borne_out = float(claimed @ likelihood) / float(self._drawn @ likelihood)
        self._odds += max(math.log(max(borne_out, 1e-9)), -MOST_LOSS)
        self._odds = min(max(self._odds, LEAST_CREDIT), FULL_CREDIT)
