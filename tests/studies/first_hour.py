"""The first hour of a new user: an empty environment, the README's commands, and an unknown robot.

Each step runs in a process of its own, without this source tree on its path. Times are of clock and
processors; only those of processors say anything on a busy machine.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from terrafusion.twin.simulate import simulate
from tests.fusion.cli.test_init import namespaced_bag

ROOT = Path(__file__).parents[2]
SCREEN_LINES = 14
BAG = "rover.mcap"
STEPS = (
    ("help", "terrafusion --help"),
    ("self_check", "terrafusion self-check"),
    ("demo", "terrafusion demo --out demo-out"),
    ("inspect", "terrafusion inspect demo-out/log"),
    ("replay", "terrafusion replay demo-out/log --gnss-outage 75:60 --out results"),
    ("python", "python readme.py"),
    ("init", f"terrafusion init {BAG} --topic imu=/rover/front/imu --track 0.51 --out rover.yaml"),
    ("init_replay", f"terrafusion replay {BAG} --vehicle rover.yaml --out rover-results"),
    ("simulate", "terrafusion simulate figure_eight --out run"),
)


@dataclass(frozen=True)
class Took:
    """Seconds of a step by the clock and by the processors, its exit status, and what it printed."""

    clock_s: float
    processor_s: float
    status: int
    printed: str


def run(words: list[str], folder: Path) -> Took:
    """Run a command in `folder`, as somebody who has only the installed package."""
    begun, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    hidden = ("PYTHONPATH", "TERRAFUSION_DATA")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Took(time.monotonic() - begun, processor, done.returncode, done.stdout + done.stderr)


def installed(env: Path) -> Took:
    """`pip install .` into a new environment."""
    made = run([sys.executable, "-m", "venv", str(env)], ROOT)
    pip = [str(env / "bin" / "pip"), "install", "--quiet", "--disable-pip-version-check", "."]
    took = run(pip, ROOT)
    both = made.clock_s + took.clock_s, made.processor_s + took.processor_s
    return Took(*both, made.status or took.status, took.printed)


def megabytes(folder: Path) -> float:
    """Size of what is in a folder."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sum(path.stat().st_size for path in files) / 1e6


def readme_python() -> str:
    """The README's Python, which works on the log that its commands made."""
    found = re.search(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text("utf-8"), re.M | re.S)
    assert found is not None
    return found[1]


def picture(page: Path, file: Path) -> None:
    """The head of a report as a browser shows it, where there is one."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print("no picture: there is no chromium")
        return
    look = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1060,1240"]
    look += [f"--user-data-dir={page.parent / 'browser'}", "--virtual-time-budget=12000"]
    subprocess.run([browser, *look, f"--screenshot={file}", page.as_uri()], capture_output=True, timeout=120)


def main() -> int:
    """Print a line and a screen a step; 1 where one failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", type=Path, help="an environment that has the package; default: a new one")
    parser.add_argument("--out", type=Path, help="folder for report.png, the head of the demo's report")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        env = (given.env or folder / "env").absolute()
        lines, screens, failed = ["step                clock, s  processors, s"], [], 0
        if given.env is None:
            took = installed(env)
            lines.append(f"{'install':18s} {took.clock_s:9.1f} {took.processor_s:14.1f}")
            failed += took.status != 0
        (folder / "readme.py").write_text(readme_python(), encoding="utf-8")
        namespaced_bag(folder / BAG, simulate("chirp", terrain="asphalt", seed=3))
        for name, command in STEPS:
            words = command.split()
            took = run([str(env / "bin" / words[0]), *words[1:]], folder)
            lines.append(f"{name:18s} {took.clock_s:9.1f} {took.processor_s:14.1f}")
            failed += took.status != 0
            printed = took.printed.replace(str(Path.home()), "~").strip().splitlines()
            more = ["..."] if len(printed) > SCREEN_LINES else []
            screens += ["", f"$ {command}", *(line[:118] for line in printed[:SCREEN_LINES]), *more]
        if given.out is not None:
            picture(folder / "demo-out" / "report.html", given.out.absolute() / "report.png")
        print("\n".join(lines))
        packages = env / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}" / "site-packages"
        sizes = {path.name: megabytes(path) for path in packages.iterdir() if path.is_dir()}
        print(f"installed {megabytes(packages):.0f} MB, of which")
        for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:10]:
            print(f"  {name:18s} {size:6.0f} MB")
        print(f"steps that failed: {failed}")
        print("\n".join(screens))
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
