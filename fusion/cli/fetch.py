"""`terrafusion fetch [NAME...]`: the catalogue of public recordings, and downloads from it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.common import PROGRESS
from terrafusion.fusion.cli.inspect_page import styled_lines

if TYPE_CHECKING:
    from terrafusion.datasets.catalog.catalog import Catalog, CatalogFile


def fetch(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME]...", help="A set, or SET/RECORDING; without names the catalogue is shown."
        ),
    ] = None,
    to: Path | None = None,
    offline: bool = False,
) -> Result:
    """Show the catalogue of public recordings, or download from it.

    Every file is checked against its SHA-256. Files in TERRAFUSION_DATA or in the cache are not downloaded
    again, and interrupted downloads are resumed. The licences are those of the authors.

    Examples:

      terrafusion fetch

      terrafusion fetch husky_parkinglot

      terrafusion fetch borealtc/SNOW/00 wvu_pathfinder/s5t1 --to fieldlogs

    Args:
        to: Folder for the files; the user's cache folder otherwise.
        offline: Use local files only.
    """
    from terrafusion.datasets.catalog.catalog import load_catalog

    catalog = load_catalog()
    if not names:
        rows = [_row(catalog, name) for name in catalog.sets]
        return Result(_catalog_lines(rows), "", rows)
    return _download(catalog, names, to, offline)


def _row(catalog: Catalog, name: str) -> dict[str, Any]:
    from terrafusion.datasets.catalog.catalog import data_folders

    known = catalog.sets[name]
    files = [entry for entry in catalog.files if entry.set_name == name]
    here = sum(any((folder / entry.file).is_file() for folder in data_folders()) for entry in files)
    return {
        "name": name,
        "title": known.title,
        "holds": known.holds,
        "licence": known.licence,
        "citation": known.citation,
        "homepage": known.homepage,
        "recordings": [entry for entry in dict.fromkeys(e.recording for e in files) if entry],
        "files": len(files),
        "bytes": sum(entry.bytes for entry in files),
        "files_here": here,
    }


def _catalog_lines(rows: list[dict[str, Any]]) -> list[str]:
    lines: list[tuple[str, str]] = []
    for row in rows:
        count = len(row["recordings"])
        about = (
            f"{row['name']}  {count} recording{'s' if count != 1 else ''}, {row['bytes'] / 1e6:.1f} MB, "
            f"{row['licence']}, {row['files_here']} of {row['files']} files here"
        )
        names = ", ".join(row["recordings"][:4]) + (f", ... ({count})" if count > 4 else "")
        texts = [*(row[key] for key in ("title", "holds", "citation", "homepage")), names]
        lines += [("bold", about), *(("", f"    {text}") for text in texts if text)]
    return styled_lines(lines)


def _download(catalog: Catalog, names: list[str], to: Path | None, offline: bool) -> Result:
    from terrafusion.datasets.catalog.fetch import entries_of, fetch

    wanted = {entry.file: entry for name in names for entry in entries_of(catalog, name)}
    done = []
    with _bar(sum(entry.bytes for entry in wanted.values())) as advance:
        for got in fetch(names, to, offline=offline, progress=advance):
            done.append(got)
            advance(got.entry, got.entry.bytes)
            print(f"{'fetched' if got.downloaded else 'here   '}  {got.path}")
    sets = [catalog.sets[name] for name in dict.fromkeys(got.entry.set_name for got in done)]
    files = [{"file": g.entry.file, "path": str(g.path), "downloaded": g.downloaded} for g in done]
    cited = [
        f"{known.name}: {known.licence}; please cite: {known.citation} ({known.homepage})" for known in sets
    ]
    return Result(cited, "", {"files": files, "licences": {s.name: s.licence for s in sets}})


@contextmanager
def _bar(total_bytes: int) -> Iterator[Callable[[CatalogFile, int], None]]:
    """A progress bar over all bytes on a terminal; silent in a pipe."""
    if not sys.stderr.isatty():
        yield lambda entry, done: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn

    bytes_of: dict[str, int] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not PROGRESS.bar) as bar:
        task = bar.add_task("", total=total_bytes)

        def advance(entry: CatalogFile, done: int) -> None:
            bytes_of[entry.file] = done
            bar.update(task, completed=sum(bytes_of.values()), description=entry.file)

        yield advance
