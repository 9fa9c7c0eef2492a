"""`terrafusion policy fit`: the weighting policy from simulated runs and labelled logs."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.tables import text_table
from terrafusion.fusion.cli.command import Result, add_command
from terrafusion.fusion.cli.outputs import Output
from terrafusion.fusion.cli.terrain import progress
from terrafusion.fusion.cli.usage import CommandGroup

HEADS = (
    "ground", "slip", "a grade", "time, s", "wheel, m/s", "side-slip", "gyro x", "yaw x", "accel x", "GNSS x",
)  # fmt: skip
app = typer.Typer(help="The weighting policy: noise of each sensor by ground.", cls=CommandGroup)


@app.callback()
def policy() -> None:
    """The weighting policy: noise of each sensor by ground."""


def fit(
    out: Path,
    logs: Annotated[
        list[str] | None,
        typer.Argument(help="Labelled logs with a truth; they update the noise fitted to simulated runs."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Seeds of soil, heading and sensor noise.")] = 3,
    ground: list[str] | None = None,
    vehicle: str | None = None,
) -> Result:
    """Drive the twin over soils, slopes, payloads and speeds, and fit each sensor's noise on each ground.

    The noise `fixed` is fitted to the same runs, all grounds pooled. The same
    parameter files and logs give the same policy file, byte for byte.

    Example: terrafusion policy fit --out policy.yaml

    Example: terrafusion policy fit --out mine.yaml drive1.bag drive2.bag

    Args:
        ground (SOIL): Soil to drive on; repeat for more. By default the four of the detector.
        vehicle: Simulated vehicle of the library (elevate), and the vehicle of the logs, instead of theirs.
    """

    from terrafusion.fusion.training.policy_fit import LoggedSamples, default_grid, fit_policy, write_policy
    from terrafusion.fusion.training.policy_logs import read_logs
    from terrafusion.fusion.training.simulated_runs import GROUNDS

    grounds = chosen("soils", "soil", tuple(dict.fromkeys(ground or GROUNDS)))
    grid = default_grid(seeds, grounds, *chosen("vehicles", "vehicle", (vehicle or "elevate",)))
    logged = read_logs(logs, vehicle) if logs else LoggedSamples()
    with progress("runs", len(grid.conditions())) as tick:
        fitted = fit_policy(grid, tick, logged)
    write_policy(fitted, out, made_by=made_by(seeds, ground, vehicle, logs))
    rows = {**fitted.classes, "fixed": fitted.fixed}
    cells = [
        [
            name, f"{row.slip_mean:.3f} ± {row.slip_sigma:.3f}", f"{row.slip_per_grade:.2f}",
            f"{row.slip_time_s:.1f}", f"{row.wheel_sigma_mps:.4f}", f"{row.side_slip_sigma:.4f}",
            f"{row.gyro_inflation:.1f}", f"{row.gyro_yaw_inflation:.1f}", f"{row.accel_inflation:.1f}",
            f"{row.gnss_inflation:.2f}",
        ]
        for name, row in rows.items()
    ]  # fmt: skip
    lines = text_table(HEADS, cells, right=range(2, len(HEADS)))
    document = {name: dataclasses.asdict(row) for name, row in rows.items()}
    done = f"inputs {fitted.inputs_sha256[:16]}; written to {out}"
    return Result(lines, done, {"out": str(out), "inputs_sha256": fitted.inputs_sha256, "rows": document})


add_command(
    app, "fit", fit, output=Output("Policy file (YAML) to write.", suffix=".yaml", mark="terrafusion.policy/")
)


def chosen(folder: str, kind: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Check that all names are of the library, whose files the hash of the policy covers."""
    from terrafusion.twin.model.library import known_names

    known = known_names(folder)
    for name in names:
        if name not in known:
            raise ConfigError(f"unknown {kind} '{name}'", remedy=f"one of {', '.join(known)}")
    return names


def made_by(seeds: int, ground: list[str] | None, vehicle: str | None, logs: list[str] | None) -> str:
    """The command without the paths of logs, equal on every machine."""
    words = [f"terrafusion policy fit --seeds {seeds}", *(f"--ground {name}" for name in ground or [])]
    words += [f"--vehicle {vehicle}"] if vehicle else []
    return " ".join(words) + (f", {len(logs)} logs" if logs else "")
