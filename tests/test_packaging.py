"""The wheel holds every subpackage and data file, and the commands answer at once."""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[1]
COMMANDS = (
    "demo", "fetch", "inspect", "convert", "simulate", "sweep", "benchmark", "calibrate", "gap",
    "allan", "replay", "live", "terrain", "policy", "gap-blind",
)  # fmt: skip


def sources() -> list[Path]:
    return [path for top in ("datasets", "twin", "fusion") for path in sorted((ROOT / top).rglob("*.py"))]


def test_every_subpackage_is_listed() -> None:
    """setuptools leaves an unlisted subpackage out of the wheel without a word."""
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {"terrafusion." + ".".join(path.parent.relative_to(ROOT).parts) for path in sources()}
    assert found - {"terrafusion.fusion._root"} | {"terrafusion"} == listed


def test_every_data_file_is_listed() -> None:
    """So is a data file that no pattern of its package names."""
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    listed: set[Path] = set()
    for package, patterns in tool["package-data"].items():
        folder = ROOT / tool["package-dir"].get(
            package, package.removeprefix("terrafusion.").replace(".", "/")
        )
        listed.update(path for pattern in patterns for path in folder.glob(pattern))
    kept = {
        path for top in ("datasets", "twin", "fusion") for path in (ROOT / top).rglob("*") if path.is_file()
    }
    data = {path for path in kept if path.suffix not in (".py", ".pyc")}
    assert data
    assert data <= listed


def test_data_files_are_installed() -> None:
    from importlib import resources

    for package, pattern in (("twin.params", "vehicles/husky.yaml"), ("fusion.noise", "policy.yaml")):
        assert resources.files(f"terrafusion.{package}").joinpath(pattern).is_file()
    assert resources.files("terrafusion.fusion.terrain").joinpath("model.yaml").is_file()
    assert resources.files("terrafusion.twin.engine").joinpath("driver.c").is_file()
    assert resources.files("terrafusion.fusion.reports").joinpath("templates/base.html.j2").is_file()


def test_help_answers_at_once_and_lists_the_commands() -> None:
    command = [sys.executable, "-c", "from terrafusion.fusion.cli.main import main; main()", "--help"]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    out = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "100"}
    ).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    took_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    for name in COMMANDS:
        assert name in out
    assert took_s < 1.0  # 0.2 s of the processor: a busy machine does not lengthen that by much


def test_help_does_not_import_the_heavy_packages() -> None:
    code = (
        "import sys, terrafusion.fusion.cli.main;"
        "heavy = ('gtsam', 'casadi', 'pandas', 'matplotlib', 'scipy', 'rosbags',"
        " 'joblib', 'pyarrow', 'dask');"
        "print([m for m in heavy if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out == "[]\n"


def test_a_replay_begins_without_the_slow_half_of_scipy() -> None:
    code = "import sys, terrafusion.fusion.replay; print({'scipy.stats', 'scipy.signal'} & set(sys.modules))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out == "set()\n"


def test_the_version_is_told() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from terrafusion.fusion.cli.main import main; main()", "--version"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == f"terrafusion {metadata.version('terrafusion')}\n"


def test_the_release_is_the_same_everywhere() -> None:
    """Citation, ROS package and the newest release of the changelog, with its date."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    citation = (ROOT / "CITATION.cff").read_text()
    changelog = (ROOT / "CHANGELOG.md").read_text()
    newest = re.search(r"^## \[(\d[^\]]*)\] - (\S+)$", changelog, re.MULTILINE)
    assert newest is not None
    assert newest[1] == version
    assert f"\nversion: {version}\n" in citation
    assert f"\ndate-released: {newest[2]}\n" in citation
    ros = ROOT / "docs" / "ros2" / "terrafusion_ros"
    assert f"<version>{version}</version>" in (ros / "package.xml").read_text()
    assert f'version="{version}"' in (ros / "setup.py").read_text()
