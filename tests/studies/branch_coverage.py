"""Which share of the lines and branches of the three packages do the tests run?

    python -m tests.studies.branch_coverage --jobs 2 --out OUT

Runs the tests under coverage.py, child processes included, and prints the share of each package and the
modules below the target.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("datasets", "twin", "fusion")
TARGET = 90.0
SETTINGS = """\
[run]
branch = true
parallel = true
patch = subprocess
data_file = {data}
source =
    {folders}
"""


def folder_of(package: str) -> Path:
    """Where a package is imported from."""
    return Path(str(importlib.import_module(f"terrafusion.{package}").__file__)).resolve().parent


def measured(tests: list[str], jobs: int, out: Path) -> dict[str, tuple[int, int]]:
    """Lines and branches that ran, and all of them, by `package/file`; tests may fail."""
    out.mkdir(parents=True, exist_ok=True)
    folders = {package: folder_of(package) for package in PACKAGES}
    rc, report = f"--rcfile={out / 'coveragerc'}", out / "report.json"
    listed = "\n    ".join(map(str, folders.values()))
    (out / "coveragerc").write_text(SETTINGS.format(data=out / "data", folders=listed))
    spread = ["-n", str(jobs), "--dist", "loadfile"] if jobs > 1 else []
    _coverage("run", rc, "-m", "pytest", "-q", "-p", "no:cacheprovider", *spread, *tests, check=False)
    _coverage("combine", "-q", rc)
    _coverage("json", "-q", rc, "-o", str(report))
    found = {}
    for name, file in json.loads(report.read_text())["files"].items():
        path, count = (ROOT / name).resolve(), file["summary"]
        for package, folder in folders.items():
            if path.is_relative_to(folder):
                ran = count["covered_lines"] + count["covered_branches"]
                all_of = count["num_statements"] + count["num_branches"]
                found[f"{package}/{path.relative_to(folder).as_posix()}"] = ran, all_of
    return found


def _coverage(*words: str, check: bool = True) -> None:
    subprocess.run([sys.executable, "-m", "coverage", *words], cwd=ROOT, stdout=sys.stderr, check=check)


def table(found: dict[str, tuple[int, int]]) -> str:
    """The share of each package, and the modules below the target, the least first."""
    lines = []
    for package in PACKAGES:
        ran, all_of = (sum(n[i] for name, n in found.items() if name.startswith(package)) for i in (0, 1))
        lines.append(f"{package}: {100.0 * ran / max(all_of, 1):.1f} % of {all_of} lines and branches")
    shares = {name: 100.0 * ran / all_of for name, (ran, all_of) in found.items() if all_of}
    low = sorted((share, name) for name, share in shares.items() if share < TARGET)
    lines += ["", f"modules below {TARGET:g} %: {len(low)} of {len(shares)}", ""]
    return "\n".join([*lines, *(f"- {name}: {share:.0f} %" for share, name in low)])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("tests", nargs="*", help="all by default")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    print(table(measured(given.tests, given.jobs, given.out.absolute())))


if __name__ == "__main__":
    main()
