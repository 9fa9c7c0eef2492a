"""The whole path as a user walks it: simulate, inspect, convert, replay; and the twin without a compiler."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.fusion.cli.main import app

ENTRY = "from terrafusion.fusion.cli.main import main; main()"
NO_ZIG = "import sys; sys.modules['ziglang'] = None; "
"""Import of ziglang fails, and `find_spec` finds nothing."""

WALK = """\
description: two grounds, a turn
drive:
  - {duration_s: 4}
  - {duration_s: 12, v_mps: 1.0}
  - {duration_s: 6, v_mps: 0.9, yaw_rate_radps: 0.3}
  - {duration_s: 15, v_mps: 1.0, yaw_rate_amplitude_radps: 0.2, period_s: 15}
  - {duration_s: 3}
max_accel_mps2: 0.5
route:
  - {terrain: asphalt, length_m: 14}
  - {terrain: loose_sand}
"""
SHORT = """\
drive: [{duration_s: 2}, {duration_s: 6, v_mps: 1.0, yaw_rate_radps: 0.3}, {duration_s: 6, v_mps: 0.8}]
route: [{terrain: loose_sand}]
"""
SCORES = ("ate_m", "yaw_rmse_rad", "velocity_rmse_mps", "nees_mean", "distance_m", "duration_s")


def shell(
    folder: Path, *words: str, code: str = ENTRY, **environment: str
) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own; it must succeed."""
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=300, check=False,
        cwd=folder, env=os.environ | {"PYTHONWARNINGS": "default", "COLUMNS": "100"} | environment,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """The folder after the walk, and what each step printed."""
    folder = tmp_path_factory.mktemp("walk")
    (folder / "walk.yaml").write_text(WALK)
    steps = {
        "simulate": "simulate walk.yaml --out log --seed 4",
        "inspect": "inspect log",
        "convert": "convert log drive.mcap",
        "back": "convert drive.mcap back --vehicle elevate",
        "log": "replay log --out of_log --gnss-outage 18:15",
        "mcap": "replay drive.mcap --vehicle elevate --out of_mcap --gnss-outage 18:15",
        "back again": "replay back --out of_back --gnss-outage 18:15",
    }
    printed: dict[str, str] = {}
    seen: set[str] = set()
    with contextlib.chdir(folder), pytest.MonkeyPatch.context() as patch:
        for name, line in steps.items():
            words = line.split()
            if words[0] in seen:  # each command runs once in a process of its own, and writes its page
                patch.setattr("terrafusion.fusion.reports.replay.write_report", lambda *_, **__: None)
                printed[name] = CliRunner().invoke(app, words, catch_exceptions=False).output
                continue
            seen.add(words[0])
            done = shell(folder, *words)
            assert done.stderr == "", (line, done.stderr)
            printed[name] = done.stdout
    return folder, printed


def metrics_of(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return found


def test_each_step_tells_what_it_did(walked: tuple[Path, dict[str, str]]) -> None:
    _, printed = walked
    assert "written to log" in printed["simulate"]
    for word in ("imu", "4000", "accel_z_mps2", "wheels", "gnss", "fix fixed", "truth", "no findings"):
        assert word in printed["inspect"], printed["inspect"]
    assert "drive.mcap: " in printed["convert"]
    assert "imu 4000" in printed["convert"]
    assert "not in standard messages: motor" in printed["convert"]
    assert "written to of_log" in printed["log"]


@pytest.mark.parametrize("other", ["of_mcap", "of_back"])
def test_every_format_gives_the_same_scores(walked: tuple[Path, dict[str, str]], other: str) -> None:
    """Log folder and MCAP keep every bit, and so does the estimate."""
    folder, _ = walked
    log, converted = metrics_of(folder / "of_log"), metrics_of(folder / other)
    for name in (*SCORES, "updates", "against", "mode", "status", "vehicle", "weights", "rejected"):
        assert converted[name] == log[name], name
    for name in ("held_out", "outages", "rpe_percent"):
        assert converted[name] == log[name], name
    a, b = (np.loadtxt(folder / name / "trajectory.tum") for name in ("of_log", other))
    np.testing.assert_array_equal(a, b)


def test_the_numbers_make_sense(walked: tuple[Path, dict[str, str]]) -> None:
    """RTK fixes of 2 cm outside the outage: an error of metres would be a defect of the path."""
    metrics = metrics_of(walked[0] / "of_log")
    assert metrics["against"] == "truth"
    assert metrics["status"]["value"] == "running"
    assert metrics["distance_m"] == pytest.approx(30.0, abs=2.8)
    assert metrics["ate_m"] < 3.0
    assert metrics["outages"][0]["median_m"] < 5.0
    assert metrics["held_out"]["fixes"] == 75
    assert metrics["terrain"].get("loose_sand", 0.0) > 0.1


def assert_same(a: Recording, b: Recording, tolerance: float) -> None:
    assert a.channels().keys() == b.channels().keys()
    for name, channel in a.channels().items():
        other = b.channels()[name]
        np.testing.assert_array_equal(channel.t_ns, other.t_ns)
        for column, values in channel.columns().items():
            again = other.columns()[column]
            if values.dtype == object:
                assert values.tolist() == again.tolist(), column
            else:
                np.testing.assert_allclose(values, again, rtol=tolerance, atol=tolerance, err_msg=column)
    assert a.truth is not None
    assert b.truth is not None
    np.testing.assert_array_equal(a.truth.t_ns, b.truth.t_ns)
    np.testing.assert_allclose(a.truth.position_m, b.truth.position_m, atol=tolerance)


def test_without_a_compiler(tmp_path: Path) -> None:
    """CasADi's virtual machine makes the recording that compiled code makes, and says once why it is slow."""
    from terrafusion.twin.engine.compiler import find_compiler

    if find_compiler() is None:
        pytest.skip("no C compiler here to compare with")
    (tmp_path / "nothing").mkdir()
    bare = {"PATH": str(tmp_path / "nothing"), "CC": "", "HOME": str(tmp_path)}
    bare |= {"TERRAFUSION_CACHE": str(tmp_path / "cache"), "XDG_CACHE_HOME": str(tmp_path / "xdg")}
    (tmp_path / "short.yaml").write_text(SHORT)
    words = ("simulate", "short.yaml", "--slope-deg", "5", "--seed", "3")
    vm = shell(tmp_path, *words, "--out", "vm", code=NO_ZIG + ENTRY, **bare)
    assert vm.stderr.count("\n") == 1, vm.stderr
    assert "no C compiler" in vm.stderr
    assert "ziglang" in vm.stderr
    assert not (tmp_path / "cache").exists()
    compiled = shell(tmp_path, *words, "--out", "compiled", TERRAFUSION_CACHE=str(tmp_path / "cache"))
    assert compiled.stderr == ""
    assert len(list((tmp_path / "cache").glob("twin-*.so"))) == 1
    said, wanted = vm.stdout.splitlines()[:-1], compiled.stdout.splitlines()[:-1]
    assert [line for line in said if "virtual machine" not in line] == wanted
    assert len(said) == len(wanted) + 1
    assert_same(open_recording(tmp_path / "vm"), open_recording(tmp_path / "compiled"), 1e-6)
    replayed = shell(tmp_path, "replay", "vm", "--out", "results", code=NO_ZIG + ENTRY, **bare)
    assert replayed.stderr == ""


def test_a_broken_compiler_is_no_obstacle(tmp_path: Path) -> None:
    """A `cc` that fails: said in one line, and the virtual machine takes over."""
    (tmp_path / "bin").mkdir()
    compiler = tmp_path / "bin" / "cc"
    compiler.write_text('#!/bin/sh\n[ "$1" = --version ] && echo broken 1.0 && exit 0\necho no >&2\nexit 1\n')
    compiler.chmod(0o755)
    path = f"{tmp_path / 'bin'}{os.pathsep}/bin{os.pathsep}/usr/bin"
    (tmp_path / "short.yaml").write_text("drive: [{duration_s: 5, v_mps: 1.0}]\nroute: [{terrain: mud}]\n")
    words = ("simulate", "short.yaml", "--out", "log")
    done = shell(tmp_path, *words, PATH=path, CC="", TERRAFUSION_CACHE=str(tmp_path / "cache"))
    assert done.stderr.count("\n") == 1, done.stderr
    assert "could not be compiled" in done.stderr
    assert len(open_recording(tmp_path / "log").channels()) == 6
