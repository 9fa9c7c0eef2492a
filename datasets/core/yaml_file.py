"""Bounded reading of YAML 1.2 parameter files.

Values are plain: mappings, lists, texts, whole numbers, numbers, truth values and None; a date stays a text.
Refused are what would hang a reader or hide a mistake: double keys, merge keys `<<`, unknown tags, deep
nesting, and aliases that stand for very many values.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from terrafusion.datasets.core import limits
from terrafusion.datasets.core.errors import ConfigError
from terrafusion.datasets.core.files import write_atomically

_TAG = "tag:yaml.org,2002:"


def read_yaml(path: Path, most_bytes: int = limits.YAML_BYTES) -> dict[str, Any]:
    """The mapping at the top of a YAML file.

    Args:
        most_bytes: a larger one is refused: pure-Python YAML would take seconds over it.

    Raises:
        ConfigError: the file is missing, very large, not UTF-8, not YAML, or not a mapping.
    """
    try:
        if not path.is_file() and path.exists():
            raise ConfigError("is no file", file=path, remedy="give a text file")
        if path.stat().st_size > most_bytes:
            raise ConfigError(
                f"the file has more than {most_bytes // 1024} KiB", file=path, remedy="give a parameter file"
            )
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError("no such file", file=path, remedy="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", file=path, remedy="give a UTF-8 text file") from None
    content = _loaded(text, path)
    if content is None:
        return {}
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ConfigError("the top level must be a mapping of names to values", file=path)
    return content


def _loaded(text: str, path: Path) -> Any:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    yaml: Any = YAML(typ="safe", pure=True)
    try:
        node = yaml.compose(text)
        return None if node is None else _Values(yaml.constructor).of(node)
    except (YAMLError, ValueError, RecursionError) as error:
        problem = str(getattr(error, "problem", None) or error).split("\n")[0]
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark is not None else ""
        raise ConfigError(f"not valid YAML{line}: {problem}", file=path, remedy="mend that line") from None


def dump_yaml(path: Path, content: Mapping[str, Any], **settings: Any) -> Path:
    """Write a mapping in the order of its keys; `settings` are attributes of ruamel's `YAML`.

    A TerrafusionError where the file cannot be written.
    """
    from ruamel.yaml import YAML

    yaml: Any = YAML()
    for name, value in settings.items():
        setattr(yaml, name, value)
    return write_atomically(path, lambda part: yaml.dump(content, part))


class _Values:
    """Plain values of the nodes that ruamel composes."""

    def __init__(self, constructor: Any) -> None:
        self._constructor = constructor
        self._known: dict[int, tuple[Any, int]] = {}
        """Value and number of values of each collection, by its node: an alias is the same node again."""
        self._count = 0

    def of(self, node: Any, depth: int = 0) -> Any:
        """The value of a node; what an alias stands for counts each time."""
        self._count += 1
        if id(node) in self._known:
            value, size = self._known[id(node)]
            self._count += size
        elif isinstance(node.value, str):
            value = self._scalar(node)
        else:
            before = self._count
            value = self._collection(node, depth)
            self._known[id(node)] = value, self._count - before
        if self._count > limits.YAML_VALUES:
            raise _problem(
                node, f"more than {limits.YAML_VALUES} values; aliases count as what they stand for"
            )
        return value

    def _collection(self, node: Any, depth: int) -> Any:
        if depth >= limits.YAML_DEPTH:
            raise _problem(node, f"nested more than {limits.YAML_DEPTH} deep, or inside itself")
        kind = str(node.tag).removeprefix(_TAG)
        if kind == "seq":
            return [self.of(item, depth + 1) for item in node.value]
        if kind != "map":
            raise _problem(node, f"the tag {node.tag} is not known here")
        mapping: dict[Any, Any] = {}
        for at, item in node.value:
            if str(at.tag) == f"{_TAG}merge":
                raise _problem(at, "merge keys '<<' are not allowed; write the keys out")
            key = self.of(at, depth + 1)
            if isinstance(key, (dict, list)):
                raise _problem(at, "a key must be a plain value")
            if key in mapping:
                raise _problem(at, f"the key '{key}' is there twice")
            mapping[key] = self.of(item, depth + 1)
        return mapping

    def _scalar(self, node: Any) -> Any:
        kind = str(node.tag).removeprefix(_TAG)
        if kind in ("str", "timestamp", "merge", "value"):
            return node.value
        if kind not in ("int", "float", "bool", "null"):
            raise _problem(node, f"the tag {node.tag} is not known here")
        if len(node.value) > limits.YAML_NUMBER:
            raise _problem(node, f"a number of {len(node.value)} characters")
        return getattr(self._constructor, f"construct_yaml_{kind}")(node)


def _problem(node: Any, text: str) -> Exception:
    from ruamel.yaml.error import MarkedYAMLError

    return MarkedYAMLError(problem=text, problem_mark=node.start_mark)
