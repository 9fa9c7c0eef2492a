"""Figures of the comparison. matplotlib is imported only when something is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.studies.joined_windows import DT_S
from tests.studies.twin_field.compare import SAME, Result
from tests.studies.twin_field.forks import N_PAST
from tests.studies.twin_field.models import BEST_KINEMATIC, TWIN, TWIN_NOMINAL
from tests.studies.twin_field.scores import METRICS
from tests.studies.twin_field.slip import MEASURED, SlipRow
from tests.studies.twin_field.summary import Line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {
    "plain": "#999999", "radius, track": "#e69f00", "ICR": "#d55e00", "radius, track + lag": "#e69f00",
    BEST_KINEMATIC: "#cc79a7", TWIN_NOMINAL: "#56b4e9", TWIN: "#0072b2", MEASURED: "#1a1a1a",
}  # fmt: skip
"""From Okabe and Ito (2008), as in all plots of the library."""
DRAWN = {
    "wheels": ("radius, track", "ICR", BEST_KINEMATIC, TWIN_NOMINAL, TWIN),
    "commands": ("radius, track + lag", BEST_KINEMATIC, TWIN_NOMINAL, TWIN),
}
PANELS = (("speed_rms_5s_mps", "forward speed, m/s"), ("turn_rms_5s_radps", "yaw rate, rad/s"))


def save_all(
    vehicle: str, lines: Sequence[Line], slips: Sequence[SlipRow], results: Sequence[Result], folder: Path
) -> None:
    """Write the figures of one vehicle as PNG files into an existing folder."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    kinds = list(dict.fromkeys(line.inputs for line in lines))
    drawn = {f"errors_{vehicle}": errors(lines), f"slip_{vehicle}": slip(slips)}
    drawn |= {f"forks_{vehicle}_{kind}": typical_forks(results, kind) for kind in kinds}
    for name, figure in drawn.items():
        FigureCanvasAgg(figure)
        figure.savefig(folder / f"{name}.png", dpi=110)


def errors(lines: Sequence[Line]) -> Figure:
    """RMS errors over 5 s by ground and model, with intervals; the noise of the true speed as a bar."""
    own = [line for line in lines if line.scheme == SAME]
    kinds = list(dict.fromkeys(line.inputs for line in own))
    grounds = list(dict.fromkeys(line.ground for line in own))
    figure = _figure(11.0, 3.6 * len(kinds))
    for row, kind in enumerate(kinds):
        for column, (metric, title) in enumerate(PANELS):
            ax = figure.add_subplot(len(kinds), 2, 2 * row + column + 1)
            _error_panel(ax, [line for line in own if line.inputs == kind], grounds, metric, DRAWN[kind])
            ax.set_title(f"{title}: rms over 5 s, inputs are {kind}", fontsize=9)
            if row == column == 0:
                ax.legend(fontsize=7, frameon=False)
    return figure


def _error_panel(
    ax: Axes, lines: Sequence[Line], grounds: Sequence[str], metric: str, models: Sequence[str]
) -> None:
    width = 0.8 / len(models)
    for k, name in enumerate(models):
        own = {line.ground: line for line in lines if line.model == name}
        at = [i + (k - 0.5 * (len(models) - 1)) * width for i, g in enumerate(grounds) if g in own]
        values = [own[g].errors[metric] for g in grounds if g in own]
        middle = np.array([v.median for v in values])
        spread = np.array([[v.median - v.low, v.high - v.median] for v in values]).T
        ax.errorbar(at, middle, yerr=spread, fmt="o", ms=4, lw=1.2, color=COLOURS[name], label=name)
    if metric.startswith("speed"):
        for i, ground in enumerate(grounds):
            noise = [line.noise_mps for line in lines if line.ground == ground]
            if noise and np.isfinite(noise[0]):
                label = "noise of the reference" if i == 0 else None
                ax.fill_between([i - 0.45, i + 0.45], 0.0, noise[0], color="#eeeeee", label=label)
    ax.set_xticks(range(len(grounds)), [ground or "unknown" for ground in grounds], fontsize=8)
    ax.set_ylim(bottom=0.0)
    ax.grid(axis="y", lw=0.4)


def slip(rows: Sequence[SlipRow]) -> Figure:
    """Slip over 5 s (median; bars: 10 to 90 % of the forks) and effective track (95 %), by ground."""
    own = [row for row in rows if not row.recording]
    grounds = list(dict.fromkeys(row.ground for row in own))
    models = (MEASURED, TWIN, TWIN_NOMINAL, BEST_KINEMATIC)
    figure = _figure(11.0, 3.8)
    left, right = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    for k, name in enumerate(models):
        of = {row.ground: row for row in own if row.source == name}
        at = np.array([i + (k - 1.5) * 0.17 for i, g in enumerate(grounds) if g in of])
        chosen = [of[g] for g in grounds if g in of]
        _whiskers(left, at, [(r.slip.median, r.slip_low, r.slip_high) for r in chosen], name)
        _whiskers(right, at, [(r.track_m.median, r.track_m.low, r.track_m.high) for r in chosen], name)
    for ax, title in ((left, "slip over 5 s"), (right, "effective track, m")):
        ax.set_title(title, fontsize=9)
        ax.set_xticks(range(len(grounds)), [ground or "unknown" for ground in grounds], fontsize=8)
        ax.grid(axis="y", lw=0.4)
    left.legend(fontsize=7, frameon=False, loc="best")
    return figure


def _whiskers(ax: Axes, at: Any, values: Sequence[tuple[float, float, float]], name: str) -> None:
    table = np.array(values, dtype=float).reshape(-1, 3)
    known = np.isfinite(table).all(axis=1)
    middle, low, high = table[known].T
    spread = np.maximum([middle - low, high - middle], 0.0)
    ax.errorbar(at[known], middle, yerr=spread, fmt="o", ms=4, lw=1.2, color=COLOURS[name], label=name)


def typical_forks(results: Sequence[Result], inputs: str) -> Figure:
    """Of each ground the fork on which the twin's score is the median one: truth, twin, best kinematic."""
    own = [r for r in results if r.scheme == SAME and r.inputs == inputs]
    grounds = list(dict.fromkeys(r.ground for r in own))
    figure = _figure(3.0 * len(grounds) + 1.0, 5.0)
    t = DT_S * np.arange(own[0].prediction.shape[1])
    for column, ground in enumerate(grounds):
        twin = next(r for r in own if r.ground == ground and r.name == TWIN)
        rival = next(r for r in own if r.ground == ground and r.name == BEST_KINEMATIC)
        one = _typical(twin)
        for row, (channel, unit) in enumerate(((0, "speed, m/s"), (2, "yaw rate, rad/s"))):
            ax = figure.add_subplot(2, len(grounds), row * len(grounds) + column + 1)
            ax.plot(
                t, twin.forks.motion[one, N_PAST:, channel], color=COLOURS[MEASURED], lw=1.5, label="truth"
            )
            ax.plot(t, twin.prediction[one, :, channel], color=COLOURS[TWIN], lw=1.2, label=TWIN)
            ax.plot(
                t, rival.prediction[one, :, channel], color=COLOURS[BEST_KINEMATIC], lw=1.2, label=rival.name
            )
            ax.set_title(f"{ground or 'unknown'}: {unit}", fontsize=8)
            ax.tick_params(labelsize=7)
            if row == column == 0:
                ax.legend(fontsize=7, frameon=False)
    figure.supxlabel("s from the fork", fontsize=8)
    return figure


def _typical(result: Result) -> int:
    speed = result.scores[:, METRICS.index("speed_rms_5s_mps")]
    turn = result.scores[:, METRICS.index("turn_rms_5s_radps")]
    total = np.nan_to_num(speed) + np.nan_to_num(turn)
    return int(np.argsort(total, kind="stable")[len(total) // 2])


def _figure(width: float, height: float) -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")
