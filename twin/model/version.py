"""Which version of the library and of the twin's model makes a run."""

import functools
import hashlib
from importlib import metadata, resources


def version() -> str:
    """Version of terrafusion."""
    try:
        return metadata.version("terrafusion")
    except metadata.PackageNotFoundError:
        return "not installed"


@functools.cache
def model_sha256() -> str:
    """Hash of the twin's Python and C sources: runs of two versions of the model are not mixed."""
    digest = hashlib.sha256()
    root = resources.files("terrafusion.twin")
    with resources.as_file(root) as folder:
        files = sorted(p for p in folder.rglob("*") if p.suffix in (".py", ".c", ".h"))
        for file in files:
            digest.update(file.relative_to(folder).as_posix().encode() + b"\0")
            digest.update(file.read_bytes().replace(b"\r\n", b"\n") + b"\0")
    return digest.hexdigest()
