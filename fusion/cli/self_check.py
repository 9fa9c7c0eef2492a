"""`terrafusion self-check`: whether this installation works, and what to do where it does not."""

import dataclasses
import importlib.util
from collections.abc import Callable, Iterator
from typing import Any, Literal

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import check_folder
from terrafusion.fusion.cli.command import Result

EXTRAS = {
    "compiler": ("ziglang", "a C compiler for the twin, where the machine has none"),
    "parquet": ("pyarrow", "`terrafusion sweep`"),
    "rerun": ("rerun", "`replay --rerun`, for the Rerun viewer"),
    "cluster": ("distributed", "`--backend dask` of sweep, benchmark, gap-blind and terrain train"),
    "live": ("cyclonedds", "`live` on a robot, over DDS"),
    "foxglove": ("foxglove", "`live --foxglove`"),
}
MAX_DIFFERENCE = 1e-9
"""Of the states of compiled and interpreted model after one sample."""
SECONDS, MAX_ERROR_M = 5.0, 0.5
"""Length of the drive, and the largest position error (root mean square) of its replay."""

OTHER_COMPILER = "set CC to another C compiler, and empty the cache of compiled code"


@dataclasses.dataclass(frozen=True)
class Check:
    """One line of the check: `broken` makes the command fail, `note` does not."""

    name: str
    state: Literal["ok", "note", "broken"]
    text: str
    remedy: str = ""

    def line(self) -> str:
        """The check in one line."""
        return f"{self.state:7s} {self.name}: {self.text}" + (f"; {self.remedy}" if self.remedy else "")


def self_check() -> Result:
    """Check this installation: compiler, cache, engine, estimator, optional packages.

    Compares the compiled twin with the interpreted one, and replays a simulated drive of five seconds.
    Exit status 1 where something is broken; each such line names the remedy.

    Example: terrafusion self-check
    """
    checks = [*_versions(), _compiler(), *_caches()]
    checks.append(_attempt("engine", _engine, OTHER_COMPILER))
    checks.append(_attempt("replay", _replay, "install terrafusion anew in a fresh environment"))
    checks += _extras()
    broken = [check for check in checks if check.state == "broken"]
    done = f"{len(broken)} of {len(checks)} checks failed" if broken else "this installation works"
    document = {"works": not broken, "checks": [dataclasses.asdict(check) for check in checks]}
    return Result([check.line() for check in checks], done, document, int(bool(broken)))


def _attempt(name: str, check: Callable[[], Check], remedy: str) -> Check:
    """The check; one that cannot even run is broken."""
    try:
        return check()
    except Exception as error:  # whatever an installation may lack
        return Check(name, "broken", f"{type(error).__name__}: {error}", remedy)


def _versions() -> Iterator[Check]:
    from terrafusion.fusion.reports.page import versions_of

    versions = versions_of(("gtsam", "casadi", "numpy", "scipy", "pandas"))
    missing = [name for name, version in versions.items() if version == "not installed"]
    text = ", ".join(f"{name} {version}" for name, version in versions.items())
    remedy = f"pip install {' '.join(missing)}" if missing else ""
    yield Check("versions", "broken" if missing else "ok", text, remedy)


def _compiler() -> Check:
    from terrafusion.twin.engine.compiler import find_compiler

    command = find_compiler()
    if command is None:
        remedy = "install a C compiler, or pip install 'terrafusion[compiler]'"
        return Check("compiler", "note", "none: the twin is interpreted, many times slower", remedy)
    return Check("compiler", "ok", " ".join(command))


def _caches() -> Iterator[Check]:
    from terrafusion.datasets.catalog.catalog import cache_folder
    from terrafusion.twin.engine.library_cache import wanted_folder

    for name, folder, remedy in (
        ("cache of compiled code", wanted_folder(), "set TERRAFUSION_CACHE to a folder of your own"),
        ("cache of downloads", cache_folder(), "give `terrafusion fetch --to FOLDER`, or set XDG_CACHE_HOME"),
    ):
        if folder is None:
            yield Check(name, "broken", "there is no home folder", remedy)
            continue
        try:
            check_folder(folder)
        except TerrafusionError:
            yield Check(name, "broken", f"{folder} cannot be written", remedy)
        else:
            yield Check(name, "ok", str(folder))


def _drive(seconds: float, **options: Any) -> Any:
    from terrafusion.twin.scenario.file import load_scenario
    from terrafusion.twin.simulate import simulate_run

    scenario = dataclasses.replace(load_scenario("figure_eight"), duration_s=seconds)
    return simulate_run(scenario, **options)


def _engine() -> Check:
    from terrafusion.twin.engine.compiler import find_compiler

    vm = _drive(0.1, backend="vm").states
    if find_compiler() is None:
        return Check("engine", "note", "interpreted only", "see compiler")
    difference = float(abs(_drive(0.1, backend="c").states - vm).max())
    text = f"compiled and interpreted model differ by {difference:.1g} after 0.1 s"
    if difference <= MAX_DIFFERENCE:
        return Check("engine", "ok", text)
    return Check("engine", "broken", f"{text}, more than {MAX_DIFFERENCE:g}", OTHER_COMPILER)


def _replay() -> Check:
    from terrafusion.fusion.replay import replay

    error_m = replay(_drive(SECONDS).recording).scores.ate_m
    text = f"position error {error_m:.3f} m on a simulated drive of {SECONDS:g} s"
    if error_m is not None and error_m < MAX_ERROR_M:
        return Check("replay", "ok", text)
    remedy = "compare the versions with those of the documentation, above all gtsam"
    return Check("replay", "broken", f"{text}, not below {MAX_ERROR_M:g} m", remedy)


def _extras() -> Iterator[Check]:
    for extra, (module, purpose) in EXTRAS.items():
        if importlib.util.find_spec(module) is not None:
            yield Check(f"extra {extra}", "ok", purpose)
        else:
            remedy = f"pip install 'terrafusion[{extra}]'"
            yield Check(f"extra {extra}", "note", f"not installed, gives {purpose}", remedy)
