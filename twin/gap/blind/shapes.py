"""How each effect of the catalogue enters the plant: one shape as the twin's catalogue has it, one shifted.

A shape turns changes of the plant in proportion to one value e. Laws of the shifted shapes are in no form of
the catalogue; neither are the effects `OUTSIDE`, which a diagnosis can at best call unknown.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

SAME, SHIFTED, OUTSIDE = "same", "shifted", "outside"


@dataclass(frozen=True)
class Shape:
    """One way in which an effect shows.

    Attributes:
        changes: names and gains; changes that end in a pair of axes share a direction that is drawn, see
        `vector`.
        typical: a usual size of e, from which the search for the half-power point starts (assumed).
        most: the largest e the plant is asked for.
        signed: whether e may be negative.
        vector: the two changes are components; e is the length.
    """

    effect: str
    kind: str
    changes: tuple[tuple[str, float], ...]
    typical: float
    most: float
    signed: bool = False
    vector: bool = False

    @property
    def key(self) -> str:
        """`effect/kind`."""
        return f"{self.effect}/{self.kind}"

    def turned(self, value: float, rng: np.random.Generator) -> dict[str, float]:
        """Changes at the size `value`; sign and direction are drawn, always with the same count of draws."""
        sign, angle = (1.0 if rng.uniform() < 0.5 else -1.0), rng.uniform(0.0, 2.0 * math.pi)
        if self.vector:
            (first, gain), (second, gain_2) = self.changes
            return {first: gain * value * math.cos(angle), second: gain_2 * value * math.sin(angle)}
        return {change: gain * value * (sign if self.signed else 1.0) for change, gain in self.changes}


def _both(
    effect: str, same: str, shifted: str, typical: float, most: float, *, signed: bool = False
) -> tuple[Shape, ...]:
    """Two shapes of one change each; `a,b` are the components of a vector."""
    return tuple(
        Shape(
            effect,
            kind,
            tuple((change, 1.0) for change in changes.split(",")),
            typical,
            most,
            signed,
            "," in changes,
        )
        for kind, changes in ((SAME, same), (SHIFTED, shifted))
    )


IN_CATALOGUE: tuple[Shape, ...] = (
    Shape("soil_strength", SAME, (("strength", 1.0),), 0.2, 1.2, True),
    Shape("soil_strength", SHIFTED, (("strength", 0.7), ("bearing", 1.5), ("modulus", -1.0)), 0.2, 1.2, True),
    *_both("slip_sinkage", "sink_linear", "sink_square", 0.5, 5.0),
    *_both("rate_dependent_shear", "rate_log", "rate_power", 0.05, 0.4, signed=False),
    *_both("motion_resistance", "rolling", "rolling_speed", 0.03, 0.3),
    *_both("grousers", "grouser_m", "blade_m", 0.01, 0.05),
    *_both("soil_drift", "drift_travel", "drift_step", 0.3, 1.5, signed=True),
    *_both("multipass_compaction", "rut_soft", "rut_firm", 0.5, 2.5),
    *_both("mud_adhesion", "suction_pa", "tack_pa", 1000.0, 10000.0),
    *_both("lateral_anisotropy", "side_gain", "side_angle", 0.3, 2.0),
    *_both("left_right_friction", "sides", "side_strip", 0.3, 1.5, signed=True),
    *_both("mass", "mass", "mass_high", 0.2, 1.0),
    *_both("cg_lateral", "cg_left_m", "cg_left_slow_m", 0.02, 0.15, signed=True),
    *_both("cg_longitudinal", "cg_forward_m", "cg_forward_slow_m", 0.02, 0.13, signed=True),
    *_both("wheel_radius", "radius", "radius_load", 0.02, 0.2, signed=True),
    *_both("wheel_radius_asymmetry", "radius_sides", "radius_left_grown", 0.01, 0.2, signed=True),
    *_both("track_width", "track", "track_turning", 0.05, 0.4, signed=True),
    *_both("torque_limit", "limit", "limit_foldback", 0.4, 0.9),
    *_both("battery_sag", "sag_ohm", "sag_root", 0.1, 1.0),
    *_both("drivetrain_friction", "coulomb_nm", "stribeck_nm", 0.3, 4.0),
    *_both("backlash", "play_rad", "gap_rad", 0.03, 0.3),
    *_both("dead_time", "late_s", "hold_s", 0.05, 0.8),
    *_both("actuator_lag", "lag_s", "lag_second_s", 0.05, 0.6),
    *_both("encoder_scale", "enc_scale", "enc_scale_speed", 0.02, 0.3, signed=True),
    *_both("encoder_dropout", "enc_loss", "enc_loss_strain", 0.02, 0.5),
    *_both("gyro_bias", "gyro_bias", "gyro_bias_wave", 0.003, 0.1, signed=True),
    *_both("gyro_scale", "gyro_scale", "gyro_cubic", 0.02, 0.3, signed=True),
    *_both("accel_bias", "acc_bias_x,acc_bias_y", "acc_drift_x,acc_drift_y", 0.1, 2.0),
    *_both("imu_yaw_misalignment", "imu_turn", "imu_turn_flex", 0.1, 0.5, signed=True),
    *_both("imu_lever_arm", "imu_x_m,imu_y_m", "imu_flex_x_m,imu_flex_y_m", 0.2, 1.0),
    *_both("vibration_rectification", "rect_x,rect_y", "rect_slow_x,rect_slow_y", 0.1, 2.0),
    *_both("imu_time_offset", "imu_late_s", "imu_late_grown_s", 0.05, 0.5),
    *_both("gnss_latency", "gnss_late_s", "gnss_late_jitter_s", 0.1, 2.0),
    *_both("gnss_lever_arm", "ant_x_m,ant_y_m", "ant_flex_x_m,ant_flex_y_m", 0.1, 2.0),
    Shape("gnss_multipath", SAME, (("mp_sine_e_m", 1.0), ("mp_sine_n_m", 1.0)), 0.1, 10.0, vector=True),
    Shape("gnss_multipath", SHIFTED, (("mp_field_m", 1.0),), 0.1, 10.0),
    *_both("slope", "slope", "slope_wave", 0.02, 0.15, signed=True),
    *_both("cross_slope", "cross", "cross_wave", 0.02, 0.15, signed=True),
    *_both("aerodynamic_drag", "cda_m2", "cda_gust_m2", 1.0, 10.0),
)
"""Two shapes of every effect of the catalogue, in its order."""


def _outside(effect: str, change: str, typical: float, most: float, *, signed: bool = False) -> Shape:
    return Shape(effect, OUTSIDE, ((change, 1.0),), typical, most, signed)


OUT_OF_CATALOGUE: tuple[Shape, ...] = (
    _outside("wheel_wobble", "wobble", 0.02, 0.3),
    _outside("imu_mount_resonance", "ring", 0.3, 5.0),
    _outside("gyro_current_crosstalk", "gyro_crosstalk", 0.002, 0.1, signed=True),
    _outside("hot_brake", "brake_nm", 1.0, 12.0),
    _outside("sloshing_payload", "slosh", 0.1, 0.4),
    _outside("side_gusts", "gust_n", 10.0, 60.0),
    _outside("speed_hunting", "hunting", 0.03, 0.5),
    _outside("encoder_crosstalk", "enc_crosstalk", 0.03, 0.4, signed=True),
)
"""Effects that the catalogue does not hold."""


@functools.cache
def shapes() -> dict[str, Shape]:
    """All shapes by key."""
    return {shape.key: shape for shape in (*IN_CATALOGUE, *OUT_OF_CATALOGUE)}
