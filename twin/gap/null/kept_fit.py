"""The fit of the twin to references, kept on disk: several diagnoses have the same references."""

import contextlib
import json
from collections.abc import Sequence
from pathlib import Path

from terrafusion.datasets.core.errors import TerrafusionError
from terrafusion.datasets.core.files import write_atomically
from terrafusion.twin.calibrate.log import PreparedLog
from terrafusion.twin.calibrate.model import Model
from terrafusion.twin.engine.codegen import follows_from
from terrafusion.twin.engine.library_cache import cache_folder
from terrafusion.twin.gap.null.reference_twin import RUNS, numbers, set_to_references
from terrafusion.twin.gap.rollout.residuals import LinearisationCache


def set_as_before(
    logs: Sequence[PreparedLog], cache: LinearisationCache, channels: Sequence[str], jobs: int
) -> Model:
    """As `set_to_references`, by the numbers that an earlier diagnosis found for the same references, twin
    and version of the library. Laws of the user's own may have changed since: with these, nothing is kept."""
    import joblib

    c, names = cache.candidates, [one.name for one in numbers(cache, logs)]
    version = follows_from("fit", c.keys)
    if version is None:
        return set_to_references(logs, cache, channels, jobs)
    content = [logs[:RUNS], cache.model, c.scale, c.low, c.high, c.base, channels, version]
    file = cache_folder() / f"references-{joblib.hash(content)}.json"
    known = _read(file)
    if known is not None and [*known] == names:
        return cache.model.replaced(known)
    model = set_to_references(logs, cache, channels, jobs)
    found = json.dumps({name: model.value(name) for name in names})
    with contextlib.suppress(TerrafusionError, OSError):  # a full disk
        write_atomically(file, lambda part: part.write_text(found, encoding="ascii"))
    return model


def _read(file: Path) -> dict[str, float] | None:
    """Numbers by name; None where there are none, or the file is damaged."""
    try:
        return {str(name): float(value) for name, value in json.loads(file.read_bytes()).items()}
    except (OSError, ValueError, TypeError, AttributeError):
        return None
