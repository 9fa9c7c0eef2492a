"""Users without a home folder and without an entry in the password file, as containers have them."""

from __future__ import annotations

from pathlib import Path

import pytest

from terrafusion.datasets.catalog import catalog, fetch
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.readers import open_recording
from terrafusion.twin.model.vehicle import load_vehicle


@pytest.fixture(autouse=True)
def homeless(monkeypatch: pytest.MonkeyPatch) -> None:
    import pwd

    def unknown(number: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {number}")

    for name in ("HOME", "XDG_CACHE_HOME", "TERRAFUSION_DATA", "TERRAFUSION_CACHE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)


def test_there_is_no_folder_of_downloads() -> None:
    assert catalog.data_folders() == []
    name = next(iter(catalog.load_catalog().recordings()))
    with pytest.raises(DataError):
        open_recording(name)
    with pytest.raises(DataError, match="no home folder to keep files in; name a folder with --to"):
        list(fetch.fetch([name]))


@pytest.mark.parametrize("name", ["~/my.yaml", "~nobody_here/my.yaml", "~"])
def test_a_path_of_a_home_that_is_not_there(name: str) -> None:
    with pytest.raises(ConfigError):
        load_vehicle(name)
    assert not Path("~").exists()
