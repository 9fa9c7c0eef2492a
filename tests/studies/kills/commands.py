"""The long commands, with little to do, and what they read."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import functools
import hashlib
import importlib
import os
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from terrafusion.datasets.catalog import catalog
from terrafusion.datasets.core.recording import Recording

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
    "init": ("init", "log", "--track", "0.62", "--out", "out/robot.yaml", "--force"),
    "gap-blind": ("gap-blind", "--quick", "--no-opponent", "--out", "out/run"),
    "policy fit": ("policy", "fit", "--seeds", "1", "--ground", "asphalt", "--out", "out/policy.yaml"),
    "terrain train": ("terrain", "train", "--seeds", "1", "--jobs", "1", "--out", "out/model.yaml"),
    "demo": ("demo", "--drives", "1", "--jobs", "1", "--out", "out/run"),
    "inspect": ("inspect", "log", "--report", "out/log.html"),
    "fetch": ("fetch", "toys/far", "--to", "out/run"),
    "fetch of local files": ("fetch", "toys/near", "--to", "out/run"),
}  # fmt: skip
"""Commands that run for long, with little to do. `live`, `allan` and `self-check` write no file."""


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


def preload(work: Path) -> None:
    """What commands import and fetch, and their shortened work, so that children start with it."""
    for name in HEAVY:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    for part in ("fusion.replay", "fusion.cli.main", "twin.simulate", "datasets.writers"):
        importlib.import_module(f"terrafusion.{part}")
    _shorten_training()
    _shorten_blind_check()
    _shorten_demo(str(work / "drive.yaml"))
    _offer_files(work / "catalogue")


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


def _offer_files(folder: Path) -> None:
    """A catalogue of two files for this process and its children: one on a server here, one at hand."""
    content = "".join(f"{i},{i * i}\n" for i in range(200_000)).encode()
    digest = hashlib.sha256(content).hexdigest()
    for name in ("far", "near"):
        (folder / name / "toys").mkdir(parents=True, exist_ok=True)
        (folder / name / "toys" / f"{name}.csv").write_bytes(content)
    handler = functools.partial(_Quiet, directory=str(folder / "far"))
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    (folder / "catalog.yaml").write_text(
        "toys: {title: Toys, holds: bytes, licence: CC0-1.0, citation: '', homepage: '', format: ''}\n"
    )
    with (folder / "catalog_files.csv").open("w", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(catalog.FILE_COLUMNS)
        for name in ("far", "near"):
            file, url = f"toys/{name}.csv", f"http://127.0.0.1:{server.server_address[1]}"
            writer.writerow(["toys", name, file, url, "", file, digest, len(content)])
    os.environ[catalog.CATALOG_VARIABLE] = str(folder)
    os.environ[catalog.DATA_VARIABLE] = str(folder / "near")


class _Quiet(SimpleHTTPRequestHandler):
    """Serves files without a word."""

    def log_message(self, *_: object) -> None:
        pass


def _shorten_demo(scenario: str) -> None:
    """The demo drives a short scenario, in this process and its children."""
    from terrafusion.fusion.cli import demo
    from terrafusion.twin import simulate as module

    simulate, demo.OUTAGE_START_S, demo.OUTAGE_S = module.simulate, 8.0, 6.0

    def short(name: str, **options: object) -> Recording:
        return simulate(scenario if name == "demo" else name, **options)  # type: ignore[arg-type]

    module.simulate = short  # type: ignore[assignment]
