"""Windows of finished simulated runs in a folder, so that an interrupted training continues."""

import contextlib
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrafusion.datasets.core.files import check_folder, write_atomically
from terrafusion.fusion.terrain.features import Window

NUMBERS = (
    "dt_s", "wheel_speed_mps", "wheel_speed_rate_mps2", "speed_mps", "yaw_rate_wheels_radps",
    "yaw_rate_gyro_radps", "slip", "slip_sigma",
)  # fmt: skip
"""Fields of a window that are single numbers; NaN stands for None."""


@dataclass(frozen=True)
class WindowStore:
    """One file a run.

    Attributes:
        state: hash of what the runs depend on; files of another state are not read.
    """

    folder: Path
    state: str

    def read(self, number: int) -> list[Window] | None:
        """Windows of run `number`; None if they are missing, incomplete or of another state."""
        try:
            with np.load(self._file(number), allow_pickle=False) as data:
                if str(data["state"]) != self.state:
                    return None
                numbers, imu, counts = data["numbers"], data["imu"], data["counts"]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        parts = np.split(imu, np.cumsum(counts)[:-1])
        return [_window(row, samples) for row, samples in zip(numbers, parts, strict=True)]

    def write(self, number: int, windows: list[Window]) -> None:
        """Store the windows of run `number`; a TerrafusionError where the folder cannot be written."""
        check_folder(self.folder)
        numbers = [[np.nan if (x := getattr(w, name)) is None else x for name in NUMBERS] for w in windows]
        imu = [np.column_stack([w.imu_t_s, w.gyro_radps, w.accel_mps2]) for w in windows]
        counts = np.array([len(samples) for samples in imu])
        table, state = np.array(numbers, dtype=float), np.array(self.state)

        def save(part: Path) -> None:
            with part.open("wb") as file:  # np.savez would add a suffix to a name
                np.savez(file, imu=np.vstack(imu), numbers=table, counts=counts, state=state)

        write_atomically(self._file(number), save)

    def clear(self) -> None:
        """Remove all files, as the model is written; another training may remove them at the same time."""
        with contextlib.suppress(OSError):
            for file in self.folder.glob("run-*.npz"):
                file.unlink(missing_ok=True)
            self.folder.rmdir()

    def _file(self, number: int) -> Path:
        return self.folder / f"run-{number:05d}.npz"


def _window(row: np.ndarray, imu: np.ndarray) -> Window:
    known: dict[str, Any] = {
        name: None if np.isnan(x) else x for name, x in zip(NUMBERS, row.tolist(), strict=True)
    }
    return Window(imu_t_s=imu[:, 0], gyro_radps=imu[:, 1:4], accel_mps2=imu[:, 4:7], **known)
