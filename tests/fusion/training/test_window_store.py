"""Parts of a training: two trainings into one file may remove them at the same time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from terrafusion.fusion.training.window_store import WindowStore


def test_parts_that_another_training_has_removed_are_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "model.yaml.parts"
    folder.mkdir()
    for number in range(3):
        (folder / f"run-{number:05d}.npz").write_bytes(b"")
    listed = Path.glob

    def while_another_removes(path: Path, pattern: str) -> Iterator[Path]:
        for file in list(listed(path, pattern)):
            file.unlink()
            yield file

    monkeypatch.setattr(Path, "glob", while_another_removes)
    WindowStore(folder, "state").clear()
    assert not folder.exists()
    WindowStore(folder, "state").clear()
