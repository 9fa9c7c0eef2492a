"""Ground memory as a file, `terrafusion.grounds/1`: a robot's grounds, without any position."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from terrafusion.datasets.core.arrays import Array
from terrafusion.datasets.core.config import structure
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.printable import counted
from terrafusion.datasets.core.quantity import Quantity, Word
from terrafusion.datasets.core.yaml_file import dump_yaml, read_yaml
from terrafusion.fusion.grounds.ground import FRICTION_MODELS, MOST_SLIP, Ground, Tally
from terrafusion.fusion.grounds.memory import MOST_GROUNDS, GroundMemory
from terrafusion.fusion.grounds.signature import SIGNATURE

SCHEMA = "terrafusion.grounds/1"
GENERIC = "generic"
"""Vehicle of a log that names none."""
_SHARE = Quantity("", 0.0, 1.0)


@dataclass(frozen=True)
class TallyFile:
    """Mean and spread of a number, and of how many windows or stretches."""

    mean: Annotated[float, Quantity("", -1e3, 1e3)]
    spread: Annotated[float, Quantity("", 0.0, 1e3)]
    count: Annotated[float, Quantity("", 0.0, 1e9)]


@dataclass(frozen=True)
class GroundFile:
    """Keys of one ground; see `ground.Ground`. `evidence` is read and not used: older files have it."""

    name: str
    signature: dict[str, TallyFile]
    slip: TallyFile
    side_slip: TallyFile
    friction: tuple[Annotated[float, _SHARE], ...]
    friction_windows: Annotated[float, Quantity("", 0.0, 1e9)]
    evidence: Annotated[float, Quantity("", -1e3, 1e3)] = 0.0
    first: str = ""
    last: str = ""
    origin: str = ""


@dataclass(frozen=True)
class GroundsFile:
    """Keys of a ground memory."""

    schema: Annotated[str, Word((SCHEMA,))]
    robot: str
    grounds: tuple[GroundFile, ...]
    drives: tuple[str, ...] = ()


def load_grounds(path: Path) -> GroundMemory:
    """The memory in a file.

    Raises:
        ConfigError: unknown or missing key, wrong type, out of range, an unknown number of a signature, slip
            that is no share, more than `MOST_GROUNDS` grounds or two of one name.
    """
    content = structure(GroundsFile, read_yaml(path), file=path)
    names = [ground.name for ground in content.grounds]
    if len(set(names)) < len(names) or len(names) > MOST_GROUNDS:
        raise ConfigError(
            f"'grounds' holds {len(names)} grounds, {len(set(names))} of different name",
            file=path,
            remedy=f"give at most {MOST_GROUNDS}, each with a name of its own",
        )
    for ground in content.grounds:
        unknown = sorted(set(ground.signature) - set(SIGNATURE))
        if unknown or len(ground.friction) != FRICTION_MODELS:
            raise ConfigError(
                f"ground '{ground.name}': "
                + (f"unknown '{unknown[0]}'" if unknown else f"{len(ground.friction)} frictions"),
                file=path,
                remedy=f"'signature' may hold {', '.join(SIGNATURE)}; 'friction' holds {FRICTION_MODELS}",
            )
        for name, tally in (("slip", ground.slip), ("side_slip", ground.side_slip)):
            if abs(tally.mean) > MOST_SLIP:
                raise ConfigError(
                    f"ground '{ground.name}': '{name}' has mean {tally.mean:g}",
                    file=path,
                    remedy="give a share, -1 to 1, not per cent",
                )
    return GroundMemory([_ground(g) for g in content.grounds], content.robot, content.drives)


def read_grounds(path: Path) -> GroundMemory:
    """The memory in a file, an empty one where there is no file yet."""
    return load_grounds(path) if path.exists() else GroundMemory()


def save_grounds(memory: GroundMemory, path: Path) -> str:
    """Write a memory: same memory, same bytes. Returns what was written, in words."""
    content = {"schema": SCHEMA, "robot": memory.robot, "grounds": [_written(g) for g in memory.grounds]}
    content |= {"drives": list(memory.drives)} if memory.drives else {}
    dump_yaml(path, content, default_flow_style=None)
    done = f"{counted(len(memory), 'ground')} of '{memory.robot}' to {path}"
    if memory.robot not in ("", GENERIC):
        return done
    return f"{done} (so every robot without a vehicle file is called: keep a file a robot, or give --vehicle)"


def _ground(content: GroundFile) -> Ground:
    friction = np.array(content.friction)
    return Ground(
        content.name,
        _tally([content.signature.get(name) for name in SIGNATURE]),
        _tally([content.slip, content.side_slip]),
        friction / friction.sum() if friction.sum() > 0.0 else np.full(FRICTION_MODELS, 1 / FRICTION_MODELS),
        content.friction_windows,
        content.first,
        content.last,
        content.origin,
    )


def _tally(entries: list[TallyFile | None]) -> Tally:
    rows = np.array([(0.0, 0.0, 0.0) if e is None else (e.count, e.mean, e.spread**2) for e in entries])
    return Tally(rows[:, 0].copy(), rows[:, 1].copy(), rows[:, 2].copy())


def _written(ground: Ground) -> dict[str, object]:
    signature, motion = _entries(ground.signature), _entries(ground.motion)
    return {
        "name": ground.name,
        "signature": {n: e for n, e in zip(SIGNATURE, signature, strict=True) if e["count"] > 0.0},
        "slip": motion[0],
        "side_slip": motion[1],
        "friction": [_rounded(p) for p in ground.friction.tolist()],
        "friction_windows": _rounded(ground.friction_windows),
        "first": ground.first,
        "last": ground.last,
        **({"origin": ground.origin} if ground.origin else {}),
    }


def _entries(tally: Tally) -> list[dict[str, float]]:
    columns: tuple[Array, ...] = (tally.mean, np.sqrt(np.maximum(tally.square, 0.0)), tally.count)
    return [
        dict(zip(("mean", "spread", "count"), map(_rounded, row), strict=True))
        for row in np.stack(columns, axis=1).tolist()
    ]


def _rounded(value: float) -> float:
    """Six significant digits."""
    return float(f"{value:.6g}") if math.isfinite(value) else 0.0
