"""Write a recording, and an estimate beside it, as one ROS 2 MCAP file; reading it back loses nothing."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.channels import Channel, Fix, Gnss, Wheels
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.json_text import finite
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.core.scratch import scratch_folder
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.readers.ros.exact import META
from terrafusion.datasets.writers import ros_messages as ros
from terrafusion.datasets.writers.log_folder import OutputTable, meta_of, tables_of, vehicle_file, writing
from terrafusion.datasets.writers.mcap_estimate import WrittenEstimate
from terrafusion.datasets.writers.mcap_file import TopicMessages, write_mcap_file

if TYPE_CHECKING:
    from terrafusion.datasets.core.sensors import Rig

C = TypeVar("C", bound=Channel)
NOMINAL_DATUM = (0.0, 0.0, 0.0)
"""ENU origin of a recording that has none: latitude, longitude (deg), height (m)."""

END_NS = 2**31 * 10**9
"""The stamp of a ROS message ends here, in the year 2038."""


def write_mcap(
    recording: Recording,
    path: Path | str,
    estimate: WrittenEstimate | Trajectory | None = None,
    *,
    rig: Rig | None = None,
    overwrite: bool = False,
) -> tuple[str, ...]:
    """Write one `.mcap` file (profile ros2, CDR, definitions inside) with standard messages.

    Topics: `/imu/data` Imu, `/joint_states` JointState (wheels in rad/s) or `/wheel/odom` Odometry
    (in m/s), `/fix` NavSatFix, `/fix_velocity` TwistWithCovarianceStamped (east, north, up),
    `/steering/joint_states` JointState, `/pressure` FluidPressure, `/imu/mag` MagneticField,
    `/datum` NavSatFix (the ENU origin, once), `/cmd_vel` TwistStamped, `/terrain` String,
    `/ground_truth/odom` and `/odometry/filtered` (the estimate) Odometry, map -> base_link,
    `/tf` (the estimate) and `/tf_static` (positions of IMU and antenna where known) TFMessage,
    `/diagnostics` (status of the estimate) DiagnosticArray. Log times are the stamps. What these
    cannot hold to the bit stands on topics of their own, see `readers/ros/exact.py`.

    Args:
        path: the file to write; it appears when it is whole.
        estimate: what to write beside it, or its poses alone; it is not part of the recording and
            not read back.
        rig: gives the track that turns side speeds in m/s into a yaw rate, and the positions of
            the sensors; the recording's own `overrides` go first.
        overwrite: replace a file that exists.

    Returns:
        Sentences on what is not in standard messages, and so only seen by this library.

    Raises:
        DataError: the file exists, cannot be written, or a time beyond 2038. ConfigError:
            a text, position or datum that the log folder would not take either.
    """
    path = Path(path)
    with writing(path):
        if path.is_dir() or (path.exists() and not overwrite):
            raise DataError("exists already", file=path, remedy="remove it or give another name")
        vehicle = vehicle_file(recording.vehicle)  # a bag has no folder of its own to copy it into
        recording = dataclasses.replace(recording, vehicle=str(vehicle)) if vehicle else recording
        saved = meta_of(recording, path, path.stem)
        saved |= {"metadata": finite(recording.metadata)} if recording.metadata else {}
        shift_ns = _shift_ns(recording)
        recording = _later(recording, shift_ns)
        parts = _Parts(recording, rig)
        if shift_ns:
            parts.unseen.append(f"times before 1970: stamps are {shift_ns // 10**9} s later")
        topics = list(parts.standard())
        if estimate is not None:
            beside = WrittenEstimate(estimate) if isinstance(estimate, Trajectory) else estimate
            topics += beside.topics(shift_ns)
        saved |= {**parts.saved(), "shift_ns": shift_ns}
        start_ns = min([recording.start_ns, *(int(t.t_ns[0]) for t in topics if len(t.t_ns))])
        topics = [ros.text(META[0], start_ns, json.dumps(saved)), *parts.once(start_ns), *topics]
        for topic in topics:
            _check_times(topic, path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with scratch_folder(path.parent) as scratch:
            whole = scratch / path.name
            write_mcap_file(whole, topics, _definitions(topics))
            whole.replace(path)
    return tuple(parts.unseen)


def _shift_ns(recording: Recording) -> int:
    """Whole seconds, in ns, that bring the first time up to 1970: a log without a date starts at 0."""
    channels = (*recording.channels().values(), recording.truth)
    first = min((int(c.t_ns[0]) for c in channels if c is not None and len(c)), default=0)
    return max(-(first // 10**9), 0) * 10**9


def _later(recording: Recording, shift_ns: int) -> Recording:
    parts = {name: getattr(recording, name) for name in (*Recording.CHANNELS, "truth")}
    moved = {n: dataclasses.replace(p, t_ns=p.t_ns + shift_ns) for n, p in parts.items() if p is not None}
    return dataclasses.replace(recording, start_ns=recording.start_ns + shift_ns, **moved)


def _check_times(topic: TopicMessages, path: Path) -> None:
    for t in topic.t_ns[:1].tolist() + topic.t_ns[-1:].tolist():
        if not 0 <= t < END_NS:
            raise DataError(
                f"time {t} ns", file=path, channel=topic.name, remedy="ROS has times from 1970 to 2038"
            )


def _definitions(topics: list[TopicMessages]) -> dict[str, tuple[str, str]]:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    names = {topic.msgtype for topic in topics}
    return {name: (store.generate_msgdef(name, ros_version=2)[0], store.hash_rihs01(name)) for name in names}


class _Parts:
    """The topics of one recording; `unseen` lists what only this library reads."""

    def __init__(self, recording: Recording, rig: Rig | None) -> None:
        self.recording = recording
        self.rig = rig
        self.tables = tables_of(recording)
        self.words = {"fix": [fix.name.lower() for fix in Fix]}
        if recording.terrain is not None:
            self.words["label"] = sorted({str(label) for label in recording.terrain.label.tolist()})
        self.unseen: list[str] = []
        self.only_here: set[str] = {"gnss", "terrain", "motor"} & self.tables.keys()

    def saved(self) -> dict[str, Any]:
        """Columns and words of the tables that are written."""
        tables = {name: list(self.tables[name].columns) for name in sorted(self.only_here)}
        return {"tables": tables, "words": self.words}

    def once(self, start_ns: int) -> Iterator[TopicMessages]:
        """Topics with one message at the start."""
        positions = self._positions()
        if positions:
            yield ros.static_transforms(start_ns, positions)
        if self.recording.gnss is not None:
            yield ros.datum(start_ns, self.recording.datum or NOMINAL_DATUM)

    def _positions(self) -> dict[str, tuple[float, ...]]:
        own, sensors = self.recording.overrides, self.rig.sensors if self.rig else None
        known = {
            "imu_link": own.imu_m or (sensors.imu.position_m if sensors else None),
            "gnss_antenna": own.antenna_m or (sensors.gnss.antenna_m if sensors else None),
        }
        return {frame: position for frame, position in known.items() if position is not None}

    def standard(self) -> Iterator[TopicMessages]:
        """Topics of the channels: standard messages, then the tables of those they cannot hold."""
        r = self.recording
        if r.command is not None:
            yield ros.command(self._complete(r.command))
        if r.wheels is not None:
            yield from self._wheels(r.wheels)
        if r.imu is not None:
            yield ros.imu(self._complete(r.imu), self._imu_frame())
        if r.steering is not None:
            yield ros.steering(self._complete(r.steering))
        if r.barometer is not None:
            yield ros.pressure(self._complete(r.barometer))
        if r.magnetometer is not None:
            yield ros.magnetic_field(self._complete(r.magnetometer), self._imu_frame())
        if r.gnss is not None:
            yield from self._gnss(r.gnss)
        if r.terrain is not None:
            yield ros.terrain(r.terrain)
            if r.terrain.probabilities is not None:
                self.unseen.append("terrain: class probabilities")
        if r.motor is not None:
            self.unseen.append("motor: currents and voltages")
        if r.truth is not None:
            yield self._truth(r.truth)
        for name in sorted(self.only_here):
            yield ros.table(name, self.tables[name].t_ns, self._numbers(self.tables[name]))

    def _numbers(self, table: OutputTable) -> dict[str, NDArray[np.float64]]:
        """The columns as doubles: a text is its place among the words."""
        codes = {name: {word: k for k, word in enumerate(words)} for name, words in self.words.items()}
        return {
            name: np.array([codes[name][str(text)] for text in column.tolist()], dtype=float)
            if name in codes
            else column.astype(float)
            for name, column in table.columns.items()
        }

    def _complete(self, channel: C) -> C:
        """The rows of a channel without missing values; where others are left out it gets a table."""
        full, name = np.ones(len(channel), dtype=bool), channel.name
        for column in channel.columns().values():
            full &= np.isfinite(column)
        if not full.all() or not len(channel):
            self.only_here.add(name)
        if not full.all():
            self.unseen.append(f"{name}: {int((~full).sum())} rows with missing values")
        return channel.select(full)

    def _imu_frame(self) -> str:
        return "imu_link" if "imu_link" in self._positions() else "base_link"

    def _wheels(self, wheels: Wheels) -> Iterator[TopicMessages]:
        complete = self._complete(wheels)
        if wheels.unit == "radps" and wheels.has_sides():
            yield ros.joint_states(complete)
            return
        self.only_here.add("wheels")
        if wheels.unit == "radps":
            self.unseen.append("wheels: a mean wheel speed in rad/s")
            return
        track = self.recording.overrides.track_m or (self.rig.track_m if self.rig else None)
        if wheels.has_sides() and track is None:
            self.unseen.append("wheels: side speeds (no track is known that makes a yaw rate of them)")
        if wheels.angle_rad is not None:
            self.unseen.append("wheels: wheel angles (Odometry has none)")
        yield ros.wheel_odometry(complete, track)

    def _gnss(self, gnss: Gnss) -> Iterator[TopicMessages]:
        if (gnss.fix == Fix.FLOAT).any():
            self.unseen.append("gnss: the 'float' fix class (NavSatFix has none; written as augmented, SBAS)")
        if self.recording.datum is None:
            self.unseen.append("gnss: no datum is known; latitude and longitude are about 0, 0, 0 m")
        yield ros.fixes(gnss, self.recording.datum or NOMINAL_DATUM)
        if gnss.velocity_enu_mps is not None:
            yield ros.gnss_velocity(gnss.select(np.isfinite(gnss.velocity_enu_mps[:, :2]).all(axis=1)))

    def _truth(self, truth: Trajectory) -> TopicMessages:
        if not _odometry_holds(truth):
            self.only_here.add("truth")
        known = np.isfinite(truth.position_m[:, :2]).all(axis=1)
        if truth.quaternion is not None:
            known &= np.isfinite(truth.quaternion).all(axis=1)
        if not known.all():
            self.unseen.append(f"truth: {int((~known).sum())} poses with missing values")
        child = "base_link" if self.recording.truth_frame == "base" else "gnss_antenna"
        return ros.trajectory("/ground_truth/odom", truth.select(known), child)


def _odometry_holds(truth: Trajectory) -> bool:
    """Whether the reader of Odometry gets the same trajectory back to the bit."""
    q, twist = truth.quaternion, truth.twist_body
    return (
        len(truth) > 0
        and truth.covariance is None
        and bool(np.isfinite(truth.position_m[:, :2]).all() and not np.isinf(truth.position_m).any())
        and (q is None or bool((np.abs(np.linalg.norm(q, axis=1) - 1.0) < 0.01).all()))
        and (twist is None or bool((np.nan_to_num(twist) != 0.0).any() and not np.isinf(twist).any()))
    )
