"""Tuning the modes on drives of the twin that nothing else is scored on.

    python -m tests.studies.mode_tuning --out modes.yaml

Twelve drives, their seeds from 1000 on, soils and headings drawn for each as for the policy. Six are as the
benchmark's family "mixed" has them: a new ground every few metres, 60 s without GNSS. Six keep to one ground
for about 100 s with an outage of 30 s; three of these have the receiver's best fixes, one stand-alone fixes,
one has a tenth of its fixes off by up to 30 m, one a receiver that claims a tenth of its error: a robust or
adaptive method has to earn its keep there, and must not lose on the others.

The loss is the mean over the drives of the logarithms of two median position errors, in the outage and
outside it, so that every drive counts by ratios and none by its metres. Coordinate search: each number
in turn is multiplied and divided by its step, and goes on in a direction for as long as that helps.
"adaptive" has the three factors of "fixed", on all rows of its policy; the other methods start from the
row of "fixed" just tuned.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.config import quantities
from terrafusion.datasets.core.recording import Recording
from terrafusion.fusion.benchmark.twin_runs import (
    FAMILIES,
    LEAD_S,
    LEG_M,
    MUD_LEG_M,
    TAIL_S,
    BenchmarkCase,
    simulate_case,
)
from terrafusion.fusion.metrics.scores import Outage
from terrafusion.fusion.noise.modes import SCHEMA, ModeTuning, load_modes
from terrafusion.fusion.noise.policy import load_policy
from terrafusion.fusion.replay import replay
from terrafusion.fusion.training.simulated_runs import GROUNDS, Grid, scattered_soil
from terrafusion.twin.scenario.file import load_scenario
from terrafusion.twin.simulate import simulate

OUTAGE = Outage(55.0, 30.0)
"""Of the drives on one ground."""
FAULTS_FROM_S = 15.0
"""Heading is found before the faults begin: the start is not what is tuned."""
OUTLIER_SHARE, OUTLIER_M = 0.1, 30.0
OPTIMISM = 10.0
LEAST_ERROR_M = 1e-3
MOST_STEPS = 3
HELPS = 1e-3
"""Decrease of the loss (0.1 % of the errors) below which a number stays as it is."""

STEPS: dict[str, dict[str, float]] = {
    "fixed": {"wheel_factor": 2.0, "slip_factor": 1.6, "gnss_factor": 1.6},
    "adaptive": {"wheel_factor": 1.4, "slip_factor": 1.6, "gnss_factor": 1.6},
    "cauchy": {"wheel_c": 2.0, "gnss_c": 2.0, "gate_sigma": 8.0},
    "gnc": {"wheel_c": 2.0, "gnss_c": 1.5, "gate_sigma": 8.0},
    "sage_husa": {"wheel_memory": 3.0, "gnss_memory": 3.0, "wheel_span": 3.0},
    "variational": {"wheel_memory": 3.0, "gnss_memory": 3.0, "wheel_span": 3.0},
}
"""Numbers tuned of each method, in this order, and the factor of a step."""
LIMITS = {
    ("adaptive", "wheel_factor"): (0.01, 1.5),
    ("adaptive", "slip_factor"): (1.0, 100.0),
    ("adaptive", "gnss_factor"): (0.01, 1.0),
}
"""Beyond these positions still get better, and slip (beyond the last: covariances) worse."""
MODE_OF: dict[str, tuple[str, dict[str, str]]] = {
    "fixed": ("fixed", {}),
    "adaptive": ("adaptive", {}),
    "cauchy": ("robust", {"robust_loss": "cauchy"}),
    "gnc": ("robust", {"robust_loss": "gnc"}),
    "sage_husa": ("innovation", {"innovation_method": "sage_husa"}),
    "variational": ("innovation", {"innovation_method": "variational"}),
}
"""Mode and variant of each method."""


@dataclass(frozen=True)
class Training:
    """One drive: scenario, ground, seed and what is wrong with its fixes."""

    scenario: str
    ground: str
    slope_deg: float
    seed: int
    fault: str = ""

    def lesson(self) -> Lesson:
        """Simulate it."""
        rng = np.random.default_rng(self.seed)
        scenario = dataclasses.replace(
            load_scenario(self.scenario),
            heading_deg=float(rng.uniform(0.0, 360.0)),
            gnss_fix=Fix.SINGLE if self.fault == "single" else None,
        )
        with tempfile.TemporaryDirectory() as folder:
            soil = scattered_soil(self.ground, rng, Path(folder))
            recording = simulate(scenario, terrain=str(soil), slope_deg=self.slope_deg, seed=self.seed)
        return Lesson(spoilt(recording, self.fault, self.seed), OUTAGE)


@dataclass(frozen=True, eq=False)
class Lesson:
    """A recording with truth, and the outage that it is given."""

    recording: Recording
    outage: Outage


DRIVES = (
    Training("figure_eight", "asphalt", 0.0, 1000),
    Training("staircase", "loose_sand", 3.0, 1001),
    Training("figure_eight", "mud", 0.0, 1002),
    Training("figure_eight", "medium_sand", 3.0, 1003, "single"),
    Training("figure_eight", "loose_sand", 6.0, 1004, "outliers"),
    Training("staircase", "asphalt", 3.0, 1005, "optimistic"),
)
MIXED = tuple(BenchmarkCase("mixed", "twin", seed) for seed in range(1006, 1012))


def mixed_lesson(case: BenchmarkCase) -> Lesson:
    """A drive of the benchmark's families, with the outage that it has there."""
    drive = simulate_case(case)
    assert drive.outage is not None
    return Lesson(drive.recording, drive.outage)


def lessons() -> list[Lesson]:
    """All drives, simulated."""
    return [drive.lesson() for drive in DRIVES] + [mixed_lesson(case) for case in MIXED]


def spoilt(recording: Recording, fault: str, seed: int) -> Recording:
    """The drive with `fault` "outliers" (a share of the fixes anywhere within `OUTLIER_M`) or "optimistic"
    (white errors `OPTIMISM` times the reported sigma); any other word leaves it as it is."""
    gnss = recording.gnss
    if gnss is None or fault not in ("outliers", "optimistic"):
        return recording
    rng = np.random.default_rng(seed)
    n = len(gnss)
    late = (gnss.t_ns - recording.start_ns) * 1e-9 > FAULTS_FROM_S
    if fault == "outliers":
        hit = late & (rng.random(n) < OUTLIER_SHARE)
        error = rng.uniform(-OUTLIER_M, OUTLIER_M, (n, 2))
    else:
        hit, error = late, OPTIMISM * gnss.sigma_enu_m[:, :2] * rng.normal(size=(n, 2))
    enu = gnss.enu_m.copy()
    enu[hit, :2] += error[hit]
    return dataclasses.replace(recording, gnss=dataclasses.replace(gnss, enu_m=enu))


def loss(lessons: list[Lesson], method: str, tuning: ModeTuning) -> float:
    """Mean logarithm of the median position errors (m) in the outage and outside it, over the drives."""
    mode, variant = MODE_OF[method]
    settings: dict[str, Any] = {"tuning": tuning, **variant}
    logs = []
    for lesson in lessons:
        recording, outage = lesson.recording, lesson.outage
        errors = replay(recording, mode=mode, outages=[outage], settings=settings).scores.errors
        assert errors is not None
        inside = outage.covers(errors.t_ns, recording.start_ns)
        distance = errors.distance_m()
        for part in (distance[inside], distance[~inside]):
            logs.append(math.log(max(float(np.nanmedian(part)), LEAST_ERROR_M)))
    return float(np.mean(logs))


def tune(
    lessons: list[Lesson],
    start: ModeTuning,
    methods: Sequence[str] = tuple(STEPS),
    tell: Callable[[str], None] = lambda text: None,
) -> ModeTuning:
    """Coordinate search over the numbers of `STEPS`, method by method."""
    tuning = start
    for method in methods:
        steps = STEPS[method]
        best = loss(lessons, method, tuning)
        tell(f"{method}: loss {best:.4f} at the start")
        for name, factor in steps.items():
            for direction in (factor, 1.0 / factor):
                moved = False
                for trial in _line(tuning, method, name, direction):
                    value = loss(lessons, method, trial)
                    tell(f"{method}.{name} = {getattr(getattr(trial, method), name):g}: loss {value:.4f}")
                    if value > best - HELPS:
                        break
                    tuning, best, moved = trial, value, True
                if moved:
                    break
    return tuning


def _line(tuning: ModeTuning, method: str, name: str, factor: float) -> Iterator[ModeTuning]:
    """The tuning with one number moved by one step, by two, and so on, while it may have the value."""
    section = getattr(tuning, method)
    value = getattr(section, name)
    quantity = quantities(type(section))[name]
    low, high = LIMITS.get((method, name)) or (quantity.low, quantity.high)
    for _ in range(MOST_STEPS):
        value = float(f"{value * factor:.4g}")
        if not low <= value <= high:
            return
        yield dataclasses.replace(tuning, **{method: dataclasses.replace(section, **{name: value})})


def fingerprint() -> str:
    """SHA-256 of what the result depends on: policy, drives, their parameter files, steps, first guesses."""
    drives = [dataclasses.astuple(drive) for drive in DRIVES]
    columns: Any = (tuple(dict.fromkeys(column)) for column in _columns())
    grid = Grid(*columns)
    settings = [drives, STEPS, dataclasses.astuple(ModeTuning()), load_policy().inputs_sha256]
    faults = [FAULTS_FROM_S, OUTLIER_SHARE, OUTLIER_M, OPTIMISM, OUTAGE, MOST_STEPS, HELPS, LIMITS]
    mixed = [MIXED, FAMILIES["mixed"], LEAD_S, TAIL_S, LEG_M, MUD_LEG_M]
    # The class had this name when the shipped file was made.
    runs = repr(mixed).replace("BenchmarkCase(", "Case(")
    inputs = grid.fingerprint() + repr(settings) + repr(faults) + runs
    return hashlib.sha256(inputs.encode()).hexdigest()


def _columns() -> tuple[list, ...]:
    """Scenarios, slopes, payloads, seeds and grounds of the drives."""
    return (
        [d.scenario for d in DRIVES], [d.slope_deg for d in DRIVES], [0.0],
        [d.seed for d in DRIVES], list(GROUNDS),
    )  # fmt: skip


def main() -> None:
    """Tune all modes and write the file."""
    parser = argparse.ArgumentParser(description="Tune the estimator's modes on drives of the twin.")
    parser.add_argument("--out", type=Path, required=True, help="tuning file to write")
    parser.add_argument("--start", type=Path, help="tuning file to go on from")
    parser.add_argument("--only", nargs="+", choices=list(STEPS), default=list(STEPS), help="methods to tune")
    given = parser.parse_args()
    out, start = given.out, load_modes(given.start) if given.start else ModeTuning()
    tuned = tune(lessons(), start, given.only, lambda text: print(text, flush=True))
    made_by = "python -m tests.studies.mode_tuning"
    write_modes(dataclasses.replace(tuned, inputs_sha256=fingerprint()), out, made_by)
    print(f"written to {out}")


def write_modes(tuning: ModeTuning, path: Path, made_by: str) -> None:
    """Write a tuning file: same tuning, same bytes."""
    from ruamel.yaml import YAML

    content: dict[str, Any] = {"schema": SCHEMA, "made_by": made_by, "inputs_sha256": tuning.inputs_sha256}
    sections = [field.name for field in dataclasses.fields(ModeTuning) if field.name != "inputs_sha256"]
    content |= {name: dataclasses.asdict(getattr(tuning, name)) for name in sections}
    yaml = YAML()
    yaml.default_flow_style = False
    with path.open("w", encoding="utf-8") as out:
        yaml.dump(content, out)


if __name__ == "__main__":
    main()
