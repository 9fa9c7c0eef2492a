"""Reports in a headless browser, as wide as a phone."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

BROWSER = shutil.which("chromium")


def assert_drawn(report: Path) -> None:
    """All figures are drawn, without a word on the console; nothing to check where there is no browser."""
    if BROWSER is None:
        return
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0"]
    with tempfile.TemporaryDirectory() as profile:
        command += [f"--user-data-dir={profile}", "--window-size=390,800", "--virtual-time-budget=8000"]
        words = [*command, "--dump-dom", report.absolute().as_uri()]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert 'data-drawn="yes"' in done.stdout[:2000]
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert all("setting log level" in line for line in console), console
