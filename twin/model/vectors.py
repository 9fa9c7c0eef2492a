"""A vehicle, a soil and the sensors' places as vectors in the order of `physics.layout`."""

import math

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.model.soil import SoilParams
from terrafusion.twin.model.vehicle import Battery, VehicleParams, with_payload


def vehicle_vector(
    vehicle: VehicleParams, *, slope_rad: float = 0.0, aspect_rad: float = 0.0, payload_kg: float = 0.0
) -> Array:
    """Values of `VEHICLE_PARAMETERS`; `aspect_rad` is the direction uphill (0 east, left positive).

    The payload rides at the centre of gravity; see `vehicle.with_payload` for other places.
    """
    vehicle = with_payload(vehicle, payload_kg)
    body, wheel, drive = vehicle.body, vehicle.wheel, vehicle.drive
    battery = vehicle.battery or Battery(drive.supply_v, drive.supply_v, 0.0, 1e6, 1.0)
    downhill = -GRAVITY_MPS2 * math.sin(slope_rad)
    return np.array(
        [
            body.mass_kg, body.yaw_inertia_kgm2, body.wheelbase_m, body.track_m,
            body.cg_forward_m, body.cg_left_m, body.cg_height_m,
            wheel.radius_m, wheel.width_m, wheel.inertia_kgm2,
            drive.gear_ratio, drive.gear_efficiency, drive.no_load_speed_radps, drive.stall_torque_nm,
            drive.torque_limit_nm, drive.supply_v, drive.speed_loop_p_nms, drive.speed_loop_i_nm, drive.lag_s,
            drive.dead_time_s, drive.dead_time_s,
            downhill * math.cos(aspect_rad), downhill * math.sin(aspect_rad),
            GRAVITY_MPS2 * math.cos(slope_rad),
            battery.full_v, battery.empty_v, battery.resistance_ohm, 3600.0 * battery.capacity_wh,
            battery.charge, wheel.grouser_height_m, wheel.grouser_count, drive.no_load_current_a,
        ]
    )  # fmt: skip


def soil_vector(soil: SoilParams) -> Array:
    """Values of `SOIL_PARAMETERS`."""
    return np.array(
        [
            soil.pressure.k_c_n_per_m_n1, soil.pressure.k_phi_n_per_m_n2, soil.pressure.exponent,
            soil.pressure.slip_sinkage, soil.pressure.contact_length_floor_m, soil.shear.cohesion_pa,
            math.tan(soil.shear.friction_angle_rad), soil.shear.shear_modulus_m, soil.shear.friction_cap,
            soil.resistance.rolling, soil.resistance.viscous_ns_per_m, soil.mud.pickup_per_m,
            soil.mud.churn_gain, soil.mud.shed_per_m, soil.mud.torque_nm, soil.mud.sinkage_m,
            soil.passive.unit_weight_n_per_m3, soil.passive.bulldozing, soil.mud.suction_pa,
            soil.pressure.multipass, soil.pressure.skid_sinkage,
        ]
    )  # fmt: skip


def mounting_vector(vehicle: VehicleParams) -> Array:
    """Values of `MOUNTING`."""
    imu, antenna = vehicle.sensors.imu.position_m, vehicle.sensors.gnss.antenna_m
    return np.array([imu[0], imu[1], *antenna])
