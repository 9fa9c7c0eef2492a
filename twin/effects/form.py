"""An optional effect: a functional form, its parameters, and the stages of the model where it acts.

The model is built in stages (see `STAGES`). At a stage a form's term reads any quantity known there by its
name and gives new values of quantities of that stage. With a parameter of zero a term must return the values
it was given; a graph made without the parameter does not contain the term.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.physics.layout import MOUNTING, OUTPUTS, SOIL_PARAMETERS, VEHICLE_PARAMETERS, WHEELS

Quantities = Mapping[str, Any]
"""What a stage knows, by name: CasADi expressions."""
Term = Callable[..., Quantities]
"""term(quantities by name, *values of the parameters) -> new values of some of the stage's quantities."""

STAGES: dict[str, tuple[str, ...]] = {
    "vehicle": VEHICLE_PARAMETERS,
    "command": (
        *(f"command_{side}_{unit}" for side in ("left", "right") for unit in ("radps", "radps2")),
        *(f"d_command_{kind}_{side}" for kind in ("lag", "delay") for side in ("left", "right")),
    ),
    "supply": ("voltage_share",),
    "loads": ("lean_x_mps2", "lean_y_mps2"),
    "corner": (
        "radius_m", "width_m", "load_n", "hub_forward_m", "hub_left_m", "grouser_height_m", "grouser_count",
        "heading_cos", "heading_sin", "path_share",
    ),
    "ground": (*SOIL_PARAMETERS, "shear_x_m", "shear_y_m", "following"),
    "motor": (
        "command_radps", "loop_speed_radps", "d_play",
        "gear_efficiency", "no_load_radps", "stall_torque_nm", "torque_limit_nm", "loop_p_nms", "loop_i_nm",
        "lag_s",
    ),
    "wheel": (
        "drive_torque_nm", "force_x_n", "force_y_n", "traction_x_n", "traction_y_n", "drag_torque_nm",
        "scrub_nm",
    ),
    "shafts": tuple(f"d_wheel_speed_{name}" for name in WHEELS),
    "body": ("body_force_x_n", "body_force_y_n", "body_moment_nm"),
    "mounting": MOUNTING,
    "measurement": OUTPUTS,
    "stamp": OUTPUTS,
}  # fmt: skip
"""Stages in the order in which they are built, and the quantities a term may set there.

`corner`, `ground`, `motor` and `wheel` are built once a wheel; `loads` knows the wheels' forces on the body
under static loads. In the stage `stamp` the time derivative of an output is known as `d_<output>`.
`heading_cos` and `heading_sin` turn the wheel about z; without them it points along body x.
"""

PLANE = frozenset(
    {"x", "y", "wheel_x_m", "wheel_y_m", "yaw", "cos_yaw", "sin_yaw", "gravity_x_mps2", "gravity_y_mps2"}
)
"""Quantities by which a law depends on place or direction in the plane."""

SENSOR_STAGES = ("mounting", "measurement", "stamp")
"""Stages that change what is measured and not how the robot moves."""


NOMINAL_KG, NOMINAL_RADIUS_M = 32.0, 0.175  # of the vehicle "elevate"


@dataclass(frozen=True)
class Parameter:
    """A number of a form; zero means that its term is absent.

    Attributes:
        unit: "" for a pure number.
        scale: typical size (standard deviation of a prior).
        low, high: closed range of values a run may be made with.
        name: within the form; "" where it is the only one.
        grows: whether size and range are those of a robot of `NOMINAL_KG` on wheels of `NOMINAL_RADIUS_M` and
            grow with the load of a wheel times its radius.
    """

    unit: str
    scale: float
    low: float
    high: float
    name: str = ""
    grows: bool = False

    def sized(self, mass_kg: float, radius_m: float) -> Self:
        """With size and range of a robot of this mass and wheel radius."""
        factor = mass_kg * radius_m / (NOMINAL_KG * NOMINAL_RADIUS_M) if self.grows else 1.0
        numbers = {name: factor * getattr(self, name) for name in ("scale", "low", "high")}
        return replace(self, **numbers)


@dataclass(frozen=True, eq=False)
class Form:
    """One functional form of an effect.

    Attributes:
        effect: contract name, or a name of the user's own.
        name: of this functional form.
        parameters: in the order in which the terms take them.
        terms: what it does at each stage where it acts.
        equation: the law, in words of the docs.
        source: author and year, or "ours" for a phenomenological law.
        candidate: whether a diagnosis tries it without being asked for it by name.
        composite: whether others together do nearly the same, as where one side has changed: a diagnosis
            seeks it in the judged runs alone; references could not tell a column of its own from the others'.
    """

    effect: str
    name: str
    parameters: tuple[Parameter, ...]
    terms: Mapping[str, Term]
    equation: str
    source: str = "ours"
    candidate: bool = True
    composite: bool = False

    def __post_init__(self) -> None:
        unknown = [stage for stage in self.terms if stage not in STAGES]
        if unknown or not self.terms:
            raise ConfigError(
                f"unknown stage '{', '.join(unknown)}'",
                channel=self.key,
                remedy=f"known are {', '.join(STAGES)}",
            )
        for parameter in self.parameters:
            if not parameter.low <= 0.0 <= parameter.high or not parameter.scale > 0.0:
                raise ConfigError("a range must hold zero, a scale be positive", channel=self.key)

    @property
    def key(self) -> str:
        """`effect/form`."""
        return f"{self.effect}/{self.name}"

    def parameter_key(self, parameter: Parameter) -> str:
        """Name of a parameter: `effect/form`, or `effect/form/parameter` where there are several."""
        return f"{self.key}/{parameter.name}" if parameter.name else self.key

    def senses_only(self) -> bool:
        """Whether it leaves the robot's motion as it is."""
        return all(stage in SENSOR_STAGES for stage in self.terms)

    def world_fixed(self) -> bool:
        """Whether how the robot moves under it may depend on where in the plane it is or faces: a term reads
        or sets one of `PLANE`."""
        moving = [term for stage, term in self.terms.items() if stage not in SENSOR_STAGES]
        for side, end in itertools.product((1, -1), repeat=2):  # a term may branch on which wheel it is
            noted = _Recorder(side=side, end=end)
            values = [noted[f"e{i}"] for i in range(len(self.parameters))]
            changed = [name for term in moving for name in term(noted, *values)]
            if not PLANE.isdisjoint([*noted, *changed]):
                return True
        return False


class _Recorder(dict[str, Any]):
    """Quantities that record which of them are read."""

    def __missing__(self, name: str) -> Any:
        import casadi as ca

        self[name] = ca.DM(0.7)
        return self[name]


def one(unit: str, scale: float, low: float, high: float) -> tuple[Parameter, ...]:
    """The parameters of a form that has a single one."""
    return (Parameter(unit, scale, low, high),)


def two(names: tuple[str, str], unit: str, scale: float, limit: float) -> tuple[Parameter, ...]:
    """Two parameters with one unit, scale and range -limit to limit."""
    first, second = names
    return Parameter(unit, scale, -limit, limit, first), Parameter(unit, scale, -limit, limit, second)


def braked(q: Quantities, torque: Any) -> dict[str, Any]:
    """A wheel with a torque against its rotation."""
    return {"drag_torque_nm": q["drag_torque_nm"] + torque}


SIDES_BY_NAME = {"left": 1, "right": -1}


def on_side(side: int, term: Term) -> Term:
    """A term on the wheels of one side alone: 1 left, -1 right."""
    return lambda q, *values: term(q, *values) if q["side"] == side else {}


def turning_beside(q: Quantities, e: Any) -> dict[str, Any]:
    """A body that turns about a point e to the right of its middle: the side with more load or grip slips
    less. All sensors move as if they sat e further left."""
    return {name: q[name] + e for name in ("imu_y_m", "antenna_y_m")}
