"""Names and order of the model's states, inputs and parameters.

Nothing else knows a position in these vectors: look entries up by name.
"""

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
"""Order of the wheels in every array."""
ENDS, SIDES = (1, 1, -1, -1), (1, -1, 1, -1)
"""Front (1) or rear, left (1) or right, in the order of `WHEELS`."""

ENERGIES = ("motor_work", "electric_energy", "slip_work", "resistance_work")
"""States that sum up energies, J; only the battery's charge depends on them."""

STATES = (
    "x", "y", "yaw", "u", "v", "r",
    *(f"wheel_speed_{w}" for w in WHEELS),
    *(f"shear_x_{w}" for w in WHEELS),
    *(f"shear_y_{w}" for w in WHEELS),
    *(f"torque_{w}" for w in WHEELS),
    *(f"speed_error_{w}" for w in WHEELS),
    *(f"brake_{w}" for w in WHEELS),
    *(f"wheel_angle_{w}" for w in WHEELS),
    "clog", "travel", *ENERGIES,
    "elapsed",
    *(f"command_{kind}_{side}" for kind in ("lag", "delay") for side in ("left", "right")),
    *(f"play_{w}" for w in WHEELS),
    "sag_current",
)  # fmt: skip
"""State names: m, rad, m/s, rad/s, N m (`torque`, at the wheel), rad (`speed_error`, integrated), J.

`shear_x`, `shear_y` and `brake` are displacements of the soil and of the rim's
friction bristle (m), `travel` the path driven forward (m), `clog` from 0 to 1.
Energies are sums from the start: `motor_work` at the wheels, `electric_energy` taken from the
battery's store, `slip_work` spent in the slip of the wheels and `resistance_work` in all that
resists motion between motor and body.
`sag_current` is the battery's smoothed current (A). The others of the last rows serve optional effects:
`elapsed` is the time driven (s); at rest where the effect is absent are `command_lag` and
`command_delay`, the filtered rate of a side's command (rad/s2), and `play`, where a gear stands in its
backlash (-1 to 1).
"""

INPUTS = (
    "left_radps", "right_radps", "left_rate_radps2", "right_rate_radps2", "steer_front_rad", "steer_rear_rad",
)  # fmt: skip
"""Commanded wheel speeds of the sides, rad/s, their derivatives (see `commands.delayed_inputs`), and angles
of the axles (bicycle model, positive to the left), which only steered vehicles have."""

VEHICLE_PARAMETERS = (
    "mass_kg", "yaw_inertia_kgm2", "wheelbase_m", "track_m", "cg_forward_m", "cg_left_m", "cg_height_m",
    "radius_m", "width_m", "wheel_inertia_kgm2", "gear_ratio", "gear_efficiency", "no_load_radps",
    "stall_torque_nm", "torque_limit_nm", "supply_v", "loop_p_nms", "loop_i_nm", "lag_s",
    "dead_time_s", "dead_time_applied_s",
    "gravity_x_mps2", "gravity_y_mps2", "gravity_normal_mps2",
    "battery_full_v", "battery_empty_v", "battery_ohm", "battery_j", "battery_charge",
    "grouser_height_m", "grouser_count",
    "no_load_a",
)  # fmt: skip
"""Parameters that hold for a whole run; gravity is given along the plane's x and y and into it.

The inputs are delayed by `dead_time_applied_s` already; the graph adds the first-order term of
`dead_time_s - dead_time_applied_s`, which is zero, with the right derivative by `dead_time_s`.
"""

SOIL_PARAMETERS = (
    "k_c", "k_phi", "exponent", "slip_sinkage", "contact_floor_m", "cohesion_pa", "tan_friction",
    "shear_modulus_m", "friction_cap", "rolling", "viscous_ns_per_m", "pickup_per_m", "churn_gain",
    "shed_per_m", "clog_torque_nm", "clog_sinkage_m",
    "unit_weight_n_per_m3", "bulldozing", "suction_pa", "multipass", "skid_sinkage",
)  # fmt: skip
"""Parameters of the ground under one wheel; the graph takes them once a wheel, in the order of `WHEELS`."""

OUTPUTS = (
    "wheel_left_radps", "wheel_right_radps", "yaw_rate_radps", "accel_x_mps2", "accel_y_mps2",
    "gnss_east_m", "gnss_north_m", "gnss_v_e_mps", "gnss_v_n_mps", "current_left_a", "current_right_a",
    "speed_mps", "side_speed_mps",
)  # fmt: skip
"""What can be measured: mean wheel speed of a side, specific force at the IMU along body x and y, position
and horizontal velocity of the antenna in the world, current of a side (two motors), velocity of the body
origin along body x and y."""

MOUNTING = ("imu_x_m", "imu_y_m", "antenna_x_m", "antenna_y_m", "antenna_z_m")
"""Where the sensors sit, from the body origin, body axes."""

INDEX = {name: i for i, name in enumerate(STATES)}


def state_slice(prefix: str) -> slice:
    """The four wheels' entries of a state, e.g. `state_slice("wheel_speed")`."""
    first = INDEX[f"{prefix}_{WHEELS[0]}"]
    return slice(first, first + 4)
