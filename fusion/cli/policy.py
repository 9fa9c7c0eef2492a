"""`terrafusion policy fit`: the weighting policy from drives of the twin."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="The weighting policy: noise of each sensor by ground.", no_args_is_help=True)


@app.callback()
def policy() -> None:
    """The weighting policy: noise of each sensor by ground."""


@app.command("fit")
def fit(
    out: Annotated[Path, typer.Option("--out", help="Policy file (YAML) to write.")],
    seeds: Annotated[
        int, typer.Option(min=1, max=1000, help="Seeds: soil, heading and noise drawn anew.")
    ] = 3,
) -> None:
    """Drive the twin over soils, slopes, payloads and speeds, and fit each sensor's noise on each ground.

    The `fixed` row is fitted to the same drives, all grounds pooled. Made again
    with the same parameter files, the policy file has the same bytes.

    Example: terrafusion policy fit --out policy.yaml
    """
    from terrafusion.fusion.cli.terrain import checked_output, progress
    from terrafusion.fusion.weights.policy_fit import default_grid, fit_policy, write_policy

    checked_output(out)
    grid = default_grid(seeds)
    with progress("drives", len(grid.conditions())) as tick:
        fitted = fit_policy(grid, tick)
    write_policy(fitted, out, made_by=f"terrafusion policy fit --seeds {seeds}")
    print(f"{'':12s} slip           a grade   time   wheel  side-slip  gyro  accel  GNSS")
    print(f"{'':12s}                             s     m/s             x      x     x")
    for name, row in {**fitted.classes, "fixed": fitted.fixed}.items():
        print(
            f"{name:12s} {row.slip_mean:.3f} ± {row.slip_sigma:.3f} {row.slip_per_grade:8.2f}"
            f"  {row.slip_time_s:5.1f}  {row.wheel_sigma_mps:.4f}     {row.side_slip_sigma:.4f}"
            f"  {row.gyro_inflation:4.1f}  {row.accel_inflation:5.1f}  {row.gnss_inflation:4.2f}"
        )
    print(f"inputs {fitted.inputs_sha256[:16]}; written to {out}")
