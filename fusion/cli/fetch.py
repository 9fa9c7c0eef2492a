"""`terrafusion fetch [NAME...]`: the catalogue of public recordings, and downloads from it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terrafusion.fusion.cli.command import Result
from terrafusion.fusion.cli.common import Line, progress_bar

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


def _catalog_lines(rows: list[dict[str, Any]]) -> list[Line]:
    lines: list[Line] = []
    for row in rows:
        count = len(row["recordings"])
        about = (
            f"{row['name']}  {count} recording{'s' if count != 1 else ''}, {row['bytes'] / 1e6:.1f} MB, "
            f"{row['licence']}, {row['files_here']} of {row['files']} files here"
        )
        names = ", ".join(row["recordings"][:4]) + (f", ... ({count})" if count > 4 else "")
        texts = [*(row[key] for key in ("title", "holds", "citation", "homepage")), names]
        lines += [("bold", about), *(("", f"    {text}") for text in texts if text)]
    return lines


def _download(catalog: Catalog, names: list[str], to: Path | None, offline: bool) -> Result:
    from terrafusion.datasets.catalog.fetch import entries_of, fetch

    wanted = {entry.file: entry for name in names for entry in entries_of(catalog, name)}
    done = []
    total, done_bytes = max(sum(entry.bytes for entry in wanted.values()), 1), dict[str, int]()
    with progress_bar("downloading") as progress:

        def advance(entry: CatalogFile, received: int) -> None:
            done_bytes[entry.file] = received
            if progress is not None:
                progress(sum(done_bytes.values()) / total)

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
