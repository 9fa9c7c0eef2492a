"""What a benchmark runs: families, plants, seeds and field logs, cut into jobs."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources

from terrafusion.datasets.errors import ConfigError
from terrafusion.fusion.benchmark.arms import ARMS
from terrafusion.fusion.benchmark.drives import FAMILIES, FIELD, FIRST_SEED, PLANTS, Case
from terrafusion.fusion.benchmark.field import Log, logs_at_hand

SEEDS = 20
MOST_SEEDS = 10_000
QUICK_SEEDS = {"mixed": 2}
"""With --quick: seeds of a family, else 1; only "mixed" is driven on other plants than the first."""
STARTS, QUICK_STARTS = 2, 1
"""Outages of each length in a field log."""
QUICK_LOGS = ("norlab_drive/grass_2024_8_8_16h11s19/raw",)
ARM_NAMES = tuple(arm.name for arm in ARMS)


@dataclass(frozen=True)
class Job:
    """A drive of the twin, or a field log, with some arms: what one process does in one piece."""

    item: Case | Log
    arms: tuple[str, ...]

    @property
    def key(self) -> str:
        """Its name, also that of its file."""
        arms = "" if len(self.arms) == len(ARM_NAMES) else f"-{'-'.join(self.arms).replace(' ', '_')}"
        return self.item.key + arms


@dataclass(frozen=True)
class Plan:
    """A benchmark.

    Attributes:
        families: of `FAMILIES`, and `FIELD`.
        seeds: drives of each family on each plant; None for the usual number.
        quick: few drives and one log, to see that all works.
    """

    families: tuple[str, ...]
    seeds: int | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        if self.seeds is not None and not 1 <= self.seeds <= MOST_SEEDS:
            raise ConfigError(f"{self.seeds} seeds", remedy=f"give 1 to {MOST_SEEDS}")

    def seed_count(self, family: str) -> int:
        """Drives of a family on a plant."""
        if self.seeds is not None:
            return self.seeds
        return QUICK_SEEDS.get(family, 1) if self.quick else SEEDS

    def jobs(self) -> list[Job]:
        """All jobs: seed by seed, so that a run that is stopped has all families alike; then the field."""
        return [*self._twin_jobs(), *self._field_jobs()]

    def _twin_jobs(self) -> Iterator[Job]:
        families = [family for family in self.families if family != FIELD]
        for n in range(max((self.seed_count(family) for family in families), default=0)):
            for family in families:
                for plant in PLANTS:
                    first = plant == next(iter(PLANTS)) or family == next(iter(FAMILIES))
                    if n < self.seed_count(family) and (first or not self.quick):
                        yield Job(Case(family, plant, FIRST_SEED + n), ARM_NAMES)

    def _field_jobs(self) -> Iterator[Job]:
        if FIELD not in self.families:
            return
        logs = logs_at_hand(QUICK_STARTS if self.quick else STARTS)
        for log in logs:
            if not self.quick or log.name in QUICK_LOGS:
                for arm in ARM_NAMES:  # logs are long: one arm a job
                    yield Job(log, (arm,))


@functools.cache
def sources_sha256() -> str:
    """Hash of everything that makes the numbers: rows of two versions are not mixed."""
    digest = hashlib.sha256()
    for package in ("datasets", "twin", "fusion"):
        with resources.as_file(resources.files(f"terrafusion.{package}")) as folder:
            for file in sorted(folder.rglob("*")):
                if file.suffix in (".py", ".c", ".h", ".yaml", ".csv"):
                    digest.update(f"{package}/{file.relative_to(folder).as_posix()}\0".encode())
                    digest.update(file.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    return digest.hexdigest()
