"""A replay as a recording for the Rerun viewer: `terrafusion replay ... --rerun FILE.rrd`.

    world/path, world/truth                        lines; the estimate coloured by the most probable terrain
    world/base_link                                the body, as a transform over time
    world/gnss/{used,rejected,held_out}           points
    world/two_sigma                                ellipses of the position, as in the report
    slip, speed, sigma, bias, terrain, weights     numbers over time
    states/<name>, states/sigma_<name>             the other linear states and their 1 sigma
    nis/<sensor>                                   normalised innovation squared over its dimension
    events                                         changes of weight and of status, with their reasons

Times are on two timelines: `elapsed` from the start of the recording, and `stamp`, the time of the log.
The package `rerun-sdk` is an extra and imported only here.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.arrays import Array, TimesNs
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.fusion.estimate.estimate import STATUS, Estimate
from terrafusion.fusion.graph.key_state import LINEAR
from terrafusion.fusion.outputs.linear_states import series
from terrafusion.fusion.outputs.replay_files import is_local
from terrafusion.fusion.replay import ReplayResult
from terrafusion.fusion.reports.plots import style
from terrafusion.fusion.reports.plots.replay_map import ellipse_rows, ellipses, rejected_fixes

GNSS_COLOUR, REJECTED_COLOUR, BODY_COLOUR = "#9a9a9a", "#111111", "#0072b2"


def require_rerun() -> Any:
    """The module `rerun`; a ConfigError where it is not installed."""
    try:
        import rerun
    except ImportError as absent:
        raise ConfigError(
            "the package rerun-sdk is not installed", remedy='pip install "terrafusion[rerun]"'
        ) from absent
    return rerun


def write_rerun(result: ReplayResult, path: Path) -> Path:
    """Write the replay to `path` (.rrd), which appears when it is whole.

    Raises:
        ConfigError: rerun is not installed. TerrafusionError: the file cannot be written.
    """
    rr = require_rerun()

    def write(part: Path) -> None:
        stream = rr.RecordingStream("terrafusion", recording_id=f"{result.recording.name} {result.mode}")
        part.touch()  # raises OSError where the folder cannot be written
        stream.save(part, default_blueprint=_blueprint())
        log = _Log(rr, stream, result.recording.start_ns)
        _world(log, result)
        _numbers(log, result.estimate)
        _events(log, result.estimate)
        stream.flush()
        stream.disconnect()

    return write_atomically(path, write)


class _Log:
    """One stream, and the two timelines of each row."""

    def __init__(self, rr: Any, stream: Any, start_ns: int) -> None:
        self.rr, self.stream, self.start_ns = rr, stream, start_ns

    def fixed(self, entity: str, what: Any) -> None:
        """Something that holds at all times."""
        self.stream.log(entity, what, static=True)

    def over_time(self, entity: str, t_ns: TimesNs, columns: Any) -> None:
        """Rows at the times (N,)."""
        if len(t_ns):
            elapsed = (t_ns - self.start_ns).astype("timedelta64[ns]")
            indexes = [
                self.rr.TimeColumn("elapsed", duration=elapsed),
                self.rr.TimeColumn("stamp", timestamp=t_ns.astype("datetime64[ns]")),
            ]
            self.stream.send_columns(entity, indexes, columns)

    def scalars(self, folder: str, t_ns: TimesNs, series: Mapping[str, Array]) -> None:
        """A number over time each; rows that are not finite are left out."""
        for name, values in series.items():
            known = np.isfinite(values)
            entity = f"{folder}/{name}".strip("/")
            self.over_time(entity, t_ns[known], self.rr.Scalars.columns(scalars=values[known]))


def _world(log: _Log, result: ReplayResult) -> None:
    rr, estimate, recording = log.rr, result.estimate, result.recording
    path = estimate.trajectory
    log.fixed("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    xyz = np.nan_to_num(path.position_m)
    label = estimate.ground() if estimate.classes else np.full(len(path), "")
    runs = style.runs_of(label)
    colours = [_rgba(style.terrain_colour(label[first])) for first, _ in runs]
    lines = [xyz[first : last + 1] for first, last in runs]
    log.fixed("world/path", rr.LineStrips3D(lines, colors=colours, radii=0.08))
    rings = ellipses(estimate, ellipse_rows(estimate, recording.start_ns, result.outages))
    flat = [np.column_stack([ring, np.zeros(len(ring))]) for ring in rings]
    log.fixed("world/two_sigma", rr.LineStrips3D(flat, colors=_rgba(BODY_COLOUR), radii=0.02))
    log.fixed("world/base_link/origin", rr.Points3D([[0.0, 0.0, 0.0]], colors=_rgba(BODY_COLOUR), radii=0.25))
    pose = rr.Transform3D.columns(translation=xyz, quaternion=path.quaternion)
    log.over_time("world/base_link", path.t_ns, pose)
    if recording.truth is not None and len(recording.truth) and not is_local(estimate):
        points = np.nan_to_num(recording.truth.position_m)
        log.fixed("world/truth", rr.LineStrips3D([points], colors=_rgba(style.TRUTH), radii=0.04))
    rejected = np.isin(result.used.t_ns, rejected_fixes(estimate)) if result.used is not None else None
    for name, gnss, rows, colour in (
        ("used", result.used, None if rejected is None else ~rejected, GNSS_COLOUR),
        ("rejected", result.used, rejected, REJECTED_COLOUR),
        ("held_out", result.held_out, slice(None), style.HELD_OUT),
    ):
        if gnss is not None and len(gnss):
            points = np.nan_to_num(gnss.enu_m[rows])
            log.fixed(f"world/gnss/{name}", rr.Points3D(points, colors=_rgba(colour), radii=0.1))


def _numbers(log: _Log, estimate: Estimate) -> None:
    path = estimate.trajectory
    t_ns, twist = path.t_ns, path.twist_body
    log.scalars("slip", t_ns, {"mean": estimate.slip, "sigma": estimate.slip_sigma})
    if twist is not None:
        log.scalars("speed", t_ns, {"forward_mps": twist[:, 0], "yaw_rate_radps": twist[:, 5]})
    if path.covariance is not None:
        sigma = np.sqrt(np.maximum(np.diagonal(path.covariance, axis1=1, axis2=2), 0.0))
        named = {"east_m": sigma[:, 0], "north_m": sigma[:, 1], "heading_deg": np.degrees(sigma[:, 5])}
        log.scalars("sigma", t_ns, named)
    for i, axis in enumerate("xyz"):
        biases = {
            f"gyro_{axis}_radps": estimate.gyro_bias_radps[:, i],
            f"accel_{axis}_mps2": estimate.accel_bias_mps2[:, i],
        }
        log.scalars("bias", t_ns, biases)
    for name in LINEAR[1:]:
        state = series(estimate, name)
        if state is not None:
            log.scalars("states", t_ns, {name: state[0], f"sigma_{name}": state[1]})
    log.scalars("terrain", t_ns, dict(zip(estimate.classes, estimate.terrain.T, strict=True)))
    log.scalars("weights", t_ns, estimate.weights)
    for sensor in dict.fromkeys(i.sensor for i in estimate.innovations):
        tested = [i for i in estimate.innovations if i.sensor == sensor and i.dof > 0]
        times = np.array([i.t_ns for i in tested], dtype=np.int64)
        log.scalars("nis", times, {sensor: np.array([i.nis / i.dof for i in tested])})


def _events(log: _Log, estimate: Estimate) -> None:
    events = [
        (c.t_ns, f"{c.sensor}: {c.before:.4g} -> {c.after:.4g} {c.unit} ({c.reason})", "INFO")
        for c in estimate.changes
    ]
    for first, _ in style.runs_of(estimate.status):
        status = str(estimate.status[first])
        level = "INFO" if status == "running" else "WARN"
        events.append(
            (int(estimate.trajectory.t_ns[first]), f"{status}: {STATUS.get(status, status)}", level)
        )
    events.sort(key=lambda event: event[0])
    times = np.array([event[0] for event in events], dtype=np.int64)
    columns = log.rr.TextLog.columns(
        text=[event[1] for event in events], level=[event[2] for event in events]
    )
    log.over_time("events", times, columns)


def _blueprint() -> Any:
    """Map on the left; slip, terrain, weights and events on the right."""
    import rerun.blueprint as rrb

    views = [rrb.TimeSeriesView(origin=name, name=name) for name in ("slip", "terrain", "weights", "nis")]
    side = rrb.Vertical(*views, rrb.TextLogView(origin="events", name="events"))
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="world", name="map"), side))


def _rgba(colour: str) -> int:
    """0xRRGGBBAA of `#rrggbb`."""
    return int(colour[1:], 16) << 8 | 0xFF
