"""How large an effect must be for a given detectability d', by an oracle that does not know the diagnosis.

d' is the shift of the output of a matched filter over its scatter in null runs of the plant, for all runs of
a trial together. `python -m tests.studies.blind.sensitivity` measures `sensitivity.yaml`.
"""

import functools
from importlib import resources
from typing import Any

import numpy as np

D_PRIMES = (5.0, 10.0, 25.0)


def size_at(key: str, kind: str, d_prime: float) -> float | None:
    """Size of the shape `key` with this d' on drives of a kind; None: the plant is not asked for so much.

    Raises:
        KeyError: the shape was not measured.
    """
    sizes = stored_sizes()[key][kind]
    known = [(d, size) for d, size in zip(D_PRIMES, sizes, strict=True) if size is not None]
    if not known or d_prime > known[-1][0]:
        return None
    d, size = np.log(np.array(known)).T
    return float(np.exp(np.interp(np.log(d_prime), d, size)))


@functools.cache
def stored_sizes() -> dict[str, Any]:
    """`sensitivity.yaml`: sizes at `D_PRIMES` by shape and kind of drive."""
    from terrafusion.datasets.core.yaml_file import read_yaml

    with resources.as_file(resources.files("terrafusion.twin.gap.blind") / "sensitivity.yaml") as path:
        return dict(read_yaml(path)["sizes"])
