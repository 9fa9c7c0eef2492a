"""Strict loading: every error of a file at once, what was meant, and numbers to the bit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrafusion.datasets.core.config import OneOf, Prepared, quantities, refuse, structure
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.quantity import Quantity, Sourced, Switch, Whole, Word


@dataclass(frozen=True)
class Wheel:
    radius_m: Annotated[float, Sourced("m", 0.02, 2.0)]
    slip: Annotated[float, Quantity("", -1.0, 1.0)] = 0.0


@dataclass(frozen=True)
class By:
    start_s: Annotated[float, Quantity("s", 0.0, 10.0)]


@dataclass(frozen=True)
class Robot:
    name: str
    wheel: Wheel
    seed: Annotated[int, Whole("", 0, 9)] = 0
    mode: Annotated[str, Word(("slow", "fast"))] = "slow"
    live: Switch = False
    axes: tuple[str, ...] = ()
    place_m: Annotated[tuple[float, ...], Quantity("m", -5.0, 5.0, size=3)] | None = None
    rows: dict[str, Annotated[float, Quantity("rows", 1.0, 10.0)]] = field(default_factory=dict)
    zones: tuple[Annotated[Any, OneOf(lambda raw: "start_s" in raw, (Wheel, By))], ...] = ()
    spare: Annotated[Wheel, Prepared(lambda raw: {"radius_m": raw}, {})] | None = None

    def __post_init__(self) -> None:
        if self.name == "nobody":
            raise ValueError("nobody is no name")


RADIUS = {"value": 0.2, "source": "data sheet"}
GOOD: dict[str, Any] = {"name": "r", "wheel": {"radius_m": RADIUS}}


def errors(raw: Any, **options: Any) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        structure(Robot, raw, file="r.yaml", **options)
    return str(caught.value).split("\n")


def test_all_errors_of_a_file_are_reported_at_once_a_line_each() -> None:
    raw = {
        "nme": "r", "colour": "red", "wheel": {"radius_mm": RADIUS, "slip": 2.0}, "seed": 1.5,
        "mode": "medium", "live": "yes", "axes": "x", "place_m": [1, 2], "rows": {"imu": 0, "gnss": 5},
        "zones": [{"start_s": -1}],
    }  # fmt: skip
    assert errors(raw) == [
        "r.yaml: unknown key 'wheel.radius_mm'; write 'radius_m' (the unit is part of the name)",
        "r.yaml: unknown key 'nme'; did you mean 'name'? known here: "
        "name, wheel, seed, mode, live, axes, place_m, rows, zones, spare",
        "r.yaml: unknown key 'colour'; known here: "
        "name, wheel, seed, mode, live, axes, place_m, rows, zones, spare",
        "r.yaml: 'wheel.slip' is 2.0, out of range; give a number in [-1, 1]; is the unit right?",
        "r.yaml: 'seed' is 1.5; give a whole number in [0, 9]",
        "r.yaml: 'mode' is 'medium'; give one of slow, fast",
        "r.yaml: 'live' is 'yes'; give true or false",
        "r.yaml: 'axes' is 'x'; give a list",
        "r.yaml: 'place_m' is '[1, 2]'; give 3 numbers in [-5, 5] m",
        "r.yaml: 'rows.imu' is 0, out of range; give a number in [1, 10] rows; is the unit right?",
        "r.yaml: 'zones[0].start_s' is -1, out of range; give a number in [0, 10] s; is the unit right?",
    ]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"wheel": {}},
            "'wheel.radius_m' is missing; add it: {value: a number in [0.02, 2] m, source: where",
        ),
        ({"wheel": 5}, "'wheel' is '5', not a section; give keys from radius_m, slip"),
        (
            {"wheel": {"radius_m": 0.2}},
            "'wheel.radius_m' is '0.2' without a source; write {value: a number in",
        ),
        ({"wheel": {"radius_m": {"value": 0.2}}}, "'wheel.radius_m' has no source"),
        (
            {"wheel": {"radius_m": RADIUS | {"unit": "m"}}},
            "has the unknown entry 'unit' (the unit is",
        ),
        ({"wheel": {"radius_m": RADIUS | {"valid": [0.3, 1]}}}, "is 0.2, outside its validity range"),
        ({"wheel": {"radius_m": RADIUS | {"valid": 3}}}, "'wheel.radius_m.valid' is '3'; give 2 numbers"),
        ({"wheel": {"radius_m": RADIUS, "slip": True}}, "'wheel.slip' is 'True'; give a number in [-1, 1]"),
        ({"wheel": {"radius_m": RADIUS, "slip": "0"}}, "'wheel.slip' is '0'; give a number in [-1, 1]"),
        ({"name": 5}, "'name' is '5'; give a text"),
        ({"name": "nobody"}, "nobody is no name"),
        ({"place_m": None}, "'place_m' has no value; give one, or leave the key out"),
        ({"axes": [1]}, "'axes[0]' is '1'; give a text"),
        ({"rows": [1]}, "'rows' is '[1]', not a section; give a mapping"),
        ({"zones": [{"slip": 0.5}]}, "'zones[0].radius_m' is missing"),
        ({"spare": 3}, "'spare.radius_m' is '3' without a source"),
        ({"seed": 10**5000}, "'seed' is a huge number, out of range"),
        ({"wheel": {"radius_m": RADIUS, "slip": 10**400}}, "out of range"),
        ({"wheel": {"radius_m": RADIUS, "slip": float("nan")}}, "'wheel.slip' is nan, out of range"),
    ],
)
def test_one_error_is_one_line(changes: dict[str, Any], line: str) -> None:
    (told,) = errors(GOOD | changes)
    assert told.startswith("r.yaml: ")
    assert line in told


def test_keys_with_a_default_are_needed_where_a_file_must_be_complete() -> None:
    lines = errors(GOOD, complete=True)
    assert len(lines) == 9
    assert "r.yaml: 'wheel.slip' is missing; add it: a number in [-1, 1]" in lines


def test_at_most_a_hundred_errors_are_written_out() -> None:
    assert len(errors(GOOD | {"rows": {f"r{i}": 0 for i in range(300)}})) == 100


def test_problems_beyond_values_are_lines_too() -> None:
    refuse([], "r.yaml")
    with pytest.raises(ConfigError, match=r"^r.yaml: a; b\nr.yaml: c; d$"):
        refuse([("a", "b"), ("c", "d")], "r.yaml")


@given(st.floats(-1.0, 1.0) | st.integers(-1, 1))
def test_numbers_are_the_same_bits(value: float) -> None:
    found = structure(Robot, GOOD | {"wheel": {"radius_m": RADIUS, "slip": value}}, file="r.yaml")
    assert isinstance(found.wheel.slip, float)
    assert found.wheel.slip.hex() == float(value).hex()


def test_numbers_of_a_class_by_name() -> None:
    assert quantities(Robot) == {
        "wheel.radius_m": Sourced("m", 0.02, 2.0),
        "wheel.slip": Quantity("", -1.0, 1.0),
        "seed": Whole("", 0, 9),
    }
