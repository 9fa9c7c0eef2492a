"""The model a calibration starts from: vehicle, soils and parameters of all logs."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from terrafusion.datasets.core.arguments import checked_names
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.quantity import Quantity
from terrafusion.datasets.core.recording import Recording
from terrafusion.twin.calibrate.coordinates import Coordinate, Prior
from terrafusion.twin.calibrate.log import PreparedLog, grounds
from terrafusion.twin.calibrate.model import Model, resolve
from terrafusion.twin.calibrate.predict import FOLLOWING
from terrafusion.twin.effects.catalogue import by_key
from terrafusion.twin.model.soil import SoilParams, load_soil
from terrafusion.twin.model.vehicle import VehicleParams, geometry_notes, reported_geometry, with_overrides

Soils = str | Path | SoilParams | Mapping[str, str | Path | SoilParams] | None


def uniquely_named(recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """The logs, those of one name numbered: results go by name."""
    out: list[Recording] = []
    for recording in recordings:
        count = sum(r.name == recording.name for r in recordings[: len(out)])
        name = f"{recording.name} ({count + 1})" if count else recording.name
        out.append(dataclasses.replace(recording, name=name))
    return tuple(out)


def start_model(
    recordings: Sequence[Recording],
    vehicle: VehicleParams,
    soils: Soils,
    effects: Mapping[str, float] | None = None,
    stand_in: str | None = None,
) -> tuple[Model, str | None, list[str]]:
    """The model to start from, the name of the one ground where there is one for all logs, and notes.

    Args:
        effects: of the twin, besides those of the vehicle.
        stand_in: soil of a ground that is none of the library; None: it is refused.

    Raises:
        ConfigError: an unknown soil, or one for a ground that no log has.
        DataError: a ground that is no soil of the library; logs of different geometries.
    """
    geometry = reported_geometry(recordings)
    robot, notes = with_overrides(vehicle, geometry), list(geometry_notes(vehicle, geometry))
    present = {**by_key(vehicle.effects), **by_key(effects or {})}
    if soils is not None and not isinstance(soils, Mapping):
        soil = soils if isinstance(soils, SoilParams) else load_soil(soils)
        return Model(robot, {soil.name: soil}, present), soil.name, notes
    given, found = dict(soils or {}), dict[str, SoilParams]()
    for recording in recordings:
        for label in (x for x in grounds(recording, recording.start_ns)[0] if x not in found):
            named = given.get(label, label)
            try:
                found[label] = named if isinstance(named, SoilParams) else load_soil(named)
            except ConfigError:
                if label in given:
                    raise
                if stand_in is None:
                    raise _no_soil(label, recording) from None
                found[label] = load_soil(stand_in)
                notes.append(f"the ground '{label}' is not in the library: {stand_in} stands in")
    if unmet := sorted(set(given) - set(found)):
        theirs = ", ".join(filter(None, found)) or "they name none, so give one soil for all logs"
        raise ConfigError(
            f"no log drives on '{unmet[0]}'", channel="terrain", remedy=f"their grounds: {theirs}"
        )
    return Model(robot, found, present), None, notes


def _no_soil(label: str, recording: Recording) -> DataError:
    what = f"its ground '{label}' is no soil of the library" if label else "it does not say its ground"
    return DataError(what, file=recording.name, channel="terrain", remedy="name the soil with --terrain")


def coordinates_of(names: str | Sequence[str], model: Model, priors: Mapping[str, Prior]) -> list[Coordinate]:
    """The named parameters as the solver sees them, `soil.` standing for every ground.

    Raises:
        ConfigError: an unknown name, or a prior of a parameter that is not calibrated.
    """
    if not isinstance(priors, Mapping):
        raise ConfigError(f"priors are {priors!r}", remedy="give {name: Prior(value, sigma)}")
    numbers: dict[str, Quantity] = resolve(checked_names(names, "parameters"), model)
    for name, prior in priors.items():
        if not isinstance(prior, Prior):
            remedy = "give a Prior(value, sigma) of terrafusion.twin.calibrate.coordinates"
            raise ConfigError(f"the prior of '{name}' is {prior!r}", remedy=remedy)
    full = {k: v for name, v in priors.items() for k in model.full_names(name)}
    if unknown := set(full) - set(numbers):
        raise ConfigError(
            f"a prior is given for '{min(unknown)}', which is not calibrated", remedy="name it, too"
        )
    typical = {n: model.parameter(key).scale for n in numbers if (key := n.removeprefix("effects.")) != n}
    return [Coordinate.of(n, q, model.value(n), full.get(n), typical.get(n)) for n, q in numbers.items()]


def refuse_bypassed(coordinates: Sequence[Coordinate], logs: Sequence[PreparedLog]) -> None:
    """Refuse parameters of motors and speed loop where the twin's wheels follow measured ones in all logs.

    Raises:
        DataError: naming the first of them.
    """
    if not all(log.follows for log in logs):
        return
    bypassed = ("speed_loop_p_nms", "speed_loop_i_nm", *FOLLOWING)
    for name in (c.name for c in coordinates):
        if name.startswith("vehicle.drive.") and name.rpartition(".")[2] in bypassed:
            raise DataError(
                f"'{name}' cannot be identified where the twin follows the measured wheels",
                file=logs[0].name, remedy="give a log with commands, or leave the parameter out",
            )  # fmt: skip
