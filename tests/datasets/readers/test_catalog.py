"""The catalogue: complete, consistent, and in step with the manifest of the field logs."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from terrafusion.datasets.catalog import catalog
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.readers import open_recording
from terrafusion.datasets.readers.formats import FORMATS


@pytest.fixture
def data_folder() -> Path:
    """The field logs, where the environment names their folder."""
    root = os.environ.get(catalog.DATA_VARIABLE)
    if not root or not (Path(root) / "manifest.json").is_file():
        pytest.skip(f"{catalog.DATA_VARIABLE} names no folder with the field logs and their manifest")
    return Path(root)


def test_every_file_of_the_manifest_is_pinned(data_folder: Path) -> None:
    entries = {entry.file: entry for entry in catalog.load_catalog().files}
    manifest = json.loads((data_folder / "manifest.json").read_text())
    assert len(manifest) > 100
    for said in manifest:
        entry = entries[said["file"]]
        assert (entry.set_name, entry.sha256, entry.bytes) == (said["dataset"], said["sha256"], said["bytes"])
        assert entry.url() == said["url"]


def test_local_files_are_found_by_their_bytes(data_folder: Path, tmp_path: Path) -> None:
    known = catalog.load_catalog()
    for entry in known.files:
        if (data_folder / entry.file).is_file():
            found = known.find(data_folder / entry.file)
            assert found is not None
            assert found.sha256 == entry.sha256
    renamed = tmp_path / "renamed.bag"
    content = (data_folder / "husky_parkinglot" / "test2.bag").read_bytes()
    renamed.write_bytes(content)
    found = known.find(renamed)
    assert found is not None
    assert found.recording == "test2"
    renamed.write_bytes(content[:-1] + b"x")
    assert known.find(renamed) is None


def test_the_sets_are_whole() -> None:
    known = catalog.load_catalog()
    readers = {form.name for form in FORMATS}
    for dataset in known.sets.values():
        files = [entry for entry in known.files if entry.set_name == dataset.name]
        assert files
        assert dataset.licence
        assert dataset.citation
        assert dataset.homepage.startswith("https://")
        assert not dataset.format or dataset.format in readers
        for recording in {entry.recording for entry in files}:
            dataset.conventions_of(recording)
    assert len({entry.file for entry in known.files}) == len(known.files)
    owners = {(entry.sha256, entry.set_name, entry.recording) for entry in known.files if entry.recording}
    assert len({sha256 for sha256, _, _ in owners}) == len(owners)  # bytes tell the recording


def test_every_case_is_of_a_recording() -> None:
    """A pattern that matches nothing is a misspelt name, and its conventions would never apply."""
    from fnmatch import fnmatchcase

    known = catalog.load_catalog()
    for dataset in known.sets.values():
        names = {e.recording for e in known.files if e.set_name == dataset.name}
        for pattern in dataset.cases:
            assert any(fnmatchcase(name, pattern) for name in names), f"{dataset.name}: {pattern}"


def test_a_recording_opens_by_name(data_folder: Path) -> None:
    by_name = open_recording("husky_parkinglot/test1")
    by_path = open_recording(data_folder / "husky_parkinglot" / "test1.bag")
    assert by_name.imu is not None
    assert by_path.imu is not None
    assert (by_name.imu.gyro_radps == by_path.imu.gyro_radps).all()
    assert by_name.licence == "BSD-3-Clause"


def test_a_recording_that_is_not_here_tells_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(catalog.DATA_VARIABLE, str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(DataError, match="terrafusion fetch husky_parkinglot"):
        open_recording("husky_parkinglot/test1")


def test_a_document_of_a_set_is_told_from_a_recording(data_folder: Path) -> None:
    with pytest.raises(DataError, match="a document of the set norlab_drive"):
        open_recording(data_folder / "norlab_drive" / "LICENSE")
    with pytest.raises(DataError, match="a document of the set cmu_single_wheel"):
        open_recording("cmu_single_wheel/all_smooth_data.mat")


def test_a_misspelt_name_is_told_the_near_ones() -> None:
    with pytest.raises(DataError, match="did you mean husky_parkinglot/test"):
        open_recording("husky_parkinglt/test1")


def test_a_folder_of_logs_names_them(tmp_path: Path) -> None:
    (tmp_path / "notes.md").write_text("nothing")
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n1 1 0 0 0 0 0 1\n")
    with pytest.raises(DataError, match=r"give one of its logs itself: poses\.tum$"):
        open_recording(tmp_path)


def test_a_folder_of_several_logs_says_how_they_become_one(tmp_path: Path) -> None:
    for name in ("gps.csv", "imu_data.csv"):
        (tmp_path / name).write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match=r"gps.csv, imu_data.csv; for one drive, write a column map beside"):
        open_recording(tmp_path)
    for number, name in enumerate(("gps.csv", "imu_data.csv")):
        (tmp_path / name).rename(tmp_path / f"d_{number}.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(DataError, match=r"d_0.mcap, d_1.mcap; if they are one bag, `ros2 bag reindex`"):
        open_recording(tmp_path)


def test_another_file_under_a_catalogued_name_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "husky_parkinglot").mkdir()
    (tmp_path / "husky_parkinglot" / "test1.bag").write_bytes(b"#ROSBAG V2.0\nanother")
    monkeypatch.setenv(catalog.DATA_VARIABLE, str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(DataError, match="other bytes than the catalogue's"):
        open_recording("husky_parkinglot/test1")


@pytest.mark.parametrize("name", ["a" * 300, "husky_parkinglot/test2#\u00b2"])
def test_names_that_no_file_has(name: str) -> None:
    with pytest.raises(DataError):
        open_recording(name)


def test_a_misspelt_key_of_a_set_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "catalog.yaml").write_text("mine: {titel: x}\n")
    (tmp_path / "catalog_files.csv").write_text(",".join(catalog.FILE_COLUMNS) + "\n")
    monkeypatch.setenv(catalog.CATALOG_VARIABLE, str(tmp_path))
    with pytest.raises(ConfigError, match=r"unknown key 'mine\.titel'; did you mean 'title'"):
        catalog.load_catalog()


def test_a_convention_of_an_unknown_channel_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    texts = "title: x, holds: x, licence: x, citation: x, homepage: x, format: ''"
    held = "conventions: {held: {weels: {value: 5, source: a test}}}"
    (tmp_path / "catalog.yaml").write_text(f"mine: {{{texts}, {held}}}\n")
    (tmp_path / "catalog_files.csv").write_text(",".join(catalog.FILE_COLUMNS) + "\n")
    monkeypatch.setenv(catalog.CATALOG_VARIABLE, str(tmp_path))
    with pytest.raises(
        ConfigError, match=r"mine\.conventions: 'held' names the channel 'weels'; give command"
    ):
        catalog.load_catalog()
