"""What was told of the public sets by those who published or first examined them, for `survey`."""

from __future__ import annotations

from dataclasses import dataclass

Value = float | str


@dataclass(frozen=True)
class Instead:
    """What is measured where that is not what was told."""

    low: float
    high: float
    told: str

    def holds(self, value: Value) -> bool:
        """Whether the value is in the interval."""
        return not isinstance(value, str) and self.low <= value <= self.high


@dataclass(frozen=True)
class Fact:
    """A statement about recordings.

    Attributes:
        of: pattern (as in a shell) of `set/recording`.
        quantity: a name of `survey.QUANTITIES`.
        expected: interval that the value must lie in, or the word it must be.
        said: the statement, in short.
        instead: what is measured, where the statement does not hold.
    """

    of: str
    quantity: str
    expected: tuple[float, float] | str
    said: str
    instead: Instead | None = None

    def is_told(self) -> bool:
        """Whether somebody else states it; else the interval keeps what was measured here before."""
        return not self.said.startswith("not told")

    def holds(self, value: Value) -> bool:
        """Whether a value is what was told."""
        if isinstance(self.expected, str) or isinstance(value, str):
            return value == self.expected
        low, high = self.expected
        return low <= value <= high

    def interval(self) -> str:
        """The interval, or the word."""
        if isinstance(self.expected, str):
            return self.expected
        low, high = self.expected
        return f"{low:g} to {high:g}"


HUSKY, JACKAL = "husky_parkinglot/test1", "husky_parkinglot/test2"
ROVER, WARTHOG = "wvu_pathfinder", "norlab_drive"
MOCAP, FIELD = "umich_husky/mair_mocap", "umich_husky/field"
CAR = "comma2k19/segment_40"
FACTS: tuple[Fact, ...] = (
    Fact(HUSKY, "duration, s", (394.5, 395.5), "395 s"),
    Fact(HUSKY, "path by wheels, m", (358, 360), "359 m"),
    Fact(HUSKY, "wheels rows a second", (9.9, 10.1), "10 Hz"),
    Fact(HUSKY, "imu rows a second", (29.5, 30.5), "30 Hz"),
    Fact(HUSKY, "gnss rows a second", (2.4, 2.6), "2.5 Hz"),
    Fact(HUSKY, "least sigma, m", (0.79, 0.81), "variance from 0.64 m2"),
    Fact(HUSKY, "largest sigma, m", (1.69, 1.71), "variance to 2.9 m2"),
    Fact(HUSKY, "gravity in the log on", "+y", "reads [-z, -x, +y]"),
    Fact(HUSKY, "gravity on body z, m/s2", (9.6, 10.0), "9.8"),
    Fact(HUSKY, "imu x left of forward, deg", (-12, 12), "reads [-z, -x, +y]"),
    Fact(HUSKY, "gyro with wheels, r", (0.8, 1.0), "checked by the yaw rate"),
    Fact(HUSKY, "reckoned by gyro beside fixes, m rms", (2.3, 3.3), "2.8 m"),
    Fact(HUSKY, "reckoned by wheels beside fixes, m rms", (6.0, 8.0), "7.0 m"),
    Fact(JACKAL, "duration, s", (60.5, 61.5), "61 s"),
    Fact(JACKAL, "wheels rows a second", (49.5, 50.5), "50 Hz"),
    Fact(JACKAL, "imu rows a second", (49.5, 50.5), "50 Hz"),
    Fact(JACKAL, "channels", "wheels imu", "no GNSS, no truth"),
    Fact(JACKAL, "gravity in the log on", "+z", "not told: the mounting"),
    Fact(JACKAL, "gyro with wheels, r", (0.4, 1.0), "not told: the mounting"),
    Fact(f"{ROVER}/s5t1", "duration, s", (176, 178), "177 s"),
    Fact(f"{ROVER}/test17run", "duration, s", (69, 71), "70 s",
         Instead(72, 72.5, "the fixes' own clock ends 2 s after the wheels': 20 epochs are missing")),
    Fact(f"{ROVER}/s5t1", "path by gnss, m", (73, 77), "75 m",
         Instead(71, 73, "in steps of three sigma, which cut corners")),
    Fact(f"{ROVER}/test17run", "path by gnss, m", (33, 35), "34 m"),
    Fact(f"{ROVER}/*", "wheels rows a second", (9.8, 10.2), "10 Hz"),
    Fact(f"{ROVER}/*", "imu rows a second", (245, 255), "250 Hz"),
    Fact(f"{ROVER}/*", "gnss rows a second", (9.5, 10.5), "10 Hz"),
    Fact(f"{ROVER}/s5t1", "least sigma, m", (1.9, 2.2), "from 2 m", Instead(1.5, 1.6, "to the east")),
    Fact(f"{ROVER}/s5t1", "largest sigma, m", (2.4, 2.8), "to 2.7 m", Instead(3.3, 3.4, "to the north")),
    Fact(f"{ROVER}/test17run", "largest sigma, m", (0.0099, 0.0101), "not told: mm-grade; assumed 1 cm"),
    Fact(f"{ROVER}/*", "gravity in the log on", "-z", "forward-right-down"),
    Fact(f"{ROVER}/*", "gravity on body z, m/s2", (9.75, 9.85), "mean Az -9.80"),
    Fact(f"{ROVER}/*", "imu x left of forward, deg", (-12, 12), "forward-right-down"),
    Fact(f"{ROVER}/*", "wheels of", "front_left front_right rear_left rear_right radps", "4 wheel rates"),
    Fact(f"{ROVER}/*", "left in the log", (-10, -1), "left negative driving forward"),
    Fact(f"{ROVER}/*", "right in the log", (1, 10), "right positive"),
    Fact(f"{ROVER}/s5t1", "gyro with wheels, r", (0.8, 1.0), "turns"),
    Fact(f"{ROVER}/*", "wheel radius, m", (0.1155, 0.119), "0.110 m is about 7 % too short"),
    Fact(f"{ROVER}/test17run", "path by gnss over path by wheels", (0.98, 1.02), "with that radius"),
    Fact(f"{WARTHOG}/*/windows", "duration, s", (1.9, 2.05), "2 s windows"),
    Fact(f"{WARTHOG}/*", "imu rows a second", (19, 21), "20 Hz rows"),
    Fact(f"{WARTHOG}/*", "wheels of", "left right radps", "left and right rad/s"),
    Fact(f"{WARTHOG}/*", "rows a wheel speed is held", (4, 5), "new value every 4 to 5 rows"),
    Fact(f"{WARTHOG}/*/raw", "truth updates a second", (9, 10.1), "ICP 9 to 10 Hz",
         Instead(8, 10.1, "8 Hz in some")),
    Fact(f"{WARTHOG}/*", "gravity in the log on", "+z", "z up"),
    Fact(f"{WARTHOG}/*", "gravity on body z, m/s2", (9.7, 9.85), "m/s2"),
    Fact(f"{WARTHOG}/*/raw", "imu x left of forward, deg", (-12, 12), "not told"),
    Fact(f"{WARTHOG}/*", "gyro with wheels, r", (0.8, 1.0), "yaw rate to the left"),
    Fact(f"{WARTHOG}/*/raw", "gyro with wheels in the log, r", (0.9, 1.0), "as it should be"),
    Fact(f"{WARTHOG}/*/raw", "truth behind gyro, s", (0.2, 0.45), "not told"),
    Fact(f"{WARTHOG}/*/raw", "gyro behind wheels, s", (-0.16, -0.12), "not told"),
    *(Fact(f"{WARTHOG}/{of}*/windows", "gyro with wheels in the log, r", (-1, -0.8), "opposite sign")
      for of in ("ice", "gravel", "grass_2024_7_29")),
    Fact(f"{WARTHOG}/sand*/windows", "gyro with wheels, r", (0.985, 1.0), "0.99"),
    Fact(f"{WARTHOG}/sand*/windows", "gyro with truth in the log, r", (0.65, 0.84), "poor: 0.67 to 0.82",
         Instead(0.85, 0.88, "over half seconds")),
    Fact(f"{WARTHOG}/asphalt*", "track in yaw, m", (1.65, 1.95), "1.7 to 1.9 m",
         Instead(1.7, 2.0, "to 1.96 m")),
    Fact(f"{WARTHOG}/gr*", "track in yaw, m", (1.65, 1.95), "1.7 to 1.9 m",
         Instead(1.7, 2.8, "2.7 m in 9 windows that hardly turn")),
    Fact(f"{WARTHOG}/sand*", "track in yaw, m", (1.65, 1.95), "1.7 to 1.9 m",
         Instead(2.0, 2.15, "wider on sand")),
    Fact(f"{WARTHOG}/ice*", "track in yaw, m", (1.65, 1.95), "1.7 to 1.9 m",
         Instead(2.0, 2.8, "wider on ice")),
    Fact(f"{MOCAP}/*", "imu rows a second", (99, 101), "100 Hz"),
    Fact(f"{FIELD}/*", "imu rows a second", (198, 201), "200 Hz"),
    Fact(f"{MOCAP}/*", "wheels rows a second", (9.9, 10.1), "10 to 15 Hz"),
    Fact(f"{FIELD}/*", "wheels rows a second", (10, 15), "10 to 15 Hz"),
    Fact("umich_husky/*", "wheels of", "speed mps", "mean of both sides, vy = vz = 0"),
    Fact(f"{MOCAP}/trial1", "truth rows a second", (59, 60.1), "60 Hz"),
    Fact(f"{MOCAP}/*", "truth rows a second", (59, 60.1), "60 Hz",
         Instead(55, 60.1, "8 % of trial 3's frames are lost")),
    Fact(f"{MOCAP}/trial[17]", "channels", "wheels imu truth", "all three in trials 1 and 7"),
    Fact(f"{FIELD}/*", "channels", "wheels imu", "no truth"),
    Fact("umich_husky/*", "gravity in the log on", "+z", "z up"),
    Fact("umich_husky/*", "gravity on body z, m/s2", (9.6, 9.85), "m/s2"),
    Fact("umich_husky/*", "imu x left of forward, deg", (-12, 12), "x forward"),
    Fact(f"{MOCAP}/*", "gyro with truth, r", (0.98, 1.0), "x forward, y left, z up"),
    Fact(f"{MOCAP}/trial[17]", "path by truth over path by wheels", (0.955, 0.985), "0.96 to 0.98"),
    Fact(f"{MOCAP}/trial1", "wheels behind truth, s", (0.07, 0.2), "0.15 s late",
         Instead(-0.15, -0.06, "ahead of the motion capture by 0.07 to 0.15 s")),
    Fact(f"{MOCAP}/trial7", "wheels behind truth, s", (0.88, 1.02), "not told: said to be unknown"),
    Fact(f"{MOCAP}/trial1", "truth behind gyro, s", (0.063, 0.070), "not told"),
    Fact(f"{MOCAP}/trial7", "truth behind gyro, s", (-1.058, -1.050), "not told: said to be unknown"),
    Fact(f"{MOCAP}/trial2", "truth behind gyro, s", (-0.758, -0.748), "not told"),
    Fact(f"{MOCAP}/trial3", "truth behind gyro, s", (-0.619, -0.608), "not told"),
    *(Fact(f"{MOCAP}/{of}", "accelerometer behind wheels, s", (0.05, 0.085), "not told")
      for of in ("trial1", "trial7")),
    *(Fact(f"{FIELD}/{of}", "accelerometer behind wheels, s", (0.08, 0.16), "not told")
      for of in ("sand_small_pebble", "slip_detect1", "slip_detect2")),
    Fact("borealtc/*", "wheels rows a second", (6.45, 6.55), "6.5 Hz"),
    Fact("borealtc/*", "imu rows a second", (99.9, 100.1), "100 Hz"),
    Fact("borealtc/*", "wheels of", "left right mps", "left/right m/s"),
    Fact("borealtc/*", "gravity in the log on", "+z", "z up"),
    Fact("borealtc/*", "gravity on body z, m/s2", (9.4, 9.9), "m/s2"),
    Fact("borealtc/*", "imu x left of forward, deg", (-12, 12), "not told"),
    *(Fact(f"borealtc/{ground}/*", "terrain", ground.lower(), "the folder's name")
      for ground in ("ASPHALT", "FLOORING", "ICE", "SANDY_LOAM", "SNOW")),
    Fact("borealtc/ASPHALT/0[012456]", "gyro with wheels, r", (0.5, 1.0), "not told"),
    Fact("borealtc/*", "gyro behind wheels, s", (-0.1, 0.1), "assumed to start together",
         Instead(-1.6, 1.9, "even 6.5 Hz is nominal: the clocks wander apart")),
    Fact("borealtc/*", "imu ends after wheels, s", (-0.15, 0.15), "assumed to start together",
         Instead(-1.4, 1.4, "the pairs end up to 1.4 s apart")),
    Fact("cmu_single_wheel/*", "trials", (189, 189), "189 trials"),
    Fact("cmu_single_wheel/*", "least slip", (-0.75, -0.65), "from -0.7",
         Instead(-1, -1, "21 trials with a locked wheel")),
    Fact("cmu_single_wheel/*", "largest slip", (0.85, 0.95), "to 0.9"),
    Fact("cmu_single_wheel/*", "largest side-slip, deg", (89, 91), "to 90 deg"),
    Fact(CAR, "duration, s", (59.5, 60.5), "one minute"),
    Fact(CAR, "path by wheels, m", (950, 1050), "1 km"),
    Fact(CAR, "channels", "wheels imu gnss truth", "wheels, IMU, fixes and pose"),
    Fact(CAR, "wheels of", "front_left front_right rear_left rear_right mps", "four wheel speeds, m/s"),
    Fact(CAR, "wheels rows a second", (82.5, 83.5), "83 Hz"),
    Fact(CAR, "imu rows a second", (103.5, 104.5), "104 Hz"),
    Fact(CAR, "gnss rows a second", (9.5, 10.5), "10 Hz"),
    Fact(CAR, "truth rows a second", (19.9, 20.1), "20 Hz"),
    Fact(CAR, "gravity in the log on", "-z", "forward-right-down"),
    Fact(CAR, "gravity on body z, m/s2", (9.6, 9.85), "m/s2"),
    Fact(CAR, "imu x left of forward, deg", (-12, 12), "forward-right-down"),
    Fact(CAR, "path by gnss over path by wheels", (0.995, 1.015), "not told"),
    Fact(CAR, "path by truth over path by wheels", (1.0, 1.015), "not told"),
    Fact(CAR, "wheels behind truth, s", (-0.07, 0.01), "not told"),
)  # fmt: skip
