"""Results as rows of plain numbers, and as tables for people."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.physics.layout import SOIL_PARAMETERS, VEHICLE_PARAMETERS
from tests.studies.twin_field.compare import OTHER, Result
from tests.studies.twin_field.models import BEST_KINEMATIC, TWIN, TWIN_NOMINAL
from tests.studies.twin_field.scores import METRICS, Interval, interval, medians
from tests.studies.twin_field.slip import SlipRow
from tests.studies.twin_field.twin_model import TwinModel

Array = NDArray[np.float64]

SHOWN = ("speed_rms_5s_mps", "turn_rms_5s_radps", "position_m")
COLUMNS = ("hold", "plain", "radius, track", "ICR", BEST_KINEMATIC, TWIN_NOMINAL, TWIN)
"""What the printed tables show of metrics and models; the files hold all."""


@dataclass(frozen=True)
class Line:
    """One model on one ground.

    Attributes:
        vehicle, inputs, scheme, ground, trained_on, rule, model: see `compare.Result`.
        forks, groups: how many forks, and independent stretches they lie in.
        noise_mps: median noise of the true forward speed, NaN without.
        errors: by metric, median over forks with a 95 % interval.
        ratios: by metric, median over that of the best kinematic model on the same forks.
    """

    vehicle: str
    inputs: str
    scheme: str
    ground: str
    trained_on: str
    rule: str
    model: str
    forks: int
    groups: int
    noise_mps: float
    errors: dict[str, Interval]
    ratios: dict[str, Interval]


def lines(vehicle: str, results: Sequence[Result]) -> list[Line]:
    """Folds put together: every fork counts once in each line; forks of several grounds are not mixed."""
    wheres: dict[Where, dict[str, list[Result]]] = {}
    for r in results:
        source = r.trained_on if r.scheme == OTHER else ""
        models = wheres.setdefault((r.inputs, r.scheme, r.ground, source), {})
        models.setdefault(r.name, []).append(r)
    return [line for name in wheres for line in _lines_of(vehicle, name, wheres[name])]


Where = tuple[str, str, str, str]


def _lines_of(vehicle: str, where: Where, models: dict[str, list[Result]]) -> list[Line]:
    """The lines of all models in one place: they are scored on the same forks."""
    inputs, scheme, ground, source = where
    first = next(iter(models.values()))
    group = np.concatenate([r.forks.group for r in first])
    noise = np.concatenate([r.forks.noise_mps for r in first])
    middle, draws = medians(
        np.hstack([np.concatenate([r.scores for r in parts]) for parts in models.values()]), group
    )
    width = len(METRICS)
    best = width * list(models).index(BEST_KINEMATIC)
    out = []
    for k, (name, parts) in enumerate(models.items()):
        own = {m: k * width + i for i, m in enumerate(METRICS)}
        rival = {m: best + i for i, m in enumerate(METRICS)}
        out.append(
            Line(
                vehicle, inputs, scheme, ground, source or parts[0].trained_on, parts[0].rule, name,
                len(group), len(np.unique(group)),
                float(np.nanmedian(noise)) if np.isfinite(noise).any() else float("nan"),
                {m: interval(middle[i], draws[:, i]) for m, i in own.items()},
                {m: _ratio(middle, draws, own[m], rival[m]) for m in METRICS},
            )
        )  # fmt: skip
    return out


def _ratio(middle: Array, draws: Array, one: int, other: int) -> Interval:
    with np.errstate(divide="ignore", invalid="ignore"):
        return interval(middle[one] / middle[other], draws[:, one] / draws[:, other])


def line_rows(all_lines: Sequence[Line]) -> Iterator[dict[str, Any]]:
    """One flat row a line, for CSV and JSON; unknown numbers are None."""
    for line in all_lines:
        row = {f.name: getattr(line, f.name) for f in dataclasses.fields(line)}
        for kind, name in (("errors", ""), ("ratios", "_over_best_kinematic")):
            for metric, found in row.pop(kind).items():
                row |= {
                    f"{metric}{name}": _known(found.median),
                    f"{metric}{name}_low": _known(found.low),
                    f"{metric}{name}_high": _known(found.high),
                }
        yield row | {"noise_mps": _known(line.noise_mps)}


def fork_rows(vehicle: str, results: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """One row a fork and model, with all errors."""
    for r in results:
        for k in range(len(r.forks)):
            yield {
                "vehicle": vehicle, "inputs": r.inputs, "scheme": r.scheme, "trained_on": r.trained_on,
                "ground": r.ground, "recording": str(r.forks.recording[k]), "group": str(r.forks.group[k]),
                "time_s": float(r.forks.time_s[k]), "model": r.name,
                **{m: _known(float(v)) for m, v in zip(METRICS, r.scores[k], strict=True)},
            }  # fmt: skip


def slip_table_rows(vehicle: str, rows: Sequence[SlipRow]) -> Iterator[dict[str, Any]]:
    """One flat row a ground, recording and source."""
    for row in rows:
        flat = {f.name: getattr(row, f.name) for f in dataclasses.fields(row)}
        for name in ("slip", "track_m"):
            found = flat.pop(name)
            flat |= {
                name: _known(found.median),
                f"{name}_lowest": _known(found.low),
                f"{name}_highest": _known(found.high),
            }
        yield {"vehicle": vehicle, **{k: _known(v) if isinstance(v, float) else v for k, v in flat.items()}}


def parameters(vehicle: str, results: Sequence[Result]) -> Iterator[dict[str, Any]]:
    """The numbers of every fitted model, each once."""
    seen: set[int] = set()
    for r in results:
        if id(r.model) in seen:
            continue
        seen.add(id(r.model))
        if isinstance(r.model, TwinModel):
            numbers = dict(zip(VEHICLE_PARAMETERS, r.model.vehicle.tolist(), strict=True))
            numbers |= dict(zip(SOIL_PARAMETERS, r.model.soil.tolist(), strict=True)) | dict(r.model.effects)
        elif dataclasses.is_dataclass(r.model) and dataclasses.fields(r.model):
            numbers = dataclasses.asdict(r.model)
        else:
            continue
        yield {
            "vehicle": vehicle, "inputs": r.inputs, "scheme": r.scheme, "trained_on": r.trained_on,
            "model": r.name, "numbers": numbers,
        }  # fmt: skip


def markdown(all_lines: Sequence[Line], scheme: str) -> str:
    """Tables of one scheme, one a metric: medians by model, and the twin's over the best kinematic's.

    With commands as inputs, the plain and the fitted differential drive stand behind their fitted lags.
    """
    chosen = [line for line in all_lines if line.scheme == scheme]
    rows: dict[tuple[str, str, str, str], dict[str, Line]] = {}
    for line in chosen:
        rows.setdefault((line.vehicle, line.inputs, line.ground, line.trained_on), {})[line.model] = line
    tables = (_table(rows, metric, scheme) for metric in SHOWN)
    return "\n".join(table for table in tables if table)


def _table(rows: dict[tuple[str, str, str, str], dict[str, Line]], metric: str, scheme: str) -> str:
    ratio = f"{TWIN} / {BEST_KINEMATIC}"
    head = [_title(metric), "forks (stretches)", "noise of truth", *COLUMNS, ratio]
    out = [head, ["---"] * len(head)]
    for (vehicle, inputs, ground, source), models in rows.items():
        own = models[TWIN]
        if not np.isfinite(own.errors[metric].median):
            continue
        where = f"{vehicle}, {inputs}, {ground or 'unknown'}"
        noise = f"{own.noise_mps:.3f}" if metric.startswith("speed") else ""
        shown = [models[m] if m == "ICR" else models.get(f"{m} + lag", models[m]) for m in COLUMNS]
        cells = [f"{line.errors[metric].median:.3f}" for line in shown]
        out.append(
            [
                f"{where}, trained on {source}" if scheme == OTHER else where,
                f"{own.forks} ({own.groups})", noise, *cells, _interval(own.ratios[metric], ".2f"),
            ]
        )  # fmt: skip
    return "".join(f"| {' | '.join(row)} |\n" for row in out) if len(out) > 2 else ""


def slip_markdown(rows: Sequence[tuple[str, SlipRow]]) -> str:
    """Table of slip and effective track by ground, with vehicles' names."""
    head = [
        "vehicle, ground",
        "source",
        "forks",
        "slip over 5 s",
        "10 to 90 % of forks",
        "effective track, m",
    ]
    out = [head, ["---"] * len(head)]
    for vehicle, row in rows:
        if row.recording:
            continue
        spread = f"{row.slip_low:+.3f} to {row.slip_high:+.3f}" if row.count else "-"
        cells = [_interval(row.slip, "+.3f"), spread, _interval(row.track_m, ".2f")]
        out.append([f"{vehicle}, {row.ground or 'unknown'}", row.source, str(row.count), *cells])
    return "".join(f"| {' | '.join(row)} |\n" for row in out)


def _title(metric: str) -> str:
    name, unit = metric.rsplit("_", 1)
    unit = {"mps": "m/s", "radps": "rad/s"}.get(unit, unit)
    return f"{name.replace('_rms', '').replace('_', ' ')}, {unit}"


def _interval(value: Interval, form: str) -> str:
    if not np.isfinite(value.median):
        return "-"
    return f"{value.median:{form}} ({value.low:{form}} to {value.high:{form}})"


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
