"""`run_study`: the source study, reproduced by the twin from one plan."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.twin.executors import Workers, open_workers
from tests.studies.source_study.batch import BatchResult, grid, run_cell, slip_cells
from tests.studies.source_study.cases import UNEVEN, CaseRun, run_case
from tests.studies.source_study.claims import ClaimResult, judge, load_claims
from tests.studies.source_study.field_drive import FieldDrive, drive_field
from tests.studies.source_study.gnss_noise import RATES_HZ, NoiseFit, NoisyRun, fit_noise
from tests.studies.source_study.published import CASES, StudyCase
from tests.studies.source_study.quantities import (
    Quantities,
    batch_quantities,
    case_quantities,
    field_quantities,
    noise_quantities,
    platform_quantities,
    uneven_quantities,
)

SEEDS, QUICK_SEEDS, MOST_SEEDS = 10, 2, 1000
STUDY_LIKE_HZ = 5.0  # rate at which the study-like Gaussian noise is shown: that of the twin's receiver
FLAT_TERRAIN = "loose_sand"  # the terrain that is driven on level ground, too, to see what the slope adds

Progress = Callable[[float], None]


@dataclass(frozen=True)
class StudyPlan:
    """How much to run: seeds a case (None for the usual number), the small batch when quick, processes."""

    seeds: int | None = None
    quick: bool = False
    jobs: int = 1

    def seed_count(self) -> int:
        """Seeds a case.

        Raises:
            ConfigError: a number out of range.
        """
        if self.seeds is None:
            return QUICK_SEEDS if self.quick else SEEDS
        if not 1 <= self.seeds <= MOST_SEEDS:
            raise ConfigError(f"{self.seeds} seeds", remedy=f"give 1 to {MOST_SEEDS}")
        return self.seeds


@dataclass(frozen=True, eq=False)
class Study:
    """The reproduced study.

    Attributes:
        runs: by terrain, the three cases of Tab. 4 on even ground, one run a seed.
        uneven: the same on ground that varies.
        noisy: the same runs with Gaussian GNSS noise at `STUDY_LIKE_HZ` that waits for its size.
        noise: the sizes that come closest to the study's GNSS errors, one fit a rate.
        batch: terrain x friction x slope x payload.
        over_slip: one load and slope with more and more slip.
        field: drives like the study's field test, one a seed.
        measured: every quantity a claim is held against.
        rows: the table of agreement.
    """

    plan: StudyPlan
    runs: Mapping[str, tuple[CaseRun, ...]]
    uneven: Mapping[str, tuple[CaseRun, ...]]
    noisy: Mapping[str, tuple[NoisyRun, ...]]
    noise: tuple[NoiseFit, ...]
    batch: tuple[BatchResult, ...]
    over_slip: tuple[BatchResult, ...]
    field: tuple[FieldDrive, ...]
    measured: Quantities
    rows: tuple[ClaimResult, ...]

    def study_like(self) -> NoiseFit:
        """The fit that the figures and the table show."""
        return next(fit for fit in self.noise if fit.rate_hz == STUDY_LIKE_HZ)


def run_study(
    plan: StudyPlan, progress: Progress | None = None, *, backend: str = "loky", address: str | None = None
) -> Study:
    """Drive everything the plan asks for, measure, and judge.

    Args:
        backend: "loky" (this machine) or "dask", then with the `address` of its scheduler.

    Raises:
        ConfigError: seeds or jobs out of range, or an address missing or out of place.
        TerrafusionError: workers died, or the cluster does not answer.
    """
    seeds, level = range(plan.seed_count()), StudyCase(FLAT_TERRAIN, 0.0, *[float("nan")] * 4)
    cells, steps = grid(plan.quick), slip_cells(plan.quick)
    work: list[tuple[Callable[..., Any], tuple[Any, ...]]] = [
        *((run_case, (case, seed)) for case in (*CASES, level) for seed in seeds),
        *((run_case, (case, seed, UNEVEN)) for case in CASES for seed in seeds),
        *((run_cell, (cell,)) for cell in (*cells, *steps)),
        *((drive_field, (seed,)) for seed in seeds),
    ]
    with open_workers(backend, plan.jobs, address) as workers:
        done = iter(_run_all(work, workers, progress))
    runs = {case.terrain: tuple(next(done) for _ in seeds) for case in CASES}
    flat = {FLAT_TERRAIN: tuple(next(done) for _ in seeds)}
    uneven = {case.terrain: tuple(next(done) for _ in seeds) for case in CASES}
    batch = tuple(next(done) for _ in cells)
    over_slip = tuple(next(done) for _ in steps)
    field = tuple(done)
    published = {case.terrain: case.gnss for case in CASES}
    noise = tuple(fit_noise(_noisy(rate_hz, runs), published, rate_hz) for rate_hz in RATES_HZ)
    noisy = _noisy(STUDY_LIKE_HZ, runs)
    measured = (
        platform_quantities()
        | case_quantities(runs, flat)
        | uneven_quantities(uneven)
        | noise_quantities(noise, noisy, STUDY_LIKE_HZ)
        | batch_quantities(batch, over_slip)
        | field_quantities(field)
    )
    rows = judge(load_claims(), measured)
    return Study(plan, runs, uneven, noisy, noise, batch, over_slip, field, measured, rows)


def _noisy(rate_hz: float, runs: Mapping[str, Sequence[CaseRun]]) -> dict[str, tuple[NoisyRun, ...]]:
    return {terrain: tuple(NoisyRun.of(run, rate_hz) for run in of) for terrain, of in runs.items()}


def _run_all(
    work: Sequence[tuple[Callable[..., Any], tuple[Any, ...]]], workers: Workers, progress: Progress | None
) -> list[Any]:
    """The results of all calls, in the order of `work` whoever computes them."""
    results: dict[int, Any] = {}
    for number, result in workers.by_key(dict(enumerate(work))):
        results[number] = result
        if progress is not None:
            progress(len(results) / len(work))
    return [results[number] for number in range(len(work))]
