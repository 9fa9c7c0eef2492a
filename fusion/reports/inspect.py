"""`report.html` of a log: findings of the log checks, channels and measures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from terrafusion.fusion.reports.page import write_page


def write_inspection(path: Path, page: Mapping[str, Any], lines: Sequence[str], command: str) -> Path:
    """Write the report of a log to `path`.

    Args:
        page: what `terrafusion inspect --json` prints.
        lines: what `terrafusion inspect` prints.

    Raises:
        TerrafusionError: the file cannot be written.
    """
    found = page.get("findings", ())
    errors = sum(one["severity"] == "error" for one in found)
    return write_page(
        path, "inspect.html.j2", f"Log {page['name']}",
        lead=f"{errors} errors and {len(found) - errors} warnings.", provenance={"command": command},
        packages=("numpy",), contents="\n".join(lines),
        findings=[[f["severity"], f["channel"], f["what"], f["evidence"], f["fix"]] for f in found],
    )  # fmt: skip
