"""The parameter files that come with the library, found by name."""

import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.files import expanded
from terrafusion.datasets.core.yaml_file import read_yaml
from terrafusion.twin.model.soil_table import PARAMS, is_published, published_soil


def known_names(folder: str) -> tuple[str, ...]:
    """Names (file stems) of the YAML files in `twin/params/<folder>`, sorted."""
    return tuple(sorted(file.stem for file in (PARAMS / folder).glob("*.yaml")))


def read_named(folder: str, name_or_path: str | Path, *, kind: str) -> tuple[dict[str, Any], str]:
    """Content of a library file by name, or of the file at a path, and what to call it in messages.

    Raises:
        ConfigError: neither a known name (they are listed) nor an existing file.
    """
    text = str(name_or_path)
    if text in known_names(folder):
        return _own_file(folder, text), f"{folder}/{text}.yaml"
    if _is_path(text):
        return read_yaml(expanded(text)), text
    raise ConfigError(
        f"unknown {kind} '{text}'",
        remedy=f"known are {', '.join(known_names(folder))}; or give the path of a .yaml file",
    )


def is_named(folder: str, name_or_path: str) -> bool:
    """Whether it is a name of the library or stands for a file, which may be absent."""
    return name_or_path in known_names(folder) or _is_path(name_or_path)


def _is_path(text: str) -> bool:
    path = expanded(text)
    try:
        is_file = path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        is_file = False
    return path.suffix in (".yaml", ".yml") or is_file


@functools.cache
def _own_file(folder: str, name: str) -> dict[str, Any]:
    """Content of a file of the library, read once; callers do not change it."""
    return read_yaml(PARAMS / folder / f"{name}.yaml")


def assumed_soil(name_or_path: str | Path) -> tuple[int, int]:
    """As `assumed`, of a soil's file; (0, 0) for no file."""
    try:
        if is_published(str(name_or_path)):
            return assumed(published_soil(str(name_or_path)))
        return assumed(read_named("soils", name_or_path, kind="soil")[0])
    except ConfigError:
        return 0, 0


def assumed(raw: dict[str, Any]) -> tuple[int, int]:
    """How many numbers of a file's content are assumed by their sources, and how many it has."""
    sources = list(_sources(raw))
    return sum(source.startswith("assumed") for source in sources), len(sources)


def _sources(section: dict[str, Any]) -> Iterator[str]:
    for value in section.values():
        if isinstance(value, dict) and "source" in value:
            yield str(value["source"])
        elif isinstance(value, dict):
            yield from _sources(value)
