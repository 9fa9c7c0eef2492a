"""Dump and restore in the middle of a drive: the same bits after it, and harmless files."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import hashlib
import json
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np
import pytest

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.messages import GnssSample, Message
from terrafusion.fusion.estimate.estimate import State
from terrafusion.fusion.estimator import snapshot
from terrafusion.fusion.estimator.estimator import Estimator
from terrafusion.fusion.graph.factor_numbers import factor_from, numbers_of
from terrafusion.twin.simulate import simulate

CUTS_S = {"waiting": 0.5, "aligning": 2.0, "running": 14.03, "outage": 30.0, "running again": 42.0}
OUTAGE_S = (20.0, 35.0)


def drive() -> Iterator[Message]:
    """Asphalt, standing for the first seconds, without fixes for a while."""
    recording = simulate("figure_eight", terrain="asphalt", seed=5)
    low, high = (recording.start_ns + round(t * 1e9) for t in OUTAGE_S)
    for message in recording.messages():
        t_ns = message.t_ns
        outage = isinstance(message, GnssSample) and low < t_ns < high
        if not outage and t_ns < recording.start_ns + 45e9:
            yield message


def sha(state: State) -> str:
    """Of every bit of a state."""
    values = [v.tobytes() if isinstance(v, np.ndarray) else v for v in vars(state).values()]
    return hashlib.sha256(repr(values).encode()).hexdigest()


def later_states(estimator: Estimator, after_ns: int) -> list[str]:
    """The SHA of every keyframe made of the messages after a time, and of the odometry at the end."""
    seen: list[str] = []
    estimator._on_state = lambda state: seen.append(sha(state))
    for message in drive():
        if message.t_ns > after_ns:
            estimator.add(message)
    odometry = estimator.odometry()
    assert odometry is not None
    return [*seen, sha(odometry)]


@pytest.fixture(scope="module")
def cut() -> dict[str, tuple[int, bytes, list[str]]]:
    """Time, snapshot and later states of the uncut run, for each cut."""
    estimator = Estimator.for_vehicle("elevate")
    seen: list[str] = []
    estimator._on_state = lambda state: seen.append(sha(state))
    waiting = dict(CUTS_S)
    taken: dict[str, tuple[int, bytes, int]] = {}
    first = None
    for message in drive():
        t_ns = message.t_ns
        first = t_ns if first is None else first
        for name in [n for n, s in waiting.items() if t_ns > first + s * 1e9]:
            assert estimator.status == name.split()[0]
            taken[name] = (t_ns - 1, estimator.dump(), len(seen))
            del waiting[name]
        estimator.add(message)
    odometry = estimator.odometry()
    assert odometry is not None
    return {k: (t, data, [*seen[n:], sha(odometry)]) for k, (t, data, n) in taken.items()}


_OTHER_PROCESS = """
import importlib.util, json, pathlib, sys
spec = importlib.util.spec_from_file_location("snapshots", sys.argv[1])
tests = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tests)
out = {}
for name, t_ns in json.loads(sys.argv[3]).items():
    data = (pathlib.Path(sys.argv[2]) / name).read_bytes()
    config = tests.Estimator.for_vehicle("elevate").config
    out[name] = tests.later_states(tests.Estimator.restore(config, data), t_ns)
print(json.dumps(out))
"""


def test_another_process_goes_on_with_the_same_bits(
    cut: dict[str, tuple[int, bytes, list[str]]], tmp_path: Path
) -> None:
    """All states after the cut, in start-up, while driving, in an outage and after it."""
    for name, (_, data, _) in cut.items():
        (tmp_path / name).write_bytes(data)
    times = json.dumps({name: t_ns for name, (t_ns, _, _) in cut.items()})
    done = subprocess.run(
        [sys.executable, "-c", _OTHER_PROCESS, __file__, str(tmp_path), times],
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(done.stdout) == {name: later for name, (_, _, later) in cut.items()}
    assert all(len(later) > 20 for _, _, later in cut.values())


def test_a_restored_estimator_dumps_the_same_bytes(cut: dict[str, tuple[int, bytes, list[str]]]) -> None:
    config = Estimator.for_vehicle("elevate").config
    for _, data, _ in cut.values():
        assert Estimator.restore(config, data).dump() == data


def signed(body: bytes) -> bytes:
    return snapshot.MAGIC + hashlib.sha256(body).digest() + body


@pytest.fixture(scope="module")
def data(cut: dict[str, tuple[int, bytes, list[str]]]) -> bytes:
    return cut["aligning"][1]


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (lambda d: b"", "no snapshot"),
        (lambda d: b"\x80\x04pickle" + d, "no snapshot"),
        (lambda d: d[:60], "cut short"),
        (lambda d: d[:-1], "cut short"),
        (lambda d: d[:-9] + bytes([d[-9] ^ 1]) + d[-8:], "check sum"),
        (lambda d: signed((9).to_bytes(8, "little") + b"[" * 100_000), "no JSON"),
        (lambda d: signed((100_000).to_bytes(8, "little") + b"[" * 100_000), "no JSON"),
        (lambda d: signed((2).to_bytes(8, "little") + b"[]"), "no object"),
        (
            lambda d: signed(d[len(snapshot.MAGIC) + 32 :].replace(b'"gtsam":"4', b'"gtsam":"9', 1)),
            "of gtsam 9",
        ),
    ],
)
def test_a_spoilt_file_is_refused_in_words(data: bytes, spoil, match: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError, match=match):
        Estimator.restore(Estimator.for_vehicle("elevate").config, spoil(data))


def test_another_configuration_is_refused(data: bytes) -> None:
    config = Estimator.for_vehicle("elevate").config
    for other in (dataclasses.replace(config, lag_s=6.0), Estimator.for_vehicle("husky").config):
        with pytest.raises(ConfigError, match="another configuration"):
            Estimator.restore(other, data)


def resigned(data: bytes, change) -> bytes:  # type: ignore[no-untyped-def]
    """The file with its tree changed and the check sum made right again."""
    head = len(snapshot.MAGIC) + 40
    length = int.from_bytes(data[head - 8 : head], "little")
    tree = json.loads(data[head : head + length])
    change(tree["state"])
    text = json.dumps(tree, separators=(",", ":")).encode()
    return signed(len(text).to_bytes(8, "little") + text + data[head + length :])


@pytest.mark.parametrize(
    "name", ["os:system", "builtins:eval", "terrafusion.fusion.estimator.snapshot:sys", "x"]
)
def test_a_file_cannot_name_what_is_built(data: bytes, name: str) -> None:
    def change(state: dict) -> None:
        state["parts"]["imu"]["object"] = name

    with pytest.raises(ConfigError, match="no class of an estimator"):
        Estimator.restore(Estimator.for_vehicle("elevate").config, resigned(data, change))


def nodes(tree: object) -> Iterator[tuple[dict | list, str | int]]:
    """Every place of a tree."""
    places = enumerate(tree) if isinstance(tree, list) else tree.items() if isinstance(tree, dict) else ()
    for key, value in places:
        yield tree, key  # type: ignore[misc]
        yield from nodes(value)


@pytest.mark.parametrize("seed", [*range(20), 21, 45, 46])
def test_a_hostile_file_is_refused_or_harmless(cut: dict, seed: int) -> None:  # type: ignore[type-arg]
    """One place of a well-formed file gets something else: one clear error, or an estimator."""
    rng = random.Random(seed)

    def change(state: dict) -> None:
        holder, key = rng.choice(list(nodes(state)))
        odd = [None, -1, 1 << 70, 1e300, "x", [], {}, {"array": ["<f8", [1 << 40], False, 0]}, {"seen": 0}]
        holder[key] = copy.deepcopy(rng.choice(odd))  # type: ignore[index]

    spoilt = resigned(cut["running"][1], change)
    with contextlib.suppress(ConfigError):
        Estimator.restore(Estimator.for_vehicle("elevate").config, spoilt)


def test_a_factor_comes_back_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(*rng.normal(size=3)), rng.normal(size=3))
    noise = gtsam.noiseModel.Diagonal.Sigmas(rng.uniform(0.1, 2.0, 6))
    for factor in (
        gtsam.BetweenFactorPose3(3, 4, pose, noise),
        gtsam.PriorFactorVector(7, rng.normal(size=3), gtsam.noiseModel.Isotropic.Sigma(3, 0.37)),
    ):
        assert factor_from(numbers_of(factor)).serialize() == factor.serialize()


def test_a_factor_with_other_numbers_than_it_has_is_refused() -> None:
    factor = gtsam.PriorFactorVector(7, np.ones(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.37))
    record = numbers_of(factor)
    for changes in (
        {"numbers": record.numbers[:-1]},
        {"numbers": record.numbers * np.nan},
        {"kind": "system"},
        {"keys": [1, 2, 3]},
        {"dim": 1 << 40},
    ):
        with pytest.raises(ConfigError):
            factor_from(dataclasses.replace(record, **changes))


def test_an_estimator_with_an_archive_is_not_dumped() -> None:
    from terrafusion.fusion.graph.chain import Chain

    config = Estimator.for_vehicle("elevate").config
    with pytest.raises(ConfigError, match="batch"):
        Estimator(config, archive=Chain()).dump()
