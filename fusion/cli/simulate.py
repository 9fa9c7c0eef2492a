"""`terrafusion simulate`: one drive of the twin, with optional effects, written to a log."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafusion.datasets.core.tables import text_table
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.common import parse_pairs, parse_point, write_log
from terrafusion.fusion.cli.outputs import LOG_FILES, Output

if TYPE_CHECKING:
    from terrafusion.twin.analysis.summary import RunSummary
    from terrafusion.twin.simulate import SimulatedRun


OUTPUT = Output(
    "Log folder, or a file ending in .mcap.", LOG_FILES, ("meta.yaml",), mark='source: "terrafusion twin"'
)


def simulate(
    scenario: Annotated[str, typer.Argument(help="Name of a built-in scenario, or a YAML file.")],
    out: Path,
    vehicle: str = "elevate",
    terrain: str | None = None,
    slope_deg: float | None = None,
    cross_slope_deg: float | None = None,
    payload_kg: float | None = None,
    payload_at: str | None = None,
    seed: int = 0,
    noiseless: bool = False,
    effect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="An optional effect, e.g. wheel_radius/scale=0.03; may be repeated. 'help' lists all.",
            callback=listed,
            is_eager=True,
        ),
    ] = None,
) -> Result:
    """Simulate one drive with its ground truth, and write it as a log folder or an MCAP bag.

    Built-in scenarios: paper_profile, straight, circle, figure_eight, spin, staircase, chirp, waypoints,
    mixed_terrain, field_sand, demo. A YAML file may also set zones of GNSS outage and of trees; see
    docs/reference/sensors.md.

    Examples:

    terrafusion simulate paper_profile --terrain loose_sand --slope-deg 5 --out sand.mcap

    terrafusion simulate straight --cross-slope-deg 10 --payload-kg 30 --payload-at 0,0.1,0.4 --out tilted

    terrafusion simulate spin --effect wheel_radius/scale=0.03 --effect gyro_bias/constant=0.01 --out worn

    Args:
        vehicle: Name of a vehicle, or a YAML file.
        terrain: One ground for the whole route, instead of the scenario's.
        slope_deg: Slope of the ground, 0 to 25 deg, instead of the scenario's.
        cross_slope_deg: Its slope across the start heading, -25 to 25 deg, rising to the left.
        payload_kg: Payload, kg, instead of the scenario's.
        payload_at (X,Y,Z): Its centre of gravity, m forward, left and up of the body origin, which lies on
            the ground midway between the wheels; by default the robot's own centre of gravity.
        seed: Seed of all sensor noise and of ground that varies.
        noiseless: Exact sensors, for checks.
    """
    from terrafusion.twin.simulate import simulate_run

    run = simulate_run(
        scenario,
        vehicle=vehicle,
        terrain=terrain,
        slope_deg=slope_deg,
        cross_slope_deg=cross_slope_deg,
        payload_kg=payload_kg,
        payload_at_m=parse_point(payload_at, "X,Y,Z in metres", "--payload-at"),
        seed=seed,
        noiseless=noiseless,
        effects=effect_values(effect or []),
    )
    write_log(run.recording, out)
    return Result(summary_lines(run), f"written to {out}", document(run, out))


def document(run: SimulatedRun, out: Path) -> dict[str, Any]:
    """The run as `--json` prints it; unknown numbers are null."""

    from terrafusion.datasets.core.json_text import finite

    recording = run.recording
    rows = {name: len(channel) for name, channel in recording.channels().items()}
    made: dict[str, Any] = finite(dataclasses.asdict(run.summary))
    return {
        "out": str(out), "description": recording.description, "samples": rows,
        "notes": list(recording.notes), "summary": made,
    }  # fmt: skip


def summary_lines(run: SimulatedRun) -> list[str]:
    """The run in a few lines of text."""
    summary = run.summary
    slip = _where_defined(100 * summary.mean_abs_slip, ".1f", " %", "undefined (it hardly moved)")
    energy = _where_defined(summary.energy_per_m_j, ".0f", " J/m", "a metre undefined (less than 0.1 m)")
    return [
        run.recording.description,
        f"distance {summary.distance_m:.1f} m in {summary.duration_s:.1f} s, "
        f"mean |slip| {slip}, energy {energy}",
        _energy_line(summary),
        _immobilised_line(summary),
        *run.recording.notes,
    ]


def _where_defined(value: float, form: str, unit: str, otherwise: str) -> str:
    return otherwise if math.isnan(value) else f"{value:{form}}{unit}"


def _energy_line(summary: RunSummary) -> str:
    parts = {
        "heat of battery, motors and gears": summary.heat_j,
        "resistance": summary.resistance_work_j,
        "slip": summary.slip_work_j,
        "height and speed": summary.motor_work_j - summary.resistance_work_j - summary.slip_work_j,
    }
    whole = max(summary.energy_j, 1e-9)
    shares = ", ".join(f"{100 * part / whole:z.0f} % {name}" for name, part in parts.items())
    return (
        f"battery {summary.energy_j / 1000:.1f} kJ, power {summary.mean_power_w:.0f} W mean, "
        f"{summary.peak_power_w:.0f} W peak: {shares}"
    )


def _immobilised_line(summary: RunSummary) -> str:
    if summary.immobilised_at_s is None:
        return "not immobilised"
    return (
        f"immobilised at {summary.immobilised_at_s:.1f} s, "
        f"({summary.immobilised_x_m:.1f}, {summary.immobilised_y_m:.1f}) m: {summary.immobilised_cause}"
    )


def effect_values(words: list[str]) -> dict[str, float]:
    """Values by name of `NAME=VALUE` words; names and ranges are checked by the twin."""
    values: dict[str, float] = {}
    for name, number in parse_pairs(words, "NAME=VALUE", "--effect").items():
        try:
            values[name] = float(number)
        except ValueError:
            raise typer.BadParameter(f"'{name}={number}' is not NAME=VALUE", param_hint="--effect") from None
    return values


def listed(words: list[str] | None) -> list[str] | None:
    """Prints all effects and leaves where 'help' is among the words."""
    if words and "help" in words:
        for line in effect_lines():
            print(line)
        raise typer.Exit
    return words


def effect_lines() -> list[str]:
    """A line a parameter: name, typical size, range, unit, equation."""
    from terrafusion.twin.effects.catalogue import parameters

    rows = [
        (key, f"{p.scale:g}", f"{p.low:g} to {p.high:g} {p.unit}".rstrip(), form.equation)
        for key, (form, p) in parameters().items()
    ]
    return text_table(("effect", "typical", "range", "equation (e is the value)"), rows)
