"""Pathfinder workspaces that are broken or hostile: read or refused in one line, nothing else."""

from __future__ import annotations

import io
import resource
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.readers import open_recordings
from tests.datasets.pathfinder_files import fixes, save, workspace

Change = Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]
BROKEN: dict[str, tuple[Change, str]] = {
    "no channel": (lambda t: {k: v for k, v in t.items() if k != "rearLeftVel"}, "rearLeftVel: is missing"),
    "short channel": (lambda t: t | {"Gz": t["Gz"][:-3]}, "Gz: has 14997 values for 15000 times in tTimu"),
    "a matrix": (lambda t: t | {"Gz": np.zeros((100, 150))}, "not one row or column"),
    "nan clock": (lambda t: t | {"tTodom": t["tTodom"] * np.nan}, "tTodom: holds no times"),
    "nanoseconds": (lambda t: t | {"tTodom": t["tTodom"] * 1e9}, "tTodom: holds no times"),
    "backwards": (lambda t: t | {"tTimu": t["tTimu"][::-1].copy()}, "time runs backwards"),
    "degrees": (lambda t: t | {"llhGPS": np.full((10, 3), 39.0)}, "not radians"),
    "no fixes": (lambda t: t | {"llhGPS": np.full((10, 3), np.nan)}, "llhGPS"),
    "infinite": (lambda t: t | {"Gz": t["Gz"] + np.inf}, "Gz: holds numbers beyond"),
    "complex": (lambda t: t | {"Gz": t["Gz"].astype(complex)}, "not numbers"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_wrong_variables_are_refused(name: str, tmp_path: Path) -> None:
    change, words = BROKEN[name]
    path = save(tmp_path / "any.mat", change(workspace()))
    with pytest.raises(DataError, match=words) as refusal:
        open_recordings(path)
    assert str(path) in str(refusal.value)


def hostile(path: Path, name: str) -> Path:
    """A workspace one of whose variables claims what it does not hold."""
    save(path, {k: v for k, v in workspace().items() if k != "Gz"})
    with h5py.File(path, "r+") as file:
        if name == "huge":
            file.create_dataset("Gz", (1, 1 << 40), dtype="f8", chunks=(1, 1000))
        elif name == "huge piece":
            file.create_dataset("Gz", (1, 10), maxshape=(1, None), dtype="f8", chunks=(1, 1 << 28))
        elif name == "elsewhere":
            file.create_dataset("Gz", (1, 15000), dtype="f8", external=[("/etc/passwd", 0, 120000)])
        elif name == "link":
            file["Gz"] = h5py.ExternalLink("/etc/passwd", "/Gz")
        elif name == "loop":
            file["Gz"] = h5py.SoftLink("/Gz")
        elif name == "virtual":
            layout = h5py.VirtualLayout((1, 15000), "f8")
            layout[:] = h5py.VirtualSource("/etc/passwd", "Gz", (1, 15000))
            file.create_virtual_dataset("Gz", layout)
        else:
            file.create_group("Gz")
    return path


@pytest.mark.parametrize("name", ["huge", "huge piece", "elsewhere", "link", "loop", "virtual", "group"])
def test_impossible_claims_are_refused(name: str, tmp_path: Path) -> None:
    path = hostile(tmp_path / "any.mat", name)
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    with pytest.raises(DataError, match="Gz"):
        open_recordings(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000
    assert time.monotonic() - began < 5.0


def test_other_hdf5_is_not_claimed(tmp_path: Path) -> None:
    path = save(tmp_path / "any.mat", {"temperature": np.zeros(10)})
    with pytest.raises(DataError, match="unknown kind of file"):
        open_recordings(path)


def test_truncated_and_flipped_files(tmp_path: Path) -> None:
    """Read or refused in one line, nothing else."""
    whole = save(tmp_path / "any.mat", workspace() | fixes(np.arange(0.0, 30.0, 0.1))).read_bytes()
    path, rng, lines = tmp_path / "bad.mat", np.random.default_rng(11), []
    for k in range(120):
        data = io.BytesIO(whole if k % 2 else whole[: int(rng.integers(520, len(whole)))])
        if k % 2:
            for at in rng.integers(512, 8192, size=4):
                data.seek(int(at))
                data.write(bytes([int(rng.integers(0, 256))]))
        path.write_bytes(data.getvalue())
        try:
            open_recordings(path)
        except DataError as error:
            lines.append(str(error))
    assert len(lines) >= 60
    assert not any("\n" in line for line in lines)
