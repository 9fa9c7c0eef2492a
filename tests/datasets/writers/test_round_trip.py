"""Any recording -> log folder or MCAP -> the same recording, to the bit."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from terrafusion.datasets.core.channels import (
    Barometer,
    Command,
    Gnss,
    Imu,
    Magnetometer,
    Motor,
    Steering,
    Terrain,
    Wheels,
)
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.recording import ClockJump, Overrides, Recording
from terrafusion.datasets.core.sensors import DRIVES
from terrafusion.datasets.core.trajectory import Trajectory
from terrafusion.datasets.core.wrapped_angles import unwrapped
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.writers import write_log_folder, write_mcap
from tests.differences import differences

S = 10**9
NUMBERS = st.one_of(
    st.just(float("nan")),
    st.floats(allow_nan=False, allow_infinity=False),
    st.sampled_from([0.0, -0.0, 5e-324, -1.7976931348623157e308, 1e6, 9.81]),
)
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=20)
LABELS = st.one_of(st.sampled_from(["mud", "snow", "", " wet sand ", 'a "b", c', "1e3", "nan"]), TEXTS)
CLASSES = st.sampled_from([(), ("mud",), ("loose sand", "Schnee, naß"), ("0", "1", "2")])


def table(*columns: int) -> st.SearchStrategy[np.ndarray]:
    """(n, *columns) doubles; sometimes NaN throughout, or in a whole column."""

    @st.composite
    def draw_table(draw: st.DrawFn, n: int) -> np.ndarray:
        values = draw(hnp.arrays(float, (n, *columns), elements=NUMBERS))
        for axis in draw(st.sets(st.integers(0, values.shape[1] - 1))) if values.ndim > 1 else ():
            values[:, axis] = np.nan
        return values

    return draw_table  # type: ignore[return-value]


@st.composite
def channels(draw: st.DrawFn, first_ns: int, start_ns: int, last_ns: int) -> dict[str, Any]:
    """Any subset of the channels, each with its own times; empty ones too."""

    def times() -> np.ndarray:
        near = st.integers(max(first_ns, start_ns - S), min(last_ns, start_ns + 100 * S))
        anywhere = st.integers(first_ns, last_ns)
        found = draw(st.lists(st.one_of(near, anywhere), max_size=6).map(sorted))
        return np.array(found, dtype=np.int64)

    def some(*columns: int) -> np.ndarray:
        return draw(table(*columns)(n))  # type: ignore[operator]

    def perhaps(*columns: int) -> np.ndarray | None:
        return some(*columns) if draw(st.booleans()) else None

    found: dict[str, Any] = {}
    for name in draw(st.sets(st.sampled_from([*Recording.CHANNELS, "truth"]), min_size=1)):
        t = times() if name != "truth" else np.unique(times())
        n = len(t)
        if name == "command":
            found[name] = Command(t, some(), some())
        elif name == "wheels":
            layouts = [(Wheels.LAYOUTS[0], "radps"), (Wheels.LAYOUTS[1], "radps")]
            layouts += [(names, "mps") for names in Wheels.LAYOUTS]
            names, unit = draw(st.sampled_from(layouts))
            angle = perhaps(len(names)) if names != ("speed",) else None
            found[name] = Wheels(t, some(len(names)), names, unit, angle)
        elif name == "imu":
            found[name] = Imu(t, some(3), some(3))
        elif name == "gnss":
            fix = draw(hnp.arrays(np.uint8, n, elements=st.integers(0, 4)))
            found[name] = Gnss(t, some(3), some(3), fix, perhaps(3), perhaps())
        elif name == "motor":
            found[name] = Motor(t, some(2), perhaps(2))
        elif name == "steering":
            names = draw(st.sampled_from(Steering.LAYOUTS))
            found[name] = Steering(t, some(len(names)), names)
        elif name == "barometer":
            found[name] = Barometer(t, some())
        elif name == "magnetometer":
            found[name] = Magnetometer(t, some(3))
        elif name == "terrain":
            label = np.array(draw(st.lists(LABELS, min_size=n, max_size=n)), dtype=object)
            classes = draw(CLASSES)
            source = draw(st.sampled_from(["annotation", "camera", "detector", "Gerät"]))
            found[name] = Terrain(t, label, source, classes, some(len(classes)) if classes else None)
        else:
            found[name] = draw(truths(t))
    return found


@st.composite
def truths(draw: st.DrawFn, t_ns: np.ndarray) -> Trajectory:
    n = len(t_ns)
    quaternion = None
    if draw(st.booleans()):
        q = draw(hnp.arrays(float, (n, 4), elements=st.floats(-1.0, 1.0)))
        norm = np.linalg.norm(q, axis=1, keepdims=True)
        quaternion = np.where(norm > 0.1, q / np.where(norm > 0.1, norm, 1.0), [0.0, 0.0, 0.0, 1.0])
        quaternion[draw(hnp.arrays(bool, n))] = np.nan
    twist = draw(table(6)(n)) if draw(st.booleans()) else None  # type: ignore[operator]
    covariance = draw(table(6, 6)(n)) if draw(st.booleans()) else None  # type: ignore[operator]
    if covariance is not None and draw(st.booleans()):
        covariance = np.triu(covariance) + np.triu(covariance, 1).transpose(0, 2, 1)
    return Trajectory(t_ns, draw(table(3)(n)), quaternion, twist, covariance)  # type: ignore[operator]


@st.composite
def recordings(draw: st.DrawFn, latest_ns: int) -> Recording:
    """Recordings with at least one sample, within 1e9 s of their start."""
    start_ns = draw(st.one_of(st.just(0), st.integers(0, latest_ns)))
    first_ns, last_ns = start_ns - 10**18, min(start_ns + 10**18, latest_ns)
    found = draw(channels(first_ns, start_ns, last_ns).filter(lambda c: any(map(len, c.values()))))
    positive = st.floats(0.05, 2.0)
    place = st.none() | st.tuples(*[st.floats(-20.0, 20.0)] * 3)
    truth = st.lists(st.sampled_from(["position", "yaw", "orientation", "velocity"]), max_size=4).map(tuple)
    jumps = st.builds(ClockJump, TEXTS, st.integers(-(2**62), 2**62), st.floats(-1e9, 1e9))
    return Recording(
        name=draw(TEXTS.filter(bool)),
        start_ns=start_ns,
        vehicle=draw(st.none() | TEXTS),
        **found,
        datum=draw(
            st.none()
            | st.tuples(st.floats(-89.9999, 89.9999), st.floats(-180.0, 180.0), st.floats(-1e3, 2e4))
        ),
        truth_channels=draw(truth),
        truth_frame=draw(st.sampled_from(["base", "antenna"])),
        overrides=Overrides(
            draw(st.none() | positive),
            draw(st.none() | positive),
            draw(place),
            draw(place),
            draw(st.none() | st.sampled_from(DRIVES)),
            draw(st.none() | positive),
            draw(st.none() | positive),
        ),
        description=draw(TEXTS),
        terrain_name=draw(TEXTS),
        licence=draw(TEXTS),
        source=draw(TEXTS),
        notes=tuple(draw(st.lists(TEXTS, max_size=3))),
        clock_jumps=tuple(draw(st.lists(jumps, max_size=2))),
        imu_frame_id=draw(TEXTS),
    )


CHECKED = settings(
    deadline=None, max_examples=80, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)


@CHECKED
@given(recordings(latest_ns=2**62))
def test_any_recording_survives_the_log_folder(recording: Recording) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        back = open_recording(write_log_folder(recording, Path(scratch) / "log"))
    assert differences(recording, back) == []


@CHECKED
@given(recordings(latest_ns=10**18))
def test_any_recording_survives_the_mcap(recording: Recording) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        write_mcap(recording, Path(scratch) / "log.mcap")
        back = open_recording(Path(scratch) / "log.mcap")
    assert differences(recording, back) == []


@pytest.mark.parametrize("latitude", [-90.0, 90.0])
def test_the_mcap_refuses_a_datum_on_a_pole(latitude: float, tmp_path: Path) -> None:
    gnss = Gnss(np.zeros(1, np.int64), np.zeros((1, 3)), np.ones((1, 3)), np.full(1, 4, np.uint8))
    recording = Recording(name="pole", start_ns=0, gnss=gnss, datum=(latitude, 0.0, 0.0))
    with pytest.raises(DataError, match="the datum lies on a pole"):
        write_mcap(recording, tmp_path / "log.mcap")
    assert list(tmp_path.iterdir()) == []


FIELD_LOGS = (
    "husky_parkinglot/test1",
    "wvu_pathfinder/s5t1",
    "umich_husky/mair_mocap/trial1",
    "borealtc/ICE/01",
    "norlab_drive/grass_2024_7_29_14h46s15/raw",
    "norlab_drive/sand_2024_9_25_14h13s47/windows#0",
)


@pytest.mark.parametrize("name", FIELD_LOGS)
def test_field_logs_survive_both(name: str, tmp_path: Path) -> None:
    if not os.environ.get("TERRAFUSION_DATA"):
        pytest.skip("TERRAFUSION_DATA is not set: the field logs are not at hand")
    recording = open_recording(name)
    write_mcap(recording, tmp_path / "log.mcap")
    for path in (write_log_folder(recording, tmp_path / "log"), tmp_path / "log.mcap"):
        assert differences(recording, open_recording(path)) == []


@pytest.mark.parametrize("label", ["\r", "mud\r\nand snow", 'so-called "mud", wet', "\x85"])
def test_any_label_survives_the_log_folder(tmp_path: Path, label: str) -> None:
    terrain = Terrain(np.arange(3) * 10**9, np.array(["mud", label, "snow"], dtype=object))
    wheels = Wheels(np.arange(3) * 10**9, np.zeros((3, 2)), ("left", "right"), "radps")
    recording = Recording(name="log", start_ns=0, wheels=wheels, terrain=terrain)
    back = open_recording(write_log_folder(recording, tmp_path / "log"))
    assert back.terrain is not None
    assert back.terrain.label.tolist() == ["mud", label, "snow"]


def test_angles_beyond_all_numbers_are_not_wrapped() -> None:
    angle = np.array([[-1.7e308], [1.7e308], [0.0]])
    assert unwrapped(angle, ("left",)) == (angle, "")
