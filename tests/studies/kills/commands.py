"""The long commands, with little to do, and what they read."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
from pathlib import Path

SCENARIO = """\
description: a short drive with turns both ways
drive:
  - {duration_s: 2}
  - {duration_s: 6, v_mps: 0.9}
  - {duration_s: 7, v_mps: 0.9, yaw_rate_radps: 0.4}
  - {duration_s: 7, v_mps: 0.9, yaw_rate_radps: -0.4}
max_accel_mps2: 0.5
route:
  - {terrain: asphalt}
"""
SWEEP = """\
description: slopes
scenario: drive.yaml
axes:
  terrain: [asphalt, loose_sand]
  slope_deg: [0, 5, 10, 15]
"""
COMMANDS: dict[str, tuple[str, ...]] = {
    "simulate": ("simulate", "drive.yaml", "--out", "out/run"),
    "simulate to mcap": ("simulate", "drive.yaml", "--out", "out/run.mcap", "--force"),
    "convert": ("convert", "log", "out/log", "--force"),
    "replay": ("replay", "log", "--mode", "fixed", "--out", "out/run"),
    "sweep": ("sweep", "slopes.yaml", "--out", "out/run", "--jobs", "1", "--recordings", "3"),
    "calibrate --sensors": ("calibrate", "log", "--sensors", "--out", "out/robot.yaml"),
    "calibrate": (
        "calibrate", "log", "--terrain", "asphalt", "--parameters", "soil.shear.friction_cap", "--out",
        "out/run",
    ),
    "gap": ("gap", "log", "--effects", "wheel_radius,gyro_bias", "--out", "out/run"),
    "benchmark": ("benchmark", "--only", "firm=1", "--jobs", "1", "--out", "out/run"),
    "init": ("init", "log", "--track", "0.62", "--out", "out/robot.yaml"),
    "study": ("study", "--quick", "--seeds", "1", "--jobs", "1", "--out", "out/run"),
    "gap-blind": ("gap-blind", "--quick", "--no-opponent", "--out", "out/run"),
    "policy fit": ("policy", "fit", "--seeds", "1", "--ground", "asphalt", "--out", "out/policy.yaml"),
    "terrain train": ("terrain", "train", "--seeds", "1", "--jobs", "1", "--out", "out/model.yaml"),
}  # fmt: skip
"""Commands that run for long, with little to do. `demo` is simulate and replay; `live` writes no file."""


def prepared(work: Path) -> Path:
    """A folder with what the commands read."""
    from terrafusion.datasets.writers import write_log_folder
    from terrafusion.twin.simulate import simulate

    work.mkdir(parents=True, exist_ok=True)
    (work / "drive.yaml").write_text(SCENARIO)
    (work / "slopes.yaml").write_text(SWEEP)
    if not (work / "log").exists():
        write_log_folder(simulate(str(work / "drive.yaml"), seed=1), work / "log")
    return work


HEAVY = ("gtsam", "pandas", "matplotlib.pyplot", "scipy.optimize", "pyarrow.parquet", "jinja2", "joblib")


def preload() -> None:
    """What commands import, so that children start with it."""
    for name in HEAVY:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for part in ("fusion.replay", "fusion.cli.main", "twin.simulate", "datasets.writers"):
        importlib.import_module(f"terrafusion.{part}")
    _shorten_training()
    _shorten_blind_check()


def _shorten_training() -> None:
    """Trainings on level ground without load, in this process and its children."""
    from terrafusion.fusion.training import policy_fit, train_detector

    none = (0.0,)
    scenarios = train_detector.SCENARIOS
    train_detector.TrainingPlan.__init__.__defaults__ = (1, scenarios, none, none)  # type: ignore[misc]
    policy_fit.SLOPES_DEG, policy_fit.PAYLOADS_KG = none, none


def _shorten_blind_check() -> None:
    """One sealed trial, without effect, of one run and few references."""
    from terrafusion.twin.gap.blind import plan

    plan.QUICK = plan.CheckSize(1, *[0] * (len(dataclasses.fields(plan.CheckSize)) - 1))
    plan.USUAL_REFERENCES, plan.RUNS = 3, 1
