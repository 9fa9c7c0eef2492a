"""`TerrainDetector`: windows in, class probabilities out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from terrafusion.datasets.errors import ConfigError, DataError
from terrafusion.fusion.terrain.classifier import UNKNOWN, LikelihoodTable, TerrainModel
from terrafusion.fusion.terrain.features import MIN_SPEED_MPS, Window, extract
from terrafusion.fusion.terrain.sequence import PatchFilter

__all__ = ["TerrainDetector", "Window"]

Array = NDArray[np.float64]

ODD_WINDOWS = 20
"""Windows whose mean oddness is judged, 10 s of driving: one of unknown ground may be a known one's."""
ODD_EVIDENCE = 5.0
"""Log-likelihood by which `unknown` then fits a window better than the best of the classes, times the mean
beyond its limit (assumed)."""
EXTERNAL_TRUST = 0.3
"""Exponent on the evidence of an external source: its frames repeat one another as windows do."""
EXTERNAL_ERROR = 0.1
"""Share of an external source's answers taken to be arbitrary, so that none of them rules a class out."""


class TerrainDetector:
    """Filters the terrain class along a drive.

    Args:
        model: densities and patch length; `TerrainModel.for_vehicle` adapts it to a robot.
        classes: the classes to tell apart, `unknown` among them, in the order
            of all probabilities given and taken (`Policy.names()`).

    Raises:
        ConfigError: `classes` has no `unknown`, or a name twice.
    """

    def __init__(self, model: TerrainModel, classes: tuple[str, ...]) -> None:
        if UNKNOWN not in classes or len(set(classes)) != len(classes):
            raise ConfigError(
                f"terrain classes {', '.join(classes)} must differ and hold '{UNKNOWN}'",
                remedy="mend the policy",
            )
        self.classes = classes
        self._table = LikelihoodTable(model, classes)
        self._odd_limit = model.odd_limit
        self._odd: list[float] = []
        self._filter = PatchFilter(len(classes), model.patch_length_m, model.prior(classes))

    @property
    def probabilities(self) -> Array:
        """The present class probabilities (k,), a copy."""
        return self._filter.probabilities.copy()

    def update(self, window: Window) -> Array:
        """Class probabilities (k,) after one more window; unchanged while the robot stands."""
        speed = window.ground_speed_mps()
        if speed > MIN_SPEED_MPS:
            self._filter.predict(speed * max(window.dt_s, 0.0))
            values, variances = extract(window)
            evidence = self._table.evaluate(values, variances)
            beyond = self._beyond(self._table.oddness(values, variances))
            if beyond > 0.0:
                evidence[self.classes.index(UNKNOWN)] = evidence.max() + ODD_EVIDENCE * beyond
            self._filter.update(evidence)
        return self.probabilities

    def _beyond(self, oddness: float) -> float:
        """By how much the last windows, with one of this oddness, are odder than known ground."""
        if math.isfinite(oddness):
            self._odd = [*self._odd, oddness][-ODD_WINDOWS:]
        if len(self._odd) < ODD_WINDOWS:
            return 0.0
        return math.fsum(self._odd) / ODD_WINDOWS - self._odd_limit

    def fuse(self, probabilities: ArrayLike) -> Array:
        """Class probabilities (k,) after an external source (a camera) gave its own (k,) for now.

        They multiply in as evidence relative to equal probabilities, tempered
        by `EXTERNAL_TRUST`, after a share `EXTERNAL_ERROR` of them is spread evenly.

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
        q = (1.0 - EXTERNAL_ERROR) * q / q.sum() + EXTERNAL_ERROR / k
        self._filter.update(EXTERNAL_TRUST * np.log(q))
        return self.probabilities

    def state(self) -> dict[str, Any]:
        """What `restore` needs to go on with the same bits: plain lists and texts."""
        return {
            "classes": list(self.classes),
            "probabilities": self._filter.probabilities.tolist(),
            "odd": list(self._odd),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take up a state of a detector with the same classes.

        Raises:
            DataError: the state is of other classes.
        """
        if tuple(state["classes"]) != self.classes:
            raise DataError(
                f"the state is of the classes {', '.join(state['classes'])}",
                channel="terrain",
                remedy=f"this detector has {', '.join(self.classes)}",
            )
        self._filter.probabilities = np.array(state["probabilities"], dtype=float)
        self._odd = [float(x) for x in state["odd"]]
