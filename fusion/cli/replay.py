"""`terrafusion replay`: a recorded drive through the estimator, scored, with a report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from terrafusion.datasets.core.errors import ConfigError, errors_of
from terrafusion.fusion.cli import common
from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.outputs import Output

if TYPE_CHECKING:
    from terrafusion.datasets.checks import Finding
    from terrafusion.fusion.estimator.learned_numbers import NumberAfterDrive
    from terrafusion.fusion.metrics.scores import Outage
    from terrafusion.fusion.replay import ReplayResult

OUTPUT = Output(
    "Folder for the results and report.html.",
    (
        "config.json",
        "metrics.json",
        "estimate.csv",
        "trajectory.tum",
        "weights.jsonl",
        "report.html",
        "estimate.mcap",
    ),
    ("metrics.json",),
    mark="terrafusion.replay/",
)
DeclinationOption = Annotated[
    float | None,
    typer.Option(
        metavar="DEG",
        min=-180.0,
        max=180.0,
        help="Magnetic north, degrees east of north: the magnetometer then gives the heading at rest.",
    ),
]


def replay(
    log: common.LogArgument,
    out: Path,
    mode: common.Mode = "adaptive",
    vehicle: common.VehicleOption = None,
    policy: Path | None = None,
    batch: bool = False,
    calibrate: bool = False,
    mcap: bool = False,
    rerun: Path | None = None,
    gnss_outage: list[str] | None = None,
    magnetometer: bool = False,
    declination: DeclinationOption = None,
    grounds: Path | None = None,
    terrain_model: Path | None = None,
    *,
    how: common.HowRead,
) -> Result:
    """Estimate a recorded drive as it would have run live, and score it.

    Scored against the log's truth; without one, against every fifth GNSS fix, held out of the
    estimator. Writes metrics.json, estimate.csv, trajectory.tum, weights.jsonl and report.html.

    Example: terrafusion replay drive.bag --vehicle husky --gnss-outage 150:60 --out results

    Example: terrafusion replay drive.bag --vehicle husky --calibrate --batch --out calibrated

    Args:
        mode: adaptive: noise follows the detected terrain; fixed: one noise for all terrains; robust: fixed
            with a robust loss; innovation: noise estimated from the innovations.
        policy: Weighting policy; by default the one shipped.
        batch: Smooth the whole drive at once, instead of with a fixed lag as live.
        calibrate: Also estimate corrections of the vehicle file: wheel radius, antenna, IMU mounting, delays
            of wheels and GNSS.
        mcap: Also write the log with the estimate (odometry, diagnostics) to estimate.mcap.
        rerun (FILE.rrd): Also write the replay for the Rerun viewer (extra: rerun).
        gnss_outage (START:SECONDS): Hold out all fixes of a stretch and score there; repeat for more.
        magnetometer: Use the log's magnetometer; a barometer is always used.
        grounds (FILE.yaml): What the robot learned of its grounds: read if it is there, and written after the
            drive.
        terrain_model (FILE.yaml): Model of this robot's grounds, of `terrain train`.
    """
    from terrafusion.fusion.estimator.feed import wheels_of
    from terrafusion.fusion.grounds.file import read_grounds
    from terrafusion.fusion.replay import replay as run
    from terrafusion.fusion.reports.rerun_log import require_rerun
    from terrafusion.fusion.terrain.classifier import load_terrain_model

    if rerun is not None:
        require_rerun()
    turned = None if declination is None else math.radians(declination)
    outages = [_outage(text) for text in gnss_outage or []]
    memory = None if grounds is None else read_grounds(grounds)
    model = None if terrain_model is None else load_terrain_model(terrain_model)
    rig = common.load_rig(vehicle)
    recording = how.open(log, rig)
    with errors_of(log):
        wheels_of(recording)  # refused before faults that are repaired in vain without them
    findings = common.refuse_errors(log, recording, rig, learned=() if calibrate else ("imu-forward",))
    with common.progress_bar(f"{mode} {recording.name}") as progress, errors_of(log):
        result = run(
            recording, vehicle=vehicle, mode=mode, policy=policy, outages=outages, batch=batch,
            magnetometer=magnetometer or declination is not None,
            settings={"calibrate": calibrate, "declination_rad": turned, "terrain_model": model},
            grounds=memory, findings=findings, progress=progress,
        )  # fmt: skip
    unseen, done = _write(result, out, mcap, rerun, grounds)
    return _shown(result, findings, unseen, out, done)


def _outage(text: str) -> Outage:
    """An outage; a malformed one is wrong usage (exit status 2)."""
    from terrafusion.fusion.metrics.scores import parse_outage

    try:
        return parse_outage(text)
    except ConfigError as error:
        raise typer.BadParameter(str(error), param_hint="--gnss-outage") from None


def _write(
    result: ReplayResult, out: Path, mcap: bool, rerun: Path | None, grounds: Path | None
) -> tuple[list[str], str]:
    """All files of a replay; returns lines on what the bag could not hold, and what was written."""
    from terrafusion.fusion.grounds.file import save_grounds
    from terrafusion.fusion.reports.replay import write_replay
    from terrafusion.fusion.reports.rerun_log import write_rerun

    done = f"written to {out}"
    if grounds is not None and result.grounds is not None:
        done += f"; {save_grounds(result.grounds, grounds)}"
    write_replay(out, result, {"command": common.command_line()})
    unseen = _write_bag(result, out / "estimate.mcap") if mcap else []
    if rerun is not None:
        write_rerun(result, rerun)
    return unseen, done


def _shown(
    result: ReplayResult, findings: Sequence[Finding], unseen: Sequence[str], out: Path, done: str
) -> Result:
    """What the command prints, the verdict first."""
    warnings = [_warning(finding, result.learned) for finding in findings]
    lines = [*unseen, *summary(result), *assumed_and_noted(result, warnings)]
    short = f"{result.verdict.lines()[0]}; {done}"
    return Result(lines, done, common.read_json(out / "metrics.json"), short=short, vehicle=result.vehicle)


def _warning(finding: Finding, learned: Sequence[NumberAfterDrive]) -> str:
    """A finding of the log checks as a line, with its remedy unless the drive gave it."""
    from terrafusion.fusion.metrics.verdict_of_numbers import LEARNED

    settling = LEARNED.get((finding.code, finding.channel))
    corrected = any(number.corrects and number.state == settling for number in learned)
    remedy = "self-calibration corrects it" if corrected else finding.fix
    return f"log check, {finding.channel}: {finding.what} ({finding.evidence}); {remedy}"


def _write_bag(result: ReplayResult, path: Path) -> list[str]:
    """The log and the estimate in one bag; returns lines on what is not in standard messages."""
    from terrafusion.datasets.writers.mcap import write_mcap
    from terrafusion.fusion.outputs.ros_estimate import written_estimate

    written = written_estimate(result.estimate)
    unseen = write_mcap(result.recording, path, written, rig=result.vehicle.rig(), overwrite=True)
    return [f"not in standard messages: {part}" for part in unseen]


def assumed_and_noted(result: ReplayResult, warnings: Sequence[str]) -> list[str]:
    """What the run assumed and noted, and the warnings of the log checks that the verdict does not name."""
    notes = dict.fromkeys((*result.estimate.notes, *result.scores.notes))
    reasons = " ".join(result.verdict.reasons).lower()
    warned = [warning for warning in warnings if warning.lower() not in reasons]
    assumed = [str(one) for one in result.assumed]
    others = [f"note: {note}" for note in notes if note not in assumed]
    return [*(f"assumed: {one}" for one in assumed), *warned, *others]


def summary(result: ReplayResult) -> list[str]:
    """The result as lines of text, the verdict first."""
    from terrafusion.fusion.outputs.linear_states import calibration, cells, learned_rows
    from terrafusion.fusion.outputs.replay_files import final_status

    scores = result.scores
    status = final_status(result.estimate)
    lines = [
        *result.verdict.lines(),
        f"{result.recording.name}: {result.recording.duration_s():.1f} s, {result.mode}, "
        f"{result.realtime_factor():.0f} x real time",
        f"status: {status['value']} ({status['message']})",
    ]
    if scores.held_out is not None:
        held = scores.held_out
        lines.append(
            f"{held.fixes} held-out fixes: median error {held.median_m:.2f} m, 95 % {held.p95_m:.2f} m"
        )
    if scores.against == "truth" and scores.ate_m is not None:
        lines.append(f"against truth: position error {scores.ate_m:.3f} m (root mean square)")
    held_fix = "the receiver alone (its last fix held in gaps)"
    alone = (("dead reckoning", result.baselines.dead_reckoning_m), (held_fix, result.baselines.gnss_m))
    if shown := [f"{name} {error_m:.3f} m" for name, error_m in alone if error_m is not None]:
        lines.append(f"for comparison, scored alike: {', '.join(shown)}")
    for outage in scores.outages:
        if outage.end_error_m is None or outage.median_m is None:
            lines.append(f"outage at {outage.start_s:g} s: nothing to score against near its end")
        else:
            lines.append(
                f"outage {outage.start_s:g} to {outage.start_s + outage.seconds:g} s: median error "
                f"{outage.median_m:.2f} m, {outage.end_error_m:.2f} m after {outage.distance_m:.0f} m"
            )
    for what, value, sigma, _, verdict in map(cells, calibration(result.estimate, result.vehicle.rig())):
        lines.append(f"{what}: {value} +- {sigma} ({verdict})")
    corrections = [row for row in learned_rows(result.learned) if row["corrects"]]
    for what, value, sigma, *_ in map(cells, corrections):
        lines.append(f"self-calibration corrects: {what}: {value} +- {sigma}")
    return lines
