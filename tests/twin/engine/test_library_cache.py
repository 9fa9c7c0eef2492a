"""What is loaded from the cache of compiled libraries: whole files that nobody else could have written."""

from __future__ import annotations

import ctypes
import logging
import os
from pathlib import Path

import pytest

from terrafusion.twin.engine import compiler, library_cache

pytestmark = pytest.mark.skipif(compiler.find_compiler() is None, reason="no C compiler")
SOURCE = "int answer(void) { return 42; }"


def built(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TERRAFUSION_CACHE", str(folder))
    return compiler.remembered("what", lambda: SOURCE, compiler.find_compiler() or ())


def test_a_library_is_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = built(tmp_path / "cache", monkeypatch)
    before = path.stat()
    assert built(tmp_path / "cache", monkeypatch) == path
    assert path.stat().st_mtime_ns == before.st_mtime_ns
    assert (tmp_path / "cache").stat().st_mode & 0o077 == 0
    assert not list((tmp_path / "cache").glob(".terrafusion-*"))


@pytest.mark.parametrize("damage", ["cut", "middle", "empty", "gone", "hash gone", "hash cut"])
def test_a_damaged_library_is_compiled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    path = built(tmp_path / "cache", monkeypatch)
    whole, digest = path.read_bytes(), path.with_name(f"{path.name}.sha256")
    half = len(whole) // 2
    if damage.startswith("hash"):
        digest.write_text("abc")
        if damage == "hash gone":
            digest.unlink()
    elif damage == "gone":
        path.unlink()
    else:
        pieces = {
            "cut": whole[:5000],
            "middle": whole[:half] + b"\xff" * 64 + whole[half + 64 :],
            "empty": b"",
        }
        path.write_bytes(pieces[damage])
    again = built(tmp_path / "cache", monkeypatch)
    assert again == path
    assert library_cache.is_whole(again)
    assert ctypes.CDLL(str(again)).answer() == 42


@pytest.mark.parametrize("mode", [0o1777, 0o770, 0o702])
def test_a_folder_others_can_write_to_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, mode: int
) -> None:
    cache = tmp_path / "cache"
    path = built(cache, monkeypatch)
    path.write_bytes(b"of somebody else")
    cache.chmod(mode)
    library_cache.say.cache_clear()
    with caplog.at_level(logging.WARNING):
        other = built(cache, monkeypatch)
    assert other.parent != cache
    assert ctypes.CDLL(str(other)).answer() == 42
    assert "others can write to this folder" in caplog.text
    assert str(cache) in caplog.text


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("part", ["folder", "library"])
def test_what_belongs_to_another_user_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    path = built(tmp_path / "cache", monkeypatch)
    os.chown(path if part == "library" else path.parent, 12345, -1)
    assert not library_cache.is_private(path if part == "library" else path.parent)
    again = built(tmp_path / "cache", monkeypatch)
    assert again.stat().st_uid == os.geteuid()
    assert (again == path) == (part == "library")


def test_a_link_to_a_library_is_not_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = built(tmp_path / "cache", monkeypatch)
    moved = path.rename(tmp_path / "elsewhere.so")
    path.symlink_to(moved)
    assert not built(tmp_path / "cache", monkeypatch).is_symlink()


def test_neither_home_nor_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that runs under a bare number."""
    for name in ("TERRAFUSION_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert library_cache.wanted_folder() is None
    path = compiler.compiled(SOURCE, compiler.find_compiler() or ())
    assert ctypes.CDLL(str(path)).answer() == 42
    assert path.parent.stat().st_mode & 0o077 == 0
