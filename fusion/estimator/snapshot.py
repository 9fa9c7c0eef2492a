"""A running estimator as bytes, and back, so that it continues with the same bits.

The file is a tree of JSON and a block of arrays. Nothing in it is executed; its classes must be the
library's, and its sizes must fit its length. `restore` builds an estimator from the configuration, which
the file does not hold, and fills in the state of the run. The tree follows the attributes of the
estimator's objects, so that new ones are covered; what cannot be written makes `dump` fail, not `restore`.

Layout: `MAGIC`, SHA-256 of the rest (32 bytes), length of the tree (8 bytes, little endian), the tree in
UTF-8, the arrays end to end.
"""

import dataclasses
import functools
import hashlib
import json
import sys
import types
import typing
from collections import deque
from enum import Enum
from importlib import metadata
from typing import Any, Protocol, TypeVar

import gtsam
import numpy as np

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.datasets.core.sensors import ImuSpec, Rig
from terrafusion.fusion.config.estimator_config import EstimatorConfig
from terrafusion.fusion.estimator.odometry import Propagator
from terrafusion.fusion.graph.chain import Chain
from terrafusion.fusion.graph.factor_numbers import FactorNumbers, factor_from, numbers_of
from terrafusion.fusion.graph.preintegration import Preintegrator
from terrafusion.fusion.noise.policy import Policy
from terrafusion.fusion.terrain.classifier import LikelihoodTable, TerrainModel
from terrafusion.fusion.terrain.spectrum import SpectrumClassifier

MAGIC = b"terrafusion.snapshot/1\n"
_HEAD = len(MAGIC) + 32 + 8
_DTYPES = {"<f8": 8, "<c16": 16, "<i8": 8, "|b1": 1}
_FIXED = (
    EstimatorConfig,
    Rig,
    ImuSpec,
    Policy,
    TerrainModel,
    LikelihoodTable,
    SpectrumClassifier,
    Preintegrator,
    Propagator,
    gtsam.Values,
)
"""Determined by the configuration or by the rest of the estimator: not written, kept at `restore`."""
_OWN = ("terrafusion.fusion.", "terrafusion.datasets.")


class Running(Protocol):
    """The part of an estimator that a snapshot uses."""

    config: EstimatorConfig
    chain: Chain


R = TypeVar("R", bound=Running)


def dump(estimator: Running) -> bytes:
    """The estimator's state; of the configuration only its hash.

    Raises:
        ConfigError: the estimator keeps an archive for a batch solution.
    """
    if estimator.chain.archive is not None:
        raise ConfigError(
            "an estimator that keeps all keyframes for a batch is not dumped", remedy="run it live"
        )
    writer = _Writer()
    tree = {
        **_versions(),
        "config": config_hash(estimator.config),
        "state": writer.write(estimator, "estimator"),
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    body = len(text).to_bytes(8, "little") + text + b"".join(writer.arrays)
    return MAGIC + hashlib.sha256(body).digest() + body


def restore(fresh: R, data: bytes) -> R:
    """The same estimator, fresh until now, filled with a dumped state.

    Raises:
        ConfigError: the bytes are no dump, are damaged, or are of another version or configuration.
    """
    tree, arrays = _opened(data)
    for name, own in _versions().items():
        if tree.get(name) != own:
            raise ConfigError(f"the snapshot is of {name} {tree.get(name)}", remedy=f"this is {name} {own}")
    if tree.get("config") != config_hash(fresh.config):
        raise ConfigError(
            "the snapshot is of another configuration",
            remedy="restore with the vehicle, mode, policy and settings of the dump",
        )
    try:
        _Reader(arrays).read(tree.get("state"), fresh, "estimator")
        fresh.chain.rebuild()
    except (ConfigError, DataError) as error:
        raise _corrupt(error.what) from None
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        raise _corrupt("its parts do not fit together") from error
    return fresh


def config_hash(config: EstimatorConfig) -> str:
    """SHA-256 over every setting, number and table of a configuration."""
    writer = _Writer(fixed=())
    text = json.dumps(writer.write(config, "config"), sort_keys=True)
    return hashlib.sha256(text.encode() + b"".join(writer.arrays)).hexdigest()


def _versions() -> dict[str, str]:
    return {"terrafusion": metadata.version("terrafusion"), "gtsam": metadata.version("gtsam")}


def _corrupt(why: str) -> ConfigError:
    return ConfigError(f"the snapshot cannot be restored: {why}", remedy="start anew")


def _opened(data: bytes) -> tuple[dict[str, Any], memoryview]:
    """The tree and the arrays of a file whose check sum is right."""
    if not isinstance(data, bytes) or not data.startswith(MAGIC):
        raise ConfigError("no snapshot of an estimator", remedy="give the bytes of Estimator.dump()")
    body = data[len(MAGIC) + 32 :]
    if hashlib.sha256(body).digest() != data[len(MAGIC) : len(MAGIC) + 32]:
        raise ConfigError("the snapshot is cut short or damaged: its check sum is wrong", remedy="start anew")
    length = int.from_bytes(data[_HEAD - 8 : _HEAD], "little")
    try:
        tree = json.loads(data[_HEAD : _HEAD + length])
    except (ValueError, RecursionError):
        raise _corrupt("its tree is no JSON") from None
    if not isinstance(tree, dict):
        raise _corrupt("its tree is no object")
    return tree, memoryview(data)[_HEAD + length :]


class _Writer:
    """Python values as JSON; arrays go to `arrays`."""

    def __init__(self, fixed: tuple[type, ...] = _FIXED) -> None:
        self.arrays: list[bytes] = []
        self._offset = 0
        self._fixed = fixed
        self._seen: dict[int, int] = {}
        self._alive: list[object] = []

    def write(self, value: Any, where: str) -> Any:
        if value is None or isinstance(value, (bool, str)):
            return value
        if isinstance(value, Enum):
            return {"enum": [_name(type(value)), value.name]}
        if isinstance(value, (int, float)) and not isinstance(value, np.generic):
            return value
        if isinstance(value, np.generic):
            return self.write(value.item(), where)
        if isinstance(value, complex):
            return {"complex": [value.real, value.imag]}
        if isinstance(value, np.ndarray):
            return self._array(value, where)
        if callable(value) or isinstance(value, self._fixed):
            return {"fixed": None}
        return self._collection(value, where)

    def _collection(self, value: Any, where: str) -> Any:
        if isinstance(value, list):
            return [self.write(v, where) for v in value]
        if isinstance(value, tuple):
            return {"tuple": [self.write(v, where) for v in value]}
        if isinstance(value, set):
            return {"set": sorted(value)}
        if isinstance(value, deque):
            return {"deque": [self.write(v, where) for v in value], "maxlen": value.maxlen}
        if isinstance(value, dict):
            return {"dict": [[self.write(k, where), self.write(v, where)] for k, v in value.items()]}
        if isinstance(value, gtsam.Pose3):
            return {"pose": self._array(value.matrix()[:3], where)}
        if isinstance(value, gtsam.imuBias.ConstantBias):
            return {"bias": self._array(value.vector(), where)}
        if isinstance(value, gtsam.NonlinearFactorGraph):
            factors = [numbers_of(value.at(i)) for i in range(value.size())]
            return {"graph": [self.write(f, where) for f in factors]}
        if type(value).__module__.startswith(_OWN):
            return self._object(value, where)
        raise TypeError(f"{where}: a {type(value).__name__} cannot be written")

    def _object(self, value: object, where: str) -> Any:
        if id(value) in self._seen:
            return {"seen": self._seen[id(value)]}
        self._seen[id(value)] = len(self._seen)
        self._alive.append(value)  # else another object could get its id
        return {
            "object": _name(type(value)),
            "parts": {k: self.write(v, f"{where}.{k}") for k, v in _parts(value).items()},
        }

    def _array(self, value: np.ndarray, where: str) -> Any:
        dtype = value.dtype.newbyteorder("<").str
        if dtype not in _DTYPES:
            raise TypeError(f"{where}: an array of {value.dtype} cannot be written")
        # Products of matrices depend, in their last bits, on the order in memory.
        by_columns = value.ndim > 1 and value.strides[0] < value.strides[-1]
        data = value.astype(dtype).tobytes("F" if by_columns else "C")
        self.arrays.append(data)
        self._offset += len(data)
        return {"array": [dtype, list(value.shape), by_columns, self._offset - len(data)]}


class _Reader:
    """Reads what `_Writer` wrote into the places of a fresh estimator."""

    def __init__(self, arrays: memoryview) -> None:
        self._arrays = arrays
        self._objects: list[object] = []

    def read(self, node: Any, present: Any, where: str) -> Any:
        """The value of a node; `present` is what a fresh estimator has there, None where it has nothing."""
        if node is None or isinstance(node, (bool, int, float, str)):
            return node
        if isinstance(node, list):
            return _filled(present, [self.read(v, None, where) for v in node])
        kind = next(iter(node), "")
        if kind == "fixed":
            return present
        if kind == "seen":
            return self._objects[int(node["seen"])]
        if kind == "object":
            return self._object(node, present, where)
        if kind == "array":
            return self._array(*node["array"])
        if kind == "complex":
            return complex(*node["complex"])
        if kind == "enum":
            name, member = node["enum"]
            return _class(name, Enum)[member]
        return self._collection(kind, node, present, where)

    def _collection(self, kind: str, node: dict[str, Any], present: Any, where: str) -> Any:
        inside = node[kind]
        if kind == "tuple":
            return tuple(self.read(v, None, where) for v in inside)
        if kind == "set":
            return _filled(present, {str(v) for v in inside})
        if kind == "deque":
            read = deque((self.read(v, None, where) for v in inside), maxlen=node["maxlen"])
            return _filled(present, read)
        if kind == "dict":
            return _filled(present, {self.read(k, None, where): self.read(v, None, where) for k, v in inside})
        if kind == "pose":
            rows = self.read(inside, None, where)
            return gtsam.Pose3(gtsam.Rot3(np.ascontiguousarray(rows[:, :3])), rows[:, 3].copy())
        if kind == "bias":
            numbers = self.read(inside, None, where)
            return gtsam.imuBias.ConstantBias(numbers[:3], numbers[3:])
        if kind == "graph":
            graph = gtsam.NonlinearFactorGraph()
            for record in inside:
                graph.add(factor_from(self._object(record, None, where, FactorNumbers)))
            return graph
        raise ConfigError(f"{where} holds an unknown '{kind}'")

    def _object(self, node: dict[str, Any], present: Any, where: str, only: type = object) -> Any:
        cls = _class(node["object"], only)
        place = len(self._objects)
        in_place = type(present) is cls and not _frozen(cls)
        self._objects.append(present if in_place else None)
        of_fresh = _parts(present) if in_place else {}
        names = set(of_fresh) if in_place else {f.name for f in dataclasses.fields(cls)}
        if set(node["parts"]) != names:
            raise ConfigError(f"{where} has other parts than a {cls.__name__} of this version")
        parts = {k: self.read(v, of_fresh.get(k), f"{where}.{k}") for k, v in node["parts"].items()}
        wrong = _misfit(cls, parts, of_fresh)
        if wrong:
            raise ConfigError(f"{where}.{wrong} has the wrong type")
        if in_place:
            vars(present).update(parts)
            return present
        self._objects[place] = cls(**parts)
        return self._objects[place]

    def _array(self, dtype: str, shape: list[int], by_columns: bool, offset: int) -> np.ndarray:
        count = 1
        for length in shape:
            if not isinstance(length, int) or not 0 <= length <= len(self._arrays):
                raise ConfigError(f"an array has the shape {shape}")
            count *= length
        end = offset + count * _DTYPES[dtype]
        if not 0 <= offset <= end <= len(self._arrays) or len(shape) > 4:
            raise ConfigError(f"an array of {shape} lies outside the file")
        flat = np.frombuffer(self._arrays[offset:end], dtype=dtype).copy()
        return flat.reshape(shape, order="F" if by_columns else "C")


def _filled(present: Any, read: Any) -> Any:
    """`read`, in the container of a fresh estimator: others may hold it, too."""
    if type(present) is not type(read):
        return read
    present.clear()
    (present.extend if isinstance(read, (list, deque)) else present.update)(read)
    return present


def _parts(value: object) -> dict[str, Any]:
    """Attributes of an object, without what `cached_property` keeps there."""
    if dataclasses.is_dataclass(value):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    cls = type(value)
    cached = {k for k, v in vars(cls).items() if isinstance(v, functools.cached_property)}
    return {k: v for k, v in vars(value).items() if k not in cached and not k.startswith("_on_")}


def _misfit(cls: type, parts: dict[str, Any], of_fresh: dict[str, Any]) -> str | None:
    """The first part whose type differs from the class's annotations or from a fresh object's."""
    hints = _hints_of(cls) if dataclasses.is_dataclass(cls) else {}
    for name, value in parts.items():
        own = of_fresh.get(name)
        if name in hints and not _fits(value, hints[name]):
            return name
        if isinstance(own, np.ndarray) and own.shape != np.shape(value):
            return name
        if own is not None and not isinstance(
            value, (float, int) if type(own) in (float, int) else type(own)
        ):
            return name
    return None


@functools.cache
def _hints_of(cls: type) -> dict[str, Any]:
    """The annotations of a class, evaluated."""
    return typing.get_type_hints(cls)


def _fits(value: Any, hint: Any) -> bool:
    """Whether `value` is of the annotated type; containers are looked into, arrays by kind only."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return True
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is None or hint is type(None):
        return value is None
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, one) for one in arguments)
    if origin is typing.Annotated:
        return _fits(value, arguments[0])
    if not isinstance(value, origin or hint):
        return False
    if origin in (list, set) or (origin is tuple and arguments[-1] is Ellipsis):
        return all(_fits(one, arguments[0]) for one in value)
    if origin is tuple:
        return len(value) == len(arguments) and all(map(_fits, value, arguments))
    if origin is dict:
        return all(_fits(k, arguments[0]) and _fits(v, arguments[1]) for k, v in value.items())
    return True


def _frozen(cls: type) -> bool:
    return dataclasses.is_dataclass(cls) and cls.__dataclass_params__.frozen  # type: ignore[attr-defined]


def _name(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def _class(name: str, base: type) -> Any:
    """A class of this library by its name; nothing is imported for it."""
    module, _, attribute = name.partition(":")
    found = getattr(sys.modules.get(module), attribute, None) if module.startswith(_OWN) else None
    if not isinstance(found, type) or not issubclass(found, base) or found.__module__ != module:
        raise ConfigError(f"'{name}' is no class of an estimator")
    return found
