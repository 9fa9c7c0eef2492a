"""The policy file and the blending of its rows."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.noise.modes import load_modes
from terrafusion.fusion.noise.policy import SCHEMA, Policy, SensorNoise, load_policy
from terrafusion.fusion.terrain.classifier import load_terrain_model

FIELDS = [f.name for f in dataclasses.fields(SensorNoise)]
ZERO_MEAN = [
    name
    for name in FIELDS
    if name
    not in ("slip_mean", "slip_per_grade", "slip_sigma", "slip_time_s", "yaw_scale_mean", "yaw_scale_sigma")
]

ROWS = st.builds(
    SensorNoise,
    slip_mean=st.floats(-1.0, 1.0),
    slip_per_grade=st.floats(-5.0, 5.0),
    slip_sigma=st.floats(1e-3, 1.0),
    slip_time_s=st.floats(0.05, 600.0),
    wheel_sigma_mps=st.floats(1e-3, 2.0),
    side_slip_sigma=st.floats(1e-3, 2.0),
    gyro_inflation=st.floats(1.0, 1e3),
    gyro_yaw_inflation=st.floats(1.0, 1e3),
    accel_inflation=st.floats(1.0, 1e3),
    gnss_inflation=st.floats(1.0, 100.0),
    yaw_scale_mean=st.floats(-0.5, 0.5),
    yaw_scale_sigma=st.floats(1e-3, 1.0),
)


@st.composite
def policies(draw: st.DrawFn) -> tuple[Policy, NDArray[np.float64]]:
    rows = draw(st.lists(ROWS, min_size=1, max_size=6))
    weights = np.array(draw(st.lists(st.floats(1e-3, 1.0), min_size=len(rows), max_size=len(rows))))
    classes = {f"class {i}": row for i, row in enumerate(rows)}
    return Policy(classes, rows[0], inputs_sha256=""), weights / weights.sum()


def column(policy: Policy, name: str) -> NDArray[np.float64]:
    return np.array([getattr(row, name) for row in policy.classes.values()])


@given(policies(), st.floats(-0.3, 0.3))
def test_blend_has_the_moments_of_the_mixture(case: tuple[Policy, NDArray[np.float64]], grade: float) -> None:
    policy, p = case
    row = policy.blend(p, grade)
    # Three-point (Gauss-Hermite) nodes carry mean and variance of each Gaussian exactly:
    # a weighted sample of 3 k points that has the mixture's first two moments.
    nodes, node_weights = np.array([-np.sqrt(3.0), 0.0, np.sqrt(3.0)]), np.array([1.0, 4.0, 1.0]) / 6.0
    w = (p[:, None] * node_weights).ravel()
    means = column(policy, "slip_mean") + grade * column(policy, "slip_per_grade")
    slip = (means[:, None] + column(policy, "slip_sigma")[:, None] * nodes).ravel()
    mean = w @ slip
    assert row.slip_mean + grade * row.slip_per_grade == pytest.approx(mean, rel=1e-12, abs=1e-12)
    assert row.slip_sigma**2 == pytest.approx(w @ (slip - mean) ** 2, rel=1e-12)
    scale = (
        column(policy, "yaw_scale_mean")[:, None] + column(policy, "yaw_scale_sigma")[:, None] * nodes
    ).ravel()
    assert row.yaw_scale_mean == pytest.approx(w @ scale, rel=1e-12, abs=1e-12)
    assert row.yaw_scale_sigma**2 == pytest.approx(w @ (scale - w @ scale) ** 2, rel=1e-12)
    for name in ZERO_MEAN:
        error = (column(policy, name)[:, None] * nodes).ravel()
        assert getattr(row, name) ** 2 == pytest.approx(w @ error**2, rel=1e-12)


@given(policies())
def test_blend_never_claims_more_than_its_classes(case: tuple[Policy, NDArray[np.float64]]) -> None:
    policy, p = case
    row = policy.blend(p)
    means, sigmas = column(policy, "slip_mean"), column(policy, "slip_sigma")
    assert row.slip_sigma**2 >= (p @ sigmas**2) * (1 - 1e-12)
    assert row.slip_sigma**2 >= (p @ (means - p @ means) ** 2) * (1 - 1e-12)
    for name in (*ZERO_MEAN, "slip_time_s"):
        values = column(policy, name)
        assert values.min() * (1 - 1e-12) <= getattr(row, name) <= values.max() * (1 + 1e-12)


@given(policies(), st.data())
def test_a_sure_class_gives_its_row_exactly(
    case: tuple[Policy, NDArray[np.float64]], data: st.DataObject
) -> None:
    policy, p = case
    i = data.draw(st.integers(0, len(p) - 1))
    assert policy.blend(np.eye(len(p))[i]) == list(policy.classes.values())[i]


def test_doubt_between_two_grounds_widens_slip() -> None:
    firm = dataclasses.replace(load_policy().fixed, slip_mean=0.0, slip_sigma=0.01)
    soft = dataclasses.replace(firm, slip_mean=0.4)
    blended = Policy({"firm": firm, "soft": soft}, firm, "").blend([0.5, 0.5])
    assert blended.slip_mean == pytest.approx(0.2)
    assert blended.slip_sigma == pytest.approx(np.hypot(0.2, 0.01))


def test_the_shipped_policy_loads() -> None:
    policy = load_policy()
    assert {"asphalt", "medium_sand", "loose_sand", "mud", "unknown"} == set(policy.names())
    widest = max(row.slip_sigma for name, row in policy.classes.items() if name != "unknown")
    assert policy.classes["unknown"].slip_sigma >= 0.5 * widest


def written(tmp_path: Path, **changes: object) -> Path:
    from ruamel.yaml import YAML

    row = dataclasses.asdict(load_policy().fixed)
    content = {
        "schema": SCHEMA,
        "made_by": "a test",
        "inputs_sha256": "",
        "fixed": row,
        "classes": {"unknown": row},
    }
    content.update(changes)
    path = tmp_path / "policy.yaml"
    with path.open("w", encoding="utf-8") as out:
        YAML().dump({k: v for k, v in content.items() if v is not None}, out)
    return path


def rows_with(**changes: object) -> dict[str, object]:
    row: dict[str, object] = {**dataclasses.asdict(load_policy().fixed), **changes}
    return {name: value for name, value in row.items() if value is not None}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"schema": "terrafusion.policy/9"}, "terrafusion.policy/2"),
        ({"colour": "red"}, "unknown key 'colour'"),
        ({"classes": {"mud": rows_with()}}, "'unknown'"),
        ({"classes": None}, "'classes'"),
        ({"fixed": None}, "'fixed' is missing"),
        ({"fixed": rows_with(slip_sigma=None)}, "slip_sigma"),
        ({"fixed": rows_with(slip_sigma=-0.1)}, "fixed.slip_sigma"),
        ({"fixed": rows_with(gyro_inflation=0.5)}, "fixed.gyro_inflation"),
        ({"classes": {"unknown": rows_with(slip_time_s="long")}}, "classes.unknown.slip_time_s"),
    ],
)
def test_a_wrong_file_is_one_line_that_names_the_key(
    tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    path = written(tmp_path, **changes)
    with pytest.raises(ConfigError) as caught:
        load_policy(path)
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_shipped_files_are_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading YAML took a twentieth of a second each time that an estimator was made."""
    found = load_policy(), load_modes(), load_terrain_model()
    for module in ("noise.policy", "noise.modes", "terrain.classifier"):
        monkeypatch.setattr(f"terrafusion.fusion.{module}.read_yaml", lambda *_: pytest.fail("read again"))
    again = load_policy(), load_modes(), load_terrain_model()
    assert all(one is other for one, other in zip(found, again, strict=True))
