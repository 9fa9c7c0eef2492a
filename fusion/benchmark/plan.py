"""What a benchmark runs: families, plants, seeds and field logs, cut into jobs."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.fusion.benchmark.field_logs import FieldLog, present_logs
from terrafusion.fusion.benchmark.methods import METHODS
from terrafusion.fusion.benchmark.twin_runs import FAMILIES, FIELD, FIRST_SEED, PLANTS, BenchmarkCase

SEEDS = 20
MOST_SEEDS = 10_000
QUICK_SEEDS = {"mixed": 2}
"""With --quick: seeds of a family, else 1; only "mixed" runs on all plants."""
QUICK_LOGS = ("norlab_drive/grass_2024_8_8_16h11s19/raw",)
METHOD_NAMES = tuple(method.name for method in METHODS)


@dataclass(frozen=True)
class Job:
    """A simulated run or a field log, with some methods: the work of one process."""

    item: BenchmarkCase | FieldLog
    methods: tuple[str, ...]

    @property
    def key(self) -> str:
        """Name of the job and of its file."""
        if len(self.methods) == len(METHOD_NAMES):
            return self.item.key
        return f"{self.item.key}-{'-'.join(self.methods).replace(' ', '_')}"


@dataclass(frozen=True)
class BenchmarkPlan:
    """The runs of a benchmark.

    Attributes:
        families: names of `FAMILIES` or `FIELD`, each with its number of seeds or None.
        seeds: runs on each plant of families without a number; None: `SEEDS`.
        quick: few runs and one log, as a smoke test.
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
        """Runs of a family on a plant."""
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
                        yield Job(BenchmarkCase(family, plant, FIRST_SEED + n), METHOD_NAMES)

    def _field_jobs(self) -> Iterator[Job]:
        if FIELD not in self.families:
            return
        for log in present_logs():
            if not self.quick or log.name in QUICK_LOGS:
                for method in METHOD_NAMES:  # logs are long: one method a job
                    yield Job(log, (method,))


def families_of(words: Sequence[str]) -> dict[str, int | None]:
    """Families from words `NAME` or `NAME=SEEDS`; all of them and the field logs if there is none.

    Raises:
        ConfigError: an unknown name, seeds that are no number, or seeds of field logs.
    """
    known = (*FAMILIES, FIELD)
    found: dict[str, int | None] = {}
    for word in words:
        name, equals, count = word.partition("=")
        if name not in known:
            raise ConfigError(f"unknown family '{name}'", remedy=f"known are {', '.join(known)}")
        if equals and not count.isdecimal():
            raise ConfigError(f"'{word}' has no number of seeds", remedy=f"write {name} or {name}=20")
        if equals and name == FIELD:
            raise ConfigError(f"'{word}': field logs have no seeds", remedy=f"write {FIELD}")
        found[name] = int(count) if equals else None
    return {name: found.get(name) for name in known if name in found or not words}
