"""`terrafusion simulate`: one drive of the twin, written to a log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from terrafusion.twin.simulate import SimulatedRun


def simulate(
    scenario: Annotated[str, typer.Argument(help="Name of a built-in scenario, or a YAML file.")],
    out: Annotated[Path, typer.Option("--out", help="Log folder, or a file ending in .mcap.")],
    vehicle: Annotated[str, typer.Option(help="Name of a vehicle, or a YAML file.")] = "elevate",
    terrain: Annotated[
        str | None, typer.Option(help="One ground for the whole route, instead of the scenario's.")
    ] = None,
    slope_deg: Annotated[float | None, typer.Option(help="Slope of the ground, 0 to 25 deg.")] = None,
    payload_kg: Annotated[float, typer.Option(help="Payload at the centre of gravity, kg.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of all sensor noise.")] = 0,
    noiseless: Annotated[bool, typer.Option("--noiseless", help="Exact sensors, for checks.")] = False,
) -> None:
    """Simulate one drive with its ground truth, and write it as a log folder or an MCAP bag.

    Built-in scenarios: paper_profile, straight, circle, figure_eight, spin, staircase, chirp, waypoints,
    mixed_terrain, demo.

    Example: terrafusion simulate paper_profile --terrain loose_sand --slope-deg 5 --out sand.mcap
    """
    from terrafusion.twin.simulate import simulate_run

    run = simulate_run(
        scenario,
        vehicle=vehicle,
        terrain=terrain,
        slope_deg=slope_deg,
        payload_kg=payload_kg,
        seed=seed,
        noiseless=noiseless,
    )
    if out.suffix == ".mcap":
        from terrafusion.datasets.writers.mcap import write_mcap

        write_mcap(run.recording, out)
    else:
        from terrafusion.datasets.writers.log_folder import write_log_folder

        write_log_folder(run.recording, out)
    for line in summary_lines(run):
        print(line)
    print(f"written to {out}")


def summary_lines(run: SimulatedRun) -> list[str]:
    """The run in a few lines of text."""
    summary = run.summary
    lines = [
        run.recording.description,
        f"distance {summary.distance_m:.1f} m in {summary.duration_s:.1f} s, "
        f"mean |slip| {100 * summary.mean_abs_slip:.1f} %, energy {summary.energy_per_m_j:.0f} J/m",
    ]
    if summary.immobilised_at_s is None:
        lines.append("not immobilised")
    else:
        lines.append(f"immobilised at {summary.immobilised_at_s:.1f} s")
    return [*lines, *run.recording.notes]
