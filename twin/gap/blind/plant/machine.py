"""The robot in motion: slow laws every frame, linearly implicit dynamics in between.

Wheels are in the order front left, front right, rear left, rear right; arrays (4, B) or (B,), SI units.
`u`, `v`, `r` are velocity of the centre of gravity in body axes and yaw rate. Every slip force is F+ = a F
+ (1 - a) C v_s+ with the secant C = |F| / |v_s| of its law at the old slip velocity and a = 1 / (1 + h V /
sigma) from the relaxation length sigma; drag, braking torque and speed loop are secants too. So a step is a
linear system: wheel speeds are eliminated, three equations of the body remain.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from terrafusion.datasets.core.frames import GRAVITY_MPS2
from terrafusion.twin.gap.blind.plant import contact as law
from terrafusion.twin.gap.blind.plant.field import PlantSoilField

Array = NDArray[np.float64]

SIDES = np.array([1.0, -1.0, 1.0, -1.0])[:, None]
ENDS = np.array([1.0, 1.0, -1.0, -1.0])[:, None]
TRANSFER_S = 0.05  # time constant with which loads follow the body's acceleration
SUPPLY_S = 0.05  # time constant of the battery's current
DRAG_MPS, BRAKE_RADPS, PLAY_S = 0.02, 0.05, 0.03
AIR_KG_PER_M3 = 1.2
WHEEL_STATES = ("speed", "angle", "torque", "integral", "force_x", "force_y", "play")
BODY_STATES = ("x", "y", "z", "yaw", "u", "v", "r", "travel", "lean_x", "lean_y", "heat", "motor_work")


class Machine:
    """State and laws of B runs. `step` advances a frame; `frame` holds what the slow laws gave last."""

    def __init__(self, n: dict[str, Any], patches: PlantSoilField, gust_n: Array | None = None) -> None:
        self.n, self.patches, self._gust_n = dict(n), patches, gust_n
        runs = len(n["mass_kg"])
        self.s: dict[str, Array] = {name: np.zeros(runs) for name in BODY_STATES}
        self.s |= {name: np.zeros((4, runs)) for name in WHEEL_STATES}
        self.s["yaw"] = n["heading_rad"].copy()
        self.s |= {"drawn_a": np.zeros(runs), "supply_v": n["open_v"].copy()}  # the battery's
        self.s["slosh"] = np.zeros((4, runs))  # displacement and velocity of a swinging load, body x and y
        self.t_s = 0.0
        self.frame: dict[str, Any] = {}
        integrals = np.array([law.stress_integrals(float(e)) for e in n["exponent"]])
        self.n["stress_vertical"], self.n["stress_along"] = integrals[:, 0], integrals[:, 1]

    def step(self, sides: Array, frame_s: float, substeps: int) -> None:
        """A frame of `frame_s` with commanded wheel speeds (2, 2, B) at its start and end."""
        self.frame = self._slow(frame_s)
        h = frame_s / substeps
        u0, v0 = self.s["u"], self.s["v"]
        for k in range(substeps):
            command = sides[0] + (sides[1] - sides[0]) * ((k + 1.0) / substeps)
            self._fast(np.concatenate([command, command]), h)
        self._lean((self.s["u"] - u0) / frame_s, (self.s["v"] - v0) / frame_s, frame_s)
        self.t_s += frame_s

    def energy_j(self) -> Array:
        """Kinetic energy of body and wheels, J."""
        s, f = self.s, self.frame
        body = 0.5 * f["mass"] * (s["u"] ** 2 + s["v"] ** 2) + 0.5 * f["inertia"] * s["r"] ** 2
        return np.asarray(body + 0.5 * self.n["wheel_inertia_kgm2"] * (s["speed"] ** 2).sum(axis=0))

    def _lean(self, rate_u: Array, rate_v: Array, frame_s: float) -> None:
        s = self.s
        share = frame_s / (frame_s + TRANSFER_S)
        s["lean_x"] = s["lean_x"] + share * (rate_u - s["r"] * s["v"] - s["lean_x"])
        s["lean_y"] = s["lean_y"] + share * (rate_v + s["r"] * s["u"] - s["lean_y"])

    # slow laws

    def _slow(self, frame_s: float) -> dict[str, Any]:
        f = self._body_numbers()
        f |= self._corners(f)
        f |= self._footprints(f)
        f |= self._strengths(f)
        f |= self._drags(f)
        f |= self._supply(frame_s)
        f |= self._outer_forces(f, frame_s)
        return f

    def _body_numbers(self) -> dict[str, Any]:
        """Masses, geometry and gravity as they are now."""
        n, s = self.n, self.s
        mass = n["mass_kg"] * (1.0 + n["change_mass"] + n["change_mass_high"])
        inertia = n["inertia_kgm2"] * (1.0 + n["change_mass"] + 0.5 * n["change_mass_high"])
        slowly = 1.0 - np.exp(-self.t_s / 15.0)
        forward = n["cg_forward_m"] + n["change_cg_forward_m"] + n["change_cg_forward_slow_m"] * slowly
        left = n["cg_left_m"] + n["change_cg_left_m"] + n["change_cg_left_slow_m"] * slowly
        rise_x = n["change_slope"] + n["change_slope_wave"] * (1.0 + 0.6 * np.sin(s["x"] / 6.0))
        rise_y = n["change_cross"] + n["change_cross_wave"] * (1.0 + 0.6 * np.sin(s["y"] / 6.0))
        normal = GRAVITY_MPS2 / np.sqrt(1.0 + np.tan(rise_x) ** 2 + np.tan(rise_y) ** 2)
        pull_x, pull_y = -np.tan(rise_x) * normal, -np.tan(rise_y) * normal
        cos, sin = np.cos(s["yaw"]), np.sin(s["yaw"])
        return {
            "mass": mass * (1.0 - n["change_slosh"]), "weight": mass * normal, "inertia": inertia,
            "cg_forward": forward, "cg_left": left, "normal": normal,
            "cg_height": n["cg_height_m"] + 0.3 * n["change_mass_high"],
            "pull_u": cos * pull_x + sin * pull_y, "pull_v": -sin * pull_x + cos * pull_y,
            "rise_x": np.tan(rise_x), "rise_y": np.tan(rise_y), "cos": cos, "sin": sin,
        }  # fmt: skip

    def _corners(self, f: dict[str, Any]) -> dict[str, Any]:
        """Place, load and radius of each wheel; where it is in the world."""
        n, s = self.n, self.s
        turning = np.abs(s["r"]) / (np.abs(s["r"]) + 0.3)
        track = n["track_m"] * (1.0 + n["change_track"] + 1.5 * n["change_track_turning"] * turning)
        arm_x, arm_y = 0.5 * ENDS * n["wheelbase_m"] - f["cg_forward"], 0.5 * SIDES * track - f["cg_left"]
        height = f["cg_height"] / f["normal"]
        lean_x = (f["cg_forward"] + height * (f["pull_u"] - s["lean_x"])) / n["wheelbase_m"]
        lean_y = (f["cg_left"] + height * (f["pull_v"] - s["lean_y"])) / track
        load = np.maximum(f["weight"] * (0.5 + ENDS * lean_x) * (0.5 + SIDES * lean_y), 1.0)
        gain = 1.0 + n["change_radius"] + 0.5 * SIDES * n["change_radius_sides"]
        gain = gain + n["change_radius_load"] * (load / (0.25 * n["mass_kg"] * GRAVITY_MPS2)) ** 2
        gain = gain + n["change_radius_left_grown"] * (SIDES > 0) * (1.0 - np.exp(-np.abs(s["travel"]) / 8.0))
        first = (SIDES + ENDS) > 1.0
        gain = gain + n["change_wobble"] * first * np.sin(s["angle"])
        ahead, aside = arm_x + f["cg_forward"], arm_y + f["cg_left"]
        return {
            "arm_x": arm_x, "arm_y": arm_y, "load": load,
            "radius": n["radius_m"] * gain + 0.25 * n["change_blade_m"],
            "place_x": s["x"] + f["cos"] * ahead - f["sin"] * aside,
            "place_y": s["y"] + f["sin"] * ahead + f["cos"] * aside,
        }  # fmt: skip

    def _footprints(self, f: dict[str, Any]) -> dict[str, Any]:
        """Sinkage, contact length and slip of each wheel, and how far it follows in a rut."""
        n, s = self.n, self.s
        soil = self.patches.at(f["place_x"], f["place_y"])
        hub_u, hub_v = s["u"] - s["r"] * f["arm_y"], s["v"] + s["r"] * f["arm_x"]
        rim = s["speed"] * f["radius"]
        ground = np.hypot(hub_u, hub_v)
        transport = np.maximum(np.abs(rim), ground)
        driven = np.clip((rim - hub_u) * np.sign(rim) / (transport + 0.02), 0.0, 1.0)
        skid = np.clip((ground**2 - rim * hub_u) / (ground**2 + 4e-4), 0.0, 2.0)
        behind = 0.5 * (1.0 - ENDS * s["u"] / (np.abs(s["u"]) + 0.05))
        side = s["v"] - s["r"] * f["cg_forward"]  # midway between the axles
        apart = n["wheelbase_m"] * side / ((np.abs(s["u"]) + 0.05) * n["width_m"])
        follows = behind * np.exp(-2.0 * apart * apart)

        stiffness = n["stiffness"] * np.exp(soil[1] + n["change_bearing"])
        sunk = law.static_sinkage(f["load"], n, f["radius"], stiffness)
        sunk = sunk * (1.0 - follows * (1.0 - (1.0 - n["multipass"]) * np.exp(-n["change_rut_soft"])))
        grown = np.where(n["digs"] > 0.0, law.lyasko(driven), 1.0) * law.skidded(skid, n["skid_sinkage"])
        grown = (grown + n["change_sink_linear"] * driven) * np.exp(n["change_sink_square"] * driven * driven)
        sunk = np.minimum(sunk * grown, 0.8 * f["radius"])
        chord = np.sqrt(2.0 * f["radius"] * sunk - sunk * sunk + n["patch_m"] ** 2)
        return {"soil": soil, "sunk": sunk, "chord": chord, "skid": skid, "follows": follows,
                "rim": rim, "hub_u": hub_u, "hub_v": hub_v}  # fmt: skip

    def _strengths(self, f: dict[str, Any]) -> dict[str, Any]:
        """Shear strength and modulus under each wheel."""
        n, s = self.n, self.s
        slip_speed = np.hypot(f["rim"] - f["hub_u"], f["hub_v"])
        travel, e = (
            s["travel"],
            n["change_side_strip"] * (1.0 + 0.6 * np.sin(s["travel"] / 5.0)) + n["change_sides"],
        )
        log_gain = f["soil"][0] + n["change_strength"] + 0.5 * SIDES * e
        log_gain = log_gain + n["change_drift_travel"] * travel / np.sqrt(travel**2 + 2500.0)
        log_gain = log_gain + n["change_drift_step"] / (
            1.0 + np.exp(np.clip(-(travel - 15.0) / 3.0, -60.0, 60.0))
        )
        log_gain = log_gain + 0.5 * n["change_rut_firm"] * f["follows"]
        gain = np.exp(log_gain) * (1.0 + n["change_rate_log"] * np.log1p(slip_speed / 0.01))
        gain = np.maximum(gain * (1.0 + slip_speed / 0.02) ** n["change_rate_power"], 0.02)
        q = (n["grouser_m"] + n["change_grouser_m"] + n["change_blade_m"]) / n["width_m"]
        cohesive, frictional = 1.0 + 2.0 * q, 1.0 + 0.64 * q * np.arctan2(1.0, np.maximum(q, 1e-9))
        mohr = (
            n["cohesion_pa"] * n["width_m"] * f["chord"] * cohesive
            + f["load"] * n["tan_friction"] * frictional
        )
        cap = (
            n["cap"] * f["load"] * (1.0 + np.where(q > n["grouser_m"] / n["width_m"], frictional - 1.0, 0.0))
        )
        strength = law.joined(mohr * gain, cap * gain)
        modulus = n["modulus_m"] * np.exp(
            f["soil"][2] + n["change_modulus"] - 0.5 * n["change_rut_firm"] * f["follows"]
        )
        front, side = law.passive_sides(n, f["sunk"], f["chord"])
        return {"strength": strength, "modulus": law.hump_modulus(modulus, strength, mohr * gain),
                "shear_scale": modulus, "front": front, "side": side, "gain": gain}  # fmt: skip

    def _drags(self, f: dict[str, Any]) -> dict[str, Any]:
        """Drag secant of each hub, N s/m, and braking torque of each wheel, N m."""
        n, s = self.n, self.s
        speed = np.hypot(f["hub_u"], f["hub_v"]) + DRAG_MPS
        pushed = law.compaction_drag(f["load"], f["sunk"], n, f["radius"])
        drag = (pushed + f["front"] * np.minimum(f["skid"], 1.0)) / speed + n["viscous"]
        share = n["rolling"] * n["drag_gain"] + n["change_rolling"]
        share = share + n["change_rolling_speed"] * (0.5 + np.abs(s["u"]) ** 1.5)
        spin = np.abs(s["speed"])
        brake = share * f["load"] * f["radius"] + n["change_coulomb_nm"]
        brake = brake + n["change_stribeck_nm"] * (0.6 + 0.8 * np.exp(-((spin / 2.0) ** 2)))
        tacky = 1.0 - np.exp(-np.abs(s["travel"]) / 8.0)
        clings = n["change_suction_pa"] + n["change_tack_pa"] * tacky * np.sqrt(0.5 + np.abs(s["u"]))
        brake = brake + 0.5 * clings * n["width_m"] * f["chord"] ** 2
        last = (SIDES + ENDS) < -1.0
        hot = n["change_brake_nm"] * (0.2 + 0.8 * (1.0 - np.exp(-s["heat"] / 300.0)))
        return {"drag": drag, "brake": brake + hot * last, "brake_hot": hot}

    def _supply(self, frame_s: float) -> dict[str, Any]:
        """Battery voltage over the motors' nominal one, and each motor's current, A.

        The bridges draw power: the battery's current is that over its voltage, not the motors' current, and
        what a braking motor gives back is burnt. Capacitors smooth it.
        """
        n, s = self.n, self.s
        current = motor_current(n, s["torque"], s["speed"])
        power = np.maximum(motor_volts(n, current, s["speed"]) * current, 0.0).sum(axis=0)
        drawn = s["drawn_a"] = s["drawn_a"] + frame_s / (frame_s + SUPPLY_S) * (
            power / s["supply_v"] - s["drawn_a"]
        )
        volts = n["open_v"] - (n["inner_ohm"] + n["change_sag_ohm"]) * drawn
        volts = volts - n["change_sag_root"] * np.sqrt(5.0 * drawn)
        s["supply_v"] = np.maximum(volts, 0.3 * n["supply_v"])
        return {"current": current, "supply": s["supply_v"] / n["supply_v"]}

    def _outer_forces(self, f: dict[str, Any], frame_s: float) -> dict[str, Any]:
        """Air, gusts and a load that swings, N, body axes."""
        n, s = self.n, self.s
        push = 0.5 * AIR_KG_PER_M3 * n["change_cda_m2"] * np.hypot(s["u"], s["v"])
        force_u, force_v = -push * s["u"], -push * s["v"]
        wind = 3.0 + 1.5 * np.sin(2.0 * np.pi * self.t_s / 12.0)
        air_u, air_v = wind * f["cos"] - s["u"], -wind * f["sin"] - s["v"]
        push = 0.5 * AIR_KG_PER_M3 * n["change_cda_gust_m2"] * np.hypot(air_u, air_v)
        force_u, force_v = force_u + push * air_u, force_v + push * air_v
        if self._gust_n is not None:
            force_v = force_v + self._gust_n[min(round(self.t_s / frame_s), len(self._gust_n) - 1)]
        if n["change_slosh"].any():
            swing_u, swing_v = self._slosh(frame_s)
            force_u, force_v = force_u + swing_u, force_v + swing_v
        return {"force_u": force_u, "force_v": force_v}

    def _slosh(self, frame_s: float) -> tuple[Array, Array]:
        """Force of the swinging share of the mass on the body; it is integrated here, semi-implicitly."""
        n, s = self.n, self.s
        swing, pace = s["slosh"], 2.0 * np.pi * 0.8
        pull = pace * pace * swing[:2] + 2.0 * 0.08 * pace * swing[2:]
        speed = swing[2:] - frame_s * (pull + np.stack([s["lean_x"], s["lean_y"]]))
        s["slosh"] = np.concatenate([swing[:2] + frame_s * speed, speed])
        mass = n["change_slosh"] * n["mass_kg"]
        return mass * pull[0], mass * pull[1]

    # fast dynamics

    def _fast(self, command: Array, h: float) -> None:
        """One linearly implicit step."""
        s, f = self.s, self.frame
        u, v = _rotated(s["u"], s["v"], -s["r"] * h)
        keep, slip, side = self._slip_secants(u, v, h)
        carried, (torque_0, torque_per_speed) = keep * s["force_x"], self._torque_line(command, h)
        # While the gear crosses its gap, half of the torque does not arrive.
        arriving = 1.0 - 0.5 * (self.n["change_gap_rad"] > 0.0) * (1.0 - s["play"] ** 2)
        radius, inertia_h = f["radius"], self.n["wheel_inertia_kgm2"] / h
        spin_drag = f["brake"] / (np.abs(s["speed"]) + BRAKE_RADPS)
        divisor = inertia_h + arriving * torque_per_speed + slip * radius * radius + spin_drag
        alpha = (inertia_h * s["speed"] + arriving * torque_0 - radius * carried) / divisor
        beta = slip * radius / divisor
        # Along x the wheel gives carried + slip (R w+ - u+), with w+ = alpha + beta u+; y: push - side v+.
        push_x, secant_x = carried + slip * radius * alpha, slip * (1.0 - radius * beta) + f["drag"]
        push_y, secant_y = keep * s["force_y"], side + f["drag"]
        new_u, new_v, new_r = self._body(u, v, (push_x, secant_x), (push_y, secant_y), h)
        hub_u, hub_v = new_u - new_r * f["arm_y"], new_v + new_r * f["arm_x"]
        speed = alpha + beta * hub_u
        s["force_x"] = carried + slip * (radius * speed - hub_u)
        s["force_y"] = push_y - side * hub_v
        s["torque"] = torque_0 - torque_per_speed * speed
        error = command - speed
        s["integral"] = s["integral"] + h * np.where(self._clipped * error > 0.0, 0.0, error)
        s["motor_work"] = s["motor_work"] + h * (arriving * s["torque"] * speed).sum(axis=0)
        s["heat"] = s["heat"] + h * f["brake_hot"] * np.abs(speed[3])
        s["speed"], s["angle"] = speed, s["angle"] + h * speed
        self._played(h)
        self._moved(new_u, new_v, new_r, h)

    def _slip_secants(self, u: Array, v: Array, h: float) -> tuple[Array, Array, Array]:
        """Share of the old slip force that remains, and the new share's secants along x and y, N s/m."""
        n, s, f = self.n, self.s, self.frame
        hub_u, hub_v = u - s["r"] * f["arm_y"], v + s["r"] * f["arm_x"]
        rim = s["speed"] * f["radius"]
        slip_square = (rim - hub_u) ** 2 + hub_v * hub_v
        transport = np.maximum(np.abs(rim), np.sqrt(hub_u * hub_u + hub_v * hub_v)) + law.REST_MPS
        per_slip = f["chord"] / (transport * f["modulus"])
        share = law.mean_shear_over_share(np.sqrt(slip_square) * per_slip)
        secant = f["strength"] * share * per_slip
        keep = 1.0 / (1.0 + h * transport / (law.RELAXATION_SHARE * f["chord"]))
        across = hub_v * hub_v / (slip_square + 1e-8)
        side = secant * (1.0 + n["change_side_gain"] + 1.5 * n["change_side_angle"] * across)
        wall = f["side"] / (np.abs(hub_v) + 2.0 * f["shear_scale"] * transport / f["chord"])
        return keep, (1.0 - keep) * secant, (1.0 - keep) * (side + wall)

    def _torque_line(self, command: Array, h: float) -> tuple[Array, Array]:
        """Torque at the wheel as a line of its new speed: T+ = first - second w+."""
        n, s, f = self.n, self.s, self.frame
        at_wheel = n["ratio"] * n["efficiency"]
        relative = s["speed"] * n["ratio"] / n["no_load_radps"]
        cut = n["change_limit"] + n["change_limit_foldback"] * (0.6 + 0.8 * relative * relative)
        limit, stall = n["limit_nm"] * at_wheel * np.maximum(1.0 - cut, 0.02), n["stall_nm"] * at_wheel
        upper = np.minimum(limit, stall * (f["supply"] - relative))
        lower = -np.minimum(limit, stall * (f["supply"] + relative))
        loop = n["loop_p"] * command + n["loop_i"] * s["integral"]
        asked = loop - n["loop_p"] * s["speed"]
        self._clipped = 1.0 * (asked > upper) - 1.0 * (asked < lower)
        lag = n["lag_s"] + n["change_lag_s"]
        held = lag / (lag + h)
        clipped = self._clipped != 0.0
        line = np.where(clipped, np.clip(asked, lower, upper), loop)
        return held * s["torque"] + (1.0 - held) * line, np.where(clipped, 0.0, (1.0 - held) * n["loop_p"])

    def _body(
        self, u: Array, v: Array, along: tuple[Array, Array], across: tuple[Array, Array], h: float
    ) -> tuple[Array, Array, Array]:
        """New velocities: mass matrix over h plus the wheels' secants, solved in closed form."""
        s, f = self.s, self.frame
        (push_x, secant_x), (push_y, secant_y) = along, across
        arm_x, arm_y, mass_h, inertia_h = f["arm_x"], f["arm_y"], f["mass"] / h, f["inertia"] / h
        right_u = mass_h * u + f["mass"] * f["pull_u"] + f["force_u"] + push_x.sum(axis=0)
        right_v = mass_h * v + f["mass"] * f["pull_v"] + f["force_v"] + push_y.sum(axis=0)
        right_r = inertia_h * s["r"] + (arm_x * push_y - arm_y * push_x).sum(axis=0)
        m_uu, m_vv = mass_h + secant_x.sum(axis=0), mass_h + secant_y.sum(axis=0)
        m_ur, m_vr = -(secant_x * arm_y).sum(axis=0), (secant_y * arm_x).sum(axis=0)
        m_rr = inertia_h + (secant_x * arm_y * arm_y + secant_y * arm_x * arm_x).sum(axis=0)
        r = (right_r - m_ur / m_uu * right_u - m_vr / m_vv * right_v) / (
            m_rr - m_ur**2 / m_uu - m_vr**2 / m_vv
        )
        return (right_u - m_ur * r) / m_uu, (right_v - m_vr * r) / m_vv, r

    def _played(self, h: float) -> None:
        """Which flank of the gear carries, -1 to 1."""
        n, s = self.n, self.s
        smooth = s["play"] + h / (h + PLAY_S) * (np.tanh(s["torque"] / 0.3) - s["play"])
        goal = np.where(np.abs(s["torque"]) > 0.3, np.sign(s["torque"]), s["play"])
        most = 2.0 * h / np.maximum(n["change_gap_rad"], 1e-6)
        stepped = s["play"] + np.clip(goal - s["play"], -most, most)
        s["play"] = np.where(n["change_gap_rad"] > 0.0, stepped, smooth)

    def _moved(self, u: Array, v: Array, r: Array, h: float) -> None:
        s, f = self.s, self.frame
        yaw = s["yaw"] + 0.5 * h * r
        origin_u, origin_v = u + r * f["cg_left"], v - r * f["cg_forward"]
        cos, sin = np.cos(yaw), np.sin(yaw)
        step_x, step_y = h * (cos * origin_u - sin * origin_v), h * (sin * origin_u + cos * origin_v)
        s["x"], s["y"], s["yaw"] = s["x"] + step_x, s["y"] + step_y, s["yaw"] + h * r
        s["z"] = s["z"] + f["rise_x"] * step_x + f["rise_y"] * step_y
        s["u"], s["v"], s["r"], s["travel"] = u, v, r, s["travel"] + h * origin_u


def motor_current(n: dict[str, Any], torque: Array, speed: Array) -> Array:
    """Current of each motor, A: torque over its constant, the gears' loss on the side the power comes
    from."""
    forward = np.tanh(torque * speed / 0.3)
    loss = np.where(forward > 0.0, 1.0 + forward * (1.0 / n["efficiency"] - 1.0),
                    1.0 + forward * (1.0 - n["efficiency"]))  # fmt: skip
    constant = n["supply_v"] / n["no_load_radps"]
    idle = n["no_load_a"] * np.tanh(speed / 0.1)
    return np.asarray(torque / n["ratio"] / constant * loss + idle)


def motor_volts(n: dict[str, Any], current: Array, speed: Array) -> Array:
    """Voltage at each motor, V: over its winding, and what its turning makes."""
    constant = n["supply_v"] / n["no_load_radps"]
    winding_ohm = n["supply_v"] * constant / n["stall_nm"]
    return np.asarray(winding_ohm * current + constant * n["ratio"] * speed)


def _rotated(u: Array, v: Array, angle: Array) -> tuple[Array, Array]:
    """Velocity in axes that have turned by -`angle` since: exact, so that turning makes no energy."""
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * u - sin * v, sin * u + cos * v
