"""`report.html` of a log: findings of the log checks, channels and measures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from terrafusion.fusion.reports.page import VerdictBox, write_page


def write_inspection(path: Path, page: Mapping[str, Any], lines: Sequence[str], command: str) -> Path:
    """Write the report of a log: of `page`, what `terrafusion inspect --json` prints, and the other `lines`.

    A TerrafusionError where the file cannot be written.
    """
    found = page.get("findings", ())
    errors = sum(one["severity"] == "error" for one in found)
    warnings = len(found) - errors
    value = "not_to_be_used" if errors else "doubtful" if found else "good"
    counts = f"{errors} error{'s' * (errors != 1)} and {warnings} warning{'s' * (warnings != 1)}"
    title = counts if found else "The log checks found nothing"
    return write_page(
        path, "inspect.html.j2", f"Log {page['name']}",
        verdicts=[VerdictBox(value, title, ())], provenance={"command": command}, packages=("numpy",),
        contents="\n".join(lines),
        findings=[[(f["channel"], f["severity"]), (f["what"], f["evidence"]), f["fix"]] for f in found],
    )  # fmt: skip
