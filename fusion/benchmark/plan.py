"""What a benchmark runs: families, plants, seeds and field logs, cut into jobs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.benchmark.field_logs import FieldLog, logs_at_hand
from terrafusion.fusion.benchmark.methods import METHODS
from terrafusion.fusion.benchmark.twin_runs import FAMILIES, FIELD, FIRST_SEED, PLANTS, BenchmarkCase

SEEDS = 20
MOST_SEEDS = 10_000
QUICK_SEEDS = {"mixed": 2}
"""With --quick: seeds of a family, else 1; only "mixed" is driven on other plants than the first."""
STARTS = 1
"""Outages of each length in a field log, at most."""
QUICK_LOGS = ("norlab_drive/grass_2024_8_8_16h11s19/raw",)
ARM_NAMES = tuple(arm.name for arm in METHODS)


@dataclass(frozen=True)
class Job:
    """A drive of the twin, or a field log, with some arms: what one process does in one piece."""

    item: BenchmarkCase | FieldLog
    arms: tuple[str, ...]

    @property
    def key(self) -> str:
        """Its name, also that of its file."""
        arms = "" if len(self.arms) == len(ARM_NAMES) else f"-{'-'.join(self.arms).replace(' ', '_')}"
        return self.item.key + arms


@dataclass(frozen=True)
class BenchmarkPlan:
    """A benchmark.

    Attributes:
        families: of `FAMILIES`, and `FIELD`, each with its own number of seeds, or None.
        seeds: drives on each plant of a family that has no number of its own; None for the usual one.
        quick: few drives and one log, to see that all works.
    """

    families: Mapping[str, int | None]
    seeds: int | None = None
    quick: bool = False

    def __post_init__(self) -> None:
        for count in (self.seeds, *self.families.values()):
            if count is not None and not 1 <= count <= MOST_SEEDS:
                raise ConfigError(f"{count} seeds", remedy=f"give 1 to {MOST_SEEDS}")
        if self.seeds is not None and set(self.families) == {FIELD}:
            raise ConfigError("field logs have no seeds", remedy="leave out the number of seeds")

    def seed_count(self, family: str) -> int:
        """Drives of a family on a plant."""
        given = self.families[family] or self.seeds
        if given is not None:
            return given
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
                        yield Job(BenchmarkCase(family, plant, FIRST_SEED + n), ARM_NAMES)

    def _field_jobs(self) -> Iterator[Job]:
        if FIELD not in self.families:
            return
        for log in logs_at_hand(STARTS):
            if not self.quick or log.name in QUICK_LOGS:
                for arm in ARM_NAMES:  # logs are long: one arm a job
                    yield Job(log, (arm,))


def families_of(words: Sequence[str]) -> dict[str, int | None]:
    """Families from words `NAME` or `NAME=SEEDS`; all of them and the field where there is no word.

    Raises:
        ConfigError: an unknown name, seeds that are no number, or seeds of the field.
    """
    known = (*FAMILIES, FIELD)
    found: dict[str, int | None] = {}
    for word in words:
        name, equals, count = word.partition("=")
        if name not in known:
            raise ConfigError(f"unknown family '{name}'", remedy=f"known are {', '.join(known)}")
        if equals and not count.isdecimal():
            raise ConfigError(f"'{word}' names no number of seeds", remedy=f"write {name} or {name}=20")
        if equals and name == FIELD:
            raise ConfigError(f"'{word}': field logs have no seeds", remedy=f"write {FIELD}")
        found[name] = int(count) if equals else None
    return {name: found.get(name) for name in known if name in found or not words}
