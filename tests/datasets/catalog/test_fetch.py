"""Downloads, against a server on the loopback address that misbehaves on purpose."""

from __future__ import annotations

import csv
import hashlib
import os
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import pytest

from terrafusion.datasets.catalog import catalog, fetch
from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.scratch import is_part

CONTENT = bytes(range(256)) * 2000


class Server(BaseHTTPRequestHandler):
    """Serves `CONTENT` by name: what is asked for tells how it misbehaves."""

    requests: ClassVar[list[tuple[str, str | None]]] = []
    cut_after: ClassVar[list[int]] = []

    def do_GET(self) -> None:
        name, wanted = self.path.rsplit("/", 1)[1], self.headers.get("Range")
        self.requests.append((name, wanted))
        if name == "missing.bin":
            self.send_error(404)
            return
        body = CONTENT[::-1] if name == "other.bin" else CONTENT
        body = body + b"more" * 100_000 if name == "endless.bin" else body
        start = 0
        if wanted and name != "stubborn.bin":
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
            self.send_response(206)
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(body) - start))
        self.end_headers()
        stop = start + self.cut_after.pop(0) if self.cut_after else len(body)
        self.wfile.write(body[start:stop])

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Server]]:
    """The server, an own catalogue that points at it, and an empty cache."""
    Server.requests.clear()
    Server.cut_after.clear()
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), Server)
    thread = threading.Thread(target=httpd.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    url = f"http://127.0.0.1:{httpd.server_address[1]}"
    write_catalog(tmp_path / "own", url)
    monkeypatch.setenv(catalog.CATALOG_VARIABLE, str(tmp_path / "own"))
    monkeypatch.delenv(catalog.DATA_VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    yield Server
    httpd.shutdown()
    httpd.server_close()
    thread.join()


NAMES = ("good", "other", "missing", "endless", "stubborn")


def write_catalog(folder: Path, url: str) -> None:
    folder.mkdir()
    (folder / "catalog.yaml").write_text(
        "toys: {title: Toys, holds: bytes, licence: CC0-1.0, citation: '', homepage: '', format: ''}\n"
    )
    digest = hashlib.sha256(CONTENT).hexdigest()
    with (folder / "catalog_files.csv").open("w", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(catalog.FILE_COLUMNS)
        for name in NAMES:
            file = f"toys/{name}.bin"
            writer.writerow(["toys", name, file, url, "", f"data/{name}.bin", digest, len(CONTENT)])


def get(name: str, folder: Path, **options: Any) -> list[fetch.Fetched]:
    return list(fetch.fetch([f"toys/{name}"], folder, **options))


def test_a_file_comes_whole_and_only_once(server: type[Server], tmp_path: Path) -> None:
    told: list[int] = []
    (first,) = get("good", tmp_path / "to", progress=lambda entry, done: told.append(done))
    assert first.downloaded
    assert first.path.read_bytes() == CONTENT
    assert told == sorted(told)
    assert told[-1] == len(CONTENT)
    (second,) = get("good", tmp_path / "to")
    assert not second.downloaded
    assert len(server.requests) == 1
    assert [p.name for p in (tmp_path / "to" / "toys").iterdir()] == ["good.bin"]


def test_a_local_copy_is_used(server: type[Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine" / "toys").mkdir(parents=True)
    (tmp_path / "mine" / "toys" / "good.bin").write_bytes(CONTENT)
    monkeypatch.setenv(catalog.DATA_VARIABLE, str(tmp_path / "mine"))
    (got,) = fetch.fetch(["toys/good"])
    assert got.path == tmp_path / "mine" / "toys" / "good.bin"
    assert not got.downloaded
    assert not server.requests


def test_a_local_copy_is_brought_where_it_is_wanted(
    server: type[Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine" / "toys").mkdir(parents=True)
    (tmp_path / "mine" / "toys" / "good.bin").write_bytes(CONTENT)
    monkeypatch.setenv(catalog.DATA_VARIABLE, str(tmp_path / "mine"))
    (got,) = get("good", tmp_path / "to")
    assert got.path == tmp_path / "to" / "toys" / "good.bin"
    assert got.path.read_bytes() == CONTENT
    assert not server.requests


def test_a_spoilt_local_copy_is_not(server: type[Server], tmp_path: Path) -> None:
    (tmp_path / "to" / "toys").mkdir(parents=True)
    (tmp_path / "to" / "toys" / "good.bin").write_bytes(CONTENT[:-1] + b"x")
    (got,) = get("good", tmp_path / "to")
    assert got.downloaded
    assert got.path.read_bytes() == CONTENT


def test_offline_downloads_nothing(server: type[Server], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not on this machine"):
        get("good", tmp_path / "to", offline=True)
    get("good", tmp_path / "to")
    assert not get("good", tmp_path / "to", offline=True)[0].downloaded
    assert len(server.requests) == 1


def test_another_hash_is_refused_and_thrown_away(server: type[Server], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="another SHA-256"):
        get("other", tmp_path / "to")
    assert not [p for p in (tmp_path / "to").rglob("*") if p.is_file()]


def test_a_server_that_sends_too_much_is_stopped(server: type[Server], tmp_path: Path) -> None:
    (got,) = get("endless", tmp_path / "to")  # what it sent first is the file
    assert got.path.read_bytes() == CONTENT


def test_404_is_told(server: type[Server], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="404") as caught:
        get("missing", tmp_path / "to")
    assert "\n" not in str(caught.value)
    assert len(server.requests) == 1


def test_a_cut_connection_is_gone_on_from(server: type[Server], tmp_path: Path) -> None:
    server.cut_after[:] = [100_000, 50_000]
    (got,) = get("good", tmp_path / "to")
    assert got.path.read_bytes() == CONTENT
    assert [wanted for _, wanted in server.requests] == [None, "bytes=100000-", "bytes=150000-"]


def test_the_next_run_resumes(server: type[Server], tmp_path: Path) -> None:
    server.cut_after[:] = [1000] * fetch.ATTEMPTS
    with pytest.raises(DataError, match=f"broke after 3000 of {len(CONTENT)} bytes"):
        get("good", tmp_path / "to")
    assert (tmp_path / "to" / "toys" / "good.bin.part").stat().st_size == 3000
    (got,) = get("good", tmp_path / "to")
    assert got.path.read_bytes() == CONTENT
    assert server.requests[-1] == ("good.bin", "bytes=3000-")
    assert not got.path.with_name("good.bin.part").exists()


def test_a_server_that_cannot_resume_starts_again(server: type[Server], tmp_path: Path) -> None:
    server.cut_after[:] = [1000]
    (got,) = get("stubborn", tmp_path / "to")
    assert got.path.read_bytes() == CONTENT


def test_a_spoilt_part_is_found_out(server: type[Server], tmp_path: Path) -> None:
    """A part with wrong bytes gives a wrong hash once, and then starts from nothing."""
    part = tmp_path / "to" / "toys" / "good.bin.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(b"x" * 500)
    with pytest.raises(DataError, match="another SHA-256"):
        get("good", tmp_path / "to")
    assert get("good", tmp_path / "to")[0].path.read_bytes() == CONTENT


@pytest.mark.parametrize("left", [CONTENT[::-1][:700], CONTENT + b"more"], ids=["shorter", "longer"])
def test_a_part_is_written_over_by_a_server_that_cannot_resume(
    left: bytes, server: type[Server], tmp_path: Path
) -> None:
    part = tmp_path / "to" / "toys" / "stubborn.bin.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(left)
    assert get("stubborn", tmp_path / "to")[0].path.read_bytes() == CONTENT


def test_two_at_once_get_the_same_file(server: type[Server], tmp_path: Path) -> None:
    """The second goes on from the part of the first, which goes on, too."""
    to, second = tmp_path / "to", list[fetch.Fetched]()

    def meanwhile(entry: catalog.CatalogFile, done: int) -> None:
        if not second:
            second.extend(fetch.fetch(["toys/good"], to))

    (first,) = get("good", to, progress=meanwhile)
    assert first.path == second[0].path
    assert first.path.read_bytes() == CONTENT
    assert [p.name for p in first.path.parent.iterdir()] == ["good.bin"]


@pytest.mark.parametrize("local", [True, False])
def test_a_file_has_its_name_only_when_it_is_whole(
    local: bool, server: type[Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever moment a kill comes at: no name but the part's is seen before the file is whole."""
    if local:
        (tmp_path / "mine" / "toys").mkdir(parents=True)
        (tmp_path / "mine" / "toys" / "good.bin").write_bytes(CONTENT)
        monkeypatch.setenv(catalog.DATA_VARIABLE, str(tmp_path / "mine"))
    seen: list[set[str]] = []
    real = os.replace

    def replace(source: Path, target: Path) -> None:
        seen.append({path.name for path in (tmp_path / "to").rglob("*.*")})
        assert Path(source).read_bytes() == CONTENT
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    get("good", tmp_path / "to")
    assert len(seen) == 1
    assert all(is_part(name) for name in seen[0])


def test_no_server(server: type[Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_catalog(tmp_path / "dead", "http://127.0.0.1:9")
    monkeypatch.setenv(catalog.CATALOG_VARIABLE, str(tmp_path / "dead"))
    with pytest.raises(DataError, match="cannot be reached"):
        get("good", tmp_path / "to")


def test_a_full_or_closed_folder_is_told(server: type[Server], tmp_path: Path) -> None:
    (tmp_path / "to").write_text("a file")
    with pytest.raises(DataError, match="cannot be written"):
        get("good", tmp_path / "to")


def test_unknown_names_are_refused_with_the_nearest(server: type[Server], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="toys/good"):
        get("goood", tmp_path / "to")


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("file", "../../etc/passwd"),
        ("file", "/etc/passwd"),
        ("sha256", "abc"),
        ("bytes", "-1"),
        ("set", "unheard_of"),
        ("repository", "file:///etc"),
    ],
)
def test_a_hostile_catalogue_is_refused(
    column: str, value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_catalog(tmp_path / "own", "http://127.0.0.1:9")
    rows = list(csv.reader((tmp_path / "own" / "catalog_files.csv").read_text().splitlines()))
    rows[2][catalog.FILE_COLUMNS.index(column)] = value
    with (tmp_path / "own" / "catalog_files.csv").open("w", newline="") as out:
        csv.writer(out).writerows(rows)
    monkeypatch.setenv(catalog.CATALOG_VARIABLE, str(tmp_path / "own"))
    with pytest.raises(ConfigError, match=f"column '{column}' is .* at line 3"):
        catalog.load_catalog()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("cases: [a]", r"cases' is .*, not a section; give a mapping"),
        ("cases: {f: text}", r"cases\.f' is 'text', not a section; give keys from conventions, note"),
        ("conventions: [1]", r"conventions' is '\[1\]', not a section; give keys from vehicle"),
        ("cases: {f: {notes: x}}", r"unknown key '.*cases\.f\.notes'; did you mean 'note'"),
        ("conventions: {gyro_z_sign: 1}", r"conventions.gyro_z_sign' is '1' without a source"),
    ],
)
def test_a_set_of_wrong_shape_is_refused(
    line: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_catalog(tmp_path / "own", "http://127.0.0.1:9")
    text = (tmp_path / "own" / "catalog.yaml").read_text().replace("format: ''}", f"format: '', {line}}}")
    (tmp_path / "own" / "catalog.yaml").write_text(text)
    monkeypatch.setenv(catalog.CATALOG_VARIABLE, str(tmp_path / "own"))
    with pytest.raises(ConfigError, match=words):
        catalog.load_catalog()


def test_a_row_too_long_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_catalog(tmp_path / "own", "http://127.0.0.1:9")
    with (tmp_path / "own" / "catalog_files.csv").open("a") as out:
        out.write("\n" + ",".join("x" * 9) + "\n")
    monkeypatch.setenv(catalog.CATALOG_VARIABLE, str(tmp_path / "own"))
    with pytest.raises(ConfigError, match="has 9 cells"):
        catalog.load_catalog()


def test_the_command(server: type[Server], tmp_path: Path, terrafusion: Any) -> None:
    listed = terrafusion("fetch")
    assert listed.status == 0
    for word in ("husky_parkinglot", "BSD-3-Clause", "toys", "CC0-1.0"):
        assert word in listed.out
    got = terrafusion("fetch", "toys/good", "--to", tmp_path / "to")
    assert got.status == 0
    assert str(tmp_path / "to" / "toys" / "good.bin") in got.out
    assert "CC0-1.0" in got.out
    assert got.err == ""
    assert terrafusion("fetch", "toys/good", "toys/missing", "--to", tmp_path / "to").refused(
        "missing.bin", "404"
    )
    assert terrafusion("fetch", "nothing").refused("nothing", "not in the catalogue")
