"""The comparison: every model trained on some recordings, scored on others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.model.vehicle import VehicleParams
from tests.studies.twin_field.field_run import FieldRun
from tests.studies.twin_field.forks import Forks, forks_of, joined
from tests.studies.twin_field.models import Model, for_commands, for_wheels
from tests.studies.twin_field.scores import scores
from tests.studies.twin_field.splits import Fold, evenly, folds

Array = NDArray[np.float64]
Progress = Callable[[str], None]

INPUTS = ("wheels", "commands")
TRAIN, SCORED = 40, 60
"""At most so many forks are fitted on, and scored by models of another ground."""
LEAST_FORKS = 4
SAME, POOLED, OTHER = "same ground", "all grounds", "other ground"


@dataclass(frozen=True, eq=False)
class Result:
    """What one model, trained on some forks, makes of others.

    Attributes:
        inputs: "wheels" or "commands".
        scheme: trained on the `SAME` ground, on all grounds (`POOLED`), or on an `OTHER` one.
        ground: of the scored forks; `trained_on` of the training forks.
        rule: how training and scored forks were parted.
        model: name and the fitted model itself.
        forks: scored.
        prediction: (F, N_FUTURE + 1, 3).
        scores: (F, len(METRICS)).
    """

    inputs: str
    scheme: str
    ground: str
    trained_on: str
    rule: str
    name: str
    model: Model
    forks: Forks
    prediction: Array
    scores: Array


def compare(runs: Sequence[FieldRun], progress: Progress = lambda _: None) -> list[Result]:
    """All results on the runs of one vehicle.

    Raises:
        TerrafusionError: a run of the twin diverged.
    """
    studies = [s for ground in sorted({r.ground for r in runs}) if (s := _study(runs, ground)) is not None]
    results: list[Result] = []
    for study in studies:
        for k in range(len(study.cuts)):
            progress(f"{study.ground or 'unknown ground'}, fold {k + 1} of {len(study.cuts)}")
            trained = _trained(study, k)
            for inputs, models in trained.items():
                results += _results(inputs, SAME, study, k, study.ground, models)
            if k == 0 and len(studies) > 1:
                progress(f"trained on {study.ground}: other grounds")
                for other in studies:
                    if other is not study:
                        for inputs, models in trained.items():
                            results += _results(inputs, OTHER, other, k, study.ground, models)
    if len(studies) > 1:
        for k in range(min(len(study.cuts) for study in studies)):
            progress(f"all grounds, fold {k + 1}")
            for inputs, models in _pooled(studies, k).items():
                for study in studies:
                    results += _results(inputs, POOLED, study, k, "all", models)
    return results


@dataclass(frozen=True, eq=False)
class _Study:
    """Forks of one ground and how they are parted."""

    ground: str
    vehicle: VehicleParams
    forks: dict[str, Forks]
    cuts: list[Fold]
    rule: str

    def train(self, inputs: str, k: int, most: int) -> Forks | None:
        """Training forks of a fold, at most so many; None where there are too few."""
        return self._part(inputs, self.cuts[k].train, most)

    def scored(self, inputs: str, k: int, most: int) -> Forks | None:
        """Scored forks of a fold."""
        return self._part(inputs, self.cuts[k].test, most)

    def _part(self, inputs: str, mask: NDArray[np.bool_], most: int) -> Forks | None:
        forks = self.forks.get(inputs)
        if forks is None:
            return None
        own = np.isin(forks.group, np.unique(self.forks["wheels"].group[mask]))
        return forks.select(evenly(own, most)) if own.sum() >= LEAST_FORKS else None


def _study(runs: Sequence[FieldRun], ground: str) -> _Study | None:
    own = [run for run in runs if run.ground == ground]
    forks = {inputs: found for inputs in INPUTS if (found := forks_of(own, inputs)) is not None}
    if "wheels" not in forks or len(forks["wheels"]) < 2 * LEAST_FORKS:
        return None
    cuts, rule = folds(forks["wheels"])
    cuts = [cut for cut in cuts if min(cut.train.sum(), cut.test.sum()) >= LEAST_FORKS]
    return _Study(ground, own[0].vehicle, forks, cuts, rule) if cuts else None


def _trained(study: _Study, k: int) -> dict[str, dict[str, Model]]:
    wheels, commands = study.train("wheels", k, TRAIN), study.train("commands", k, TRAIN)
    assert wheels is not None
    return _models(study.vehicle, study.ground, wheels, commands)


def _pooled(studies: Sequence[_Study], k: int) -> dict[str, dict[str, Model]]:
    """One set of numbers for all grounds, from the same number of forks of each."""
    share = max(LEAST_FORKS, TRAIN // len(studies))
    parts = {inputs: [study.train(inputs, k, share) for study in studies] for inputs in INPUTS}
    wheels, commands = ([part for part in parts[inputs] if part is not None] for inputs in INPUTS)
    return _models(studies[0].vehicle, "", joined(wheels), joined(commands) if commands else None)


def _models(
    vehicle: VehicleParams, ground: str, wheels: Forks, commands: Forks | None
) -> dict[str, dict[str, Model]]:
    """Fitted models by kind of input and name."""
    driven = for_wheels(vehicle, ground, wheels)
    if commands is None:
        return {"wheels": driven}
    return {"wheels": driven, "commands": for_commands(vehicle, commands, driven)}


def _results(
    inputs: str, scheme: str, study: _Study, k: int, source: str, models: dict[str, Model]
) -> list[Result]:
    forks = study.scored(inputs, k, SCORED if scheme == OTHER else len(study.forks["wheels"]))
    if forks is None:
        return []
    rule = study.rule if scheme != OTHER else "another ground"
    told = {name: model.predict(forks) for name, model in models.items()}
    return [
        Result(
            inputs,
            scheme,
            study.ground,
            source,
            rule,
            name,
            model,
            forks,
            told[name],
            scores(told[name], forks),
        )
        for name, model in models.items()
    ]
