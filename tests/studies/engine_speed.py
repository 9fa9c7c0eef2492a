"""How fast the twin is, beside other ways to integrate the same drive.

`python -m tests.studies.engine_speed` prints one table: 300 s of motion, 1000 runs of 60 s on two threads,
the Jacobian by 10 parameters, CasADi's virtual machine, SciPy's solvers on the same right-hand side at equal
accuracy, and MuJoCo with a body of the same measures on rigid ground. What is not installed is left out and
said. Each figure is the best of several tries; where other work shares the machine, the processor's time
tells more than the clock's.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from terrafusion.twin.engine.compiler import find_compiler
from terrafusion.twin.engine.integrate import compiled, integrate
from terrafusion.twin.engine.lanes import integrate_many
from terrafusion.twin.engine.sensitivity import Directions, integrate_with_sensitivity
from terrafusion.twin.model.library import known_names
from terrafusion.twin.model.plant import Plant, RouteTable
from terrafusion.twin.model.soil import load_soil
from terrafusion.twin.model.vectors import soil_vector, vehicle_vector
from terrafusion.twin.model.vehicle import load_vehicle
from terrafusion.twin.physics.layout import SOIL_PARAMETERS, STATES, VEHICLE_PARAMETERS
from terrafusion.twin.scenario.commands import delayed_inputs

Array = NDArray[np.float64]

DT_S = 0.01
RUN_S, BATCH_S, BATCH_RUNS, OTHERS_S = 300.0, 60.0, 1000, 10.0
JOBS = 2
VEHICLE_DIRECTIONS = ("mass_kg", "radius_m", "track_m", "lag_s", "loop_p_nms")
SOIL_DIRECTIONS = ("k_phi", "exponent", "shear_modulus_m", "friction_cap", "rolling")
MUJOCO_STEP_S = 0.002
_EVERY = 10


class Took(NamedTuple):
    """Shortest time by the clock and shortest time of the processors, s."""

    wall_s: float
    cpu_s: float


def best(repeats: int, work: Callable[[], object]) -> Took:
    """The shortest of several tries."""
    walls, cpus = [], []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return Took(min(walls), min(cpus))


@dataclass(frozen=True)
class Line:
    """A row of the table: what ran, how much motion it computed, how long it took, and a remark."""

    what: str
    simulated_s: float
    took: Took
    remark: str = ""

    def __str__(self) -> str:
        speed = self.simulated_s / self.took.wall_s
        times = f"{self.took.wall_s:9.3f} s {self.took.cpu_s:9.3f} s of processor {speed:9.0f} x real time"
        return f"{self.what:38s} {times}  {self.remark}".rstrip()


def inputs(seconds: float, phase: float = 0.0) -> Array:
    """Inputs (N + 1, U): 1 m/s with slow changes of speed and gentle turns."""
    t = np.arange(round(seconds / DT_S) + 1) * DT_S
    speed = np.minimum(t, 1.0) * (1.0 + 0.5 * np.sin(0.1 * t + phase))
    turn = 0.1 * np.sin(0.3 * t + 2.0 * phase)
    radius = load_vehicle("elevate").odometry.wheel_radius_m
    return delayed_inputs(np.stack([speed * (1.0 - turn), speed * (1.0 + turn)], axis=1) / radius, DT_S)


def plant(terrain: str = "loose_sand", slope_rad: float = 0.0) -> Plant:
    """Elevate on one ground."""
    route = RouteTable("travel", np.zeros(1), soil_vector(load_soil(terrain))[None])
    return Plant(vehicle_vector(load_vehicle("elevate"), slope_rad=slope_rad), route)


def single(backend: str = "auto", repeats: int = 7, seconds: float = RUN_S) -> Took:
    """One run."""
    p, u, x0 = plant(), inputs(seconds), np.zeros(len(STATES))
    integrate(x0, u[:3], DT_S, p, backend=backend)
    return best(repeats, lambda: integrate(x0, u, DT_S, p, backend=backend))


def batch(runs: int = BATCH_RUNS, seconds: float = BATCH_S, jobs: int = JOBS, repeats: int = 3) -> Took:
    """Many runs on all grounds, slopes up to 5 deg, each with its own command."""
    rng, names = np.random.default_rng(0), known_names("soils")
    few = [plant(names[i % len(names)], rng.uniform(0.0, 0.09)) for i in range(min(runs, 64))]
    plants = [few[i % len(few)] for i in range(runs)]
    commands = np.array([inputs(seconds, phase) for phase in rng.uniform(0.0, 6.0, runs)])
    x0 = np.zeros(len(STATES))
    integrate_many(x0, commands[:, :3], DT_S, plants)
    return best(repeats, lambda: integrate_many(x0, commands, DT_S, plants, every=_EVERY, jobs=jobs))


def jacobian(repeats: int = 5, seconds: float = RUN_S) -> Took:
    """A run with its derivatives by ten parameters, kept at 10 Hz."""
    p, u, x0 = plant(), inputs(seconds), np.zeros(len(STATES))
    d = Directions.zeros(p, len(VEHICLE_DIRECTIONS) + len(SOIL_DIRECTIONS))
    for m, name in enumerate(VEHICLE_DIRECTIONS):
        d.vehicle[VEHICLE_PARAMETERS.index(name), m] = 1.0
    for m, name in enumerate(SOIL_DIRECTIONS, len(VEHICLE_DIRECTIONS)):
        d.soil[0, SOIL_PARAMETERS.index(name), m] = 1.0
    integrate_with_sensitivity(x0, u[:3], DT_S, p, d)
    return best(repeats, lambda: integrate_with_sensitivity(x0, u, DT_S, p, d, every=_EVERY))


def path_error_m(states: Array, reference: Array) -> float:
    """Largest difference of position, m."""
    return float(np.abs(states[:, :2] - reference[:, :2]).max())


def scipy_lines() -> Iterator[Line]:
    """SciPy's solvers on the same right-hand side, about as accurate as our default step."""
    from scipy.integrate import solve_ivp

    f, p, u, x0 = _plain_rhs(), plant(), inputs(OTHERS_S), np.zeros(len(STATES))
    t = np.arange(len(u)) * DT_S
    fine = integrate(x0, u, DT_S, p, substeps=48)
    ours = path_error_m(integrate(x0, u, DT_S, p), fine)

    def solve(method: Any, tolerance: float) -> Array:
        def slope(at: float, x: Array) -> Array:
            i = min(int(at / DT_S), len(u) - 2)
            return f(x, u[i] + (at / DT_S - i) * (u[i + 1] - u[i]))

        done = solve_ivp(slope, (0.0, t[-1]), x0, method, t, rtol=tolerance, atol=1e-2 * tolerance)
        return np.asarray(done.y.T)

    for method in ("RK45", "LSODA"):
        for tolerance in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9):
            error = path_error_m(solve(method, tolerance), fine)
            if error <= max(2.0 * ours, 1e-7):
                break
        wall = best(1, lambda m=method, to=tolerance: solve(m, to))  # type: ignore[misc]
        remark = f"rtol {tolerance:g}, path error {1e6 * error:.2g} um (ours {1e6 * ours:.2g} um)"
        yield Line(f"SciPy solve_ivp {method}", OTHERS_S, wall, remark)


def _plain_rhs() -> Callable[[Array, Array], Array]:
    """f(x, u) of the benchmark's plant through CasADi's buffers, without a copy of the parameters a call."""
    from terrafusion.twin.model.dynamics import rhs

    p, function = plant(), rhs(())
    buffer, call = function.buffer()
    x, u, dx = np.zeros(len(STATES)), np.zeros(function.size1_in("u")), np.zeros(len(STATES))
    held: tuple[Any, ...] = (x, u, p.vehicle.copy(), np.tile(p.route.soil[0], 4), np.zeros(0))
    for i, array in enumerate(held):
        if array.size:
            buffer.set_arg(i, memoryview(array))
    result: Any = dx
    buffer.set_res(0, memoryview(result))

    def slope(state: Array, command: Array) -> Array:
        x[:], u[:] = state, command
        call()
        return dx.copy()

    slope.held = (held, buffer, function)  # type: ignore[attr-defined]  # the buffer points into these
    return slope


def mujoco_line() -> Line:
    """MuJoCo: a body on four cylinders of the same mass and measures, its wheels driven by velocity."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(_mujoco_model())
    data, u = mujoco.MjData(model), inputs(OTHERS_S)
    steps = round(DT_S / MUJOCO_STEP_S)

    def run() -> None:
        mujoco.mj_resetData(model, data)
        for left, right in u[1:, :2]:
            data.ctrl[:] = (left, right, left, right)
            mujoco.mj_step(model, data, steps)

    wall = best(3, run)
    return Line(f"MuJoCo {mujoco.__version__}, rigid ground", OTHERS_S, wall,
                f"step {1e3 * MUJOCO_STEP_S:g} ms, drove {data.qpos[0]:.1f} m")  # fmt: skip


def _mujoco_model() -> str:
    vehicle, friction = load_vehicle("elevate"), load_soil("loose_sand").shear.friction_cap
    body, wheel, iz = vehicle.body, vehicle.wheel, vehicle.body.yaw_inertia_kgm2
    wheels, motors = "", ""
    for k, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        x, y, z = 0.5 * sx * body.wheelbase_m, 0.5 * sy * body.track_m, wheel.radius_m - body.cg_height_m
        wheels += f"""
          <body pos="{x} {y} {z}">
            <joint name="j{k}" axis="0 1 0" armature="{wheel.inertia_kgm2}"/>
            <geom type="cylinder" size="{wheel.radius_m} {0.5 * wheel.width_m}" zaxis="0 1 0" mass="0.5"/>
          </body>"""
        motors += f'<velocity joint="j{k}" kv="{vehicle.drive.speed_loop_p_nms}"/>'
    return f"""
      <mujoco>
        <option timestep="{MUJOCO_STEP_S}"/>
        <default><geom friction="{friction} 0.005 0.0001"/></default>
        <worldbody>
          <geom type="plane" size="0 0 1"/>
          <body pos="0 0 {body.cg_height_m}">
            <freejoint/>
            <inertial pos="0 0 0" mass="{body.mass_kg - 2.0}" diaginertia="{iz} {iz} {iz}"/>{wheels}
          </body>
        </worldbody>
        <actuator>{motors}</actuator>
      </mujoco>"""


def machine() -> str:
    """Processor, compiler and versions."""
    cpu = platform.processor() or platform.machine()
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            cpu = next((s.split(":")[1].strip() for s in file if s.startswith("model name")), cpu)
    compiler = " ".join(find_compiler() or ("none",)).rsplit("/", 1)[-1]
    versions = ", ".join(f"{n} {version(n)}" for n in ("casadi", "numpy", "scipy", "mujoco") if _installed(n))
    load = f"load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    python = f"Python {platform.python_version()}"
    return f"{cpu}, {os.cpu_count()} cores, {load}; compiler {compiler}; {python}, {versions}"


def _installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


def lines() -> Iterator[Line | str]:
    """Everything, as it gets done."""
    yield machine()
    if compiled():
        one = single()
        yield Line("one run of 300 s", RUN_S, one)
        yield Line(f"1000 runs of 60 s, {JOBS} threads", BATCH_RUNS * BATCH_S, batch())
        took = jacobian()
        ratio = f"{took.cpu_s / one.cpu_s:.2f} plain runs"
        yield Line("one run of 300 s with 10 derivatives", RUN_S, took, ratio)
    else:
        yield "no C compiler: only the virtual machine is measured"
    yield Line("one run, CasADi's virtual machine", OTHERS_S, single("vm", 1, OTHERS_S))
    yield from scipy_lines() if _installed("scipy") else ["SciPy is not installed: left out"]
    yield mujoco_line() if _installed("mujoco") else "MuJoCo is not installed: left out"


if __name__ == "__main__":
    for line in lines():
        print(line)
        sys.stdout.flush()
