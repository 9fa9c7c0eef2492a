"""Reports are written where the user has no home folder."""

from __future__ import annotations

import os
import subprocess
import sys

SCRIPT = """
import pwd

def unknown(number):
    raise KeyError(number)

pwd.getpwuid = unknown
from terrafusion.fusion.reports.plots.sheet import Sheet, bokeh_script

Sheet(10.0)
assert len(bokeh_script()) > 100_000
"""


def test_plots_are_drawn_without_a_home_folder() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "HOME"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
