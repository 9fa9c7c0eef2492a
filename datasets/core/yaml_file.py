"""Bounded reading of YAML 1.2 parameter files.

Values are plain: mappings, lists, texts, whole numbers, numbers, truth values and None; a date stays a text.
Refused are what would hang a reader or hide a mistake: double keys, merge keys `<<`, unknown tags, deep
nesting, and aliases that stand for very many values.
"""

from collections.abc import Iterator, Mapping
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
    from ruamel.yaml.error import YAMLError

    try:
        return _Builder(text).document()
    except (YAMLError, ValueError, RecursionError) as error:
        problem = str(getattr(error, "problem", None) or error).split("\n")[0]
        mark = getattr(error, "problem_mark", None)
        line = f" at line {mark.line + 1}" if mark is not None else ""
        raise ConfigError(f"not valid YAML{line}: {problem}", file=path, remedy="mend that line") from None


def dump_yaml(path: Path, content: Mapping[str, Any], **settings: Any) -> Path:
    """Write a mapping in the order of its keys; `settings` are attributes of ruamel's `YAML`.

    Raises:
        TerrafusionError: the file cannot be written.
    """
    from ruamel.yaml import YAML

    yaml: Any = YAML()
    for name, value in settings.items():
        setattr(yaml, name, value)
    return write_atomically(path, lambda part: yaml.dump(content, part))


class _Builder:
    """Values from the events of ruamel's parser."""

    def __init__(self, text: str) -> None:
        from ruamel.yaml import YAML
        from ruamel.yaml.nodes import ScalarNode

        self._yaml, self._scalar_node = YAML(typ="safe", pure=True), ScalarNode
        self._events: Iterator[Any] = self._yaml.parse(text)
        self._anchors: dict[str, tuple[Any, int]] = {}
        self._values = 0

    def document(self) -> Any:
        next(self._events)
        if type(next(self._events)).__name__ == "StreamEndEvent":
            return None
        value = self._value(next(self._events), 0)
        next(self._events)
        end = next(self._events)
        if type(end).__name__ != "StreamEndEvent":
            raise _problem(end, "a second document")
        return value

    def _value(self, event: Any, depth: int) -> Any:
        kind = type(event).__name__
        before = self._values
        self._values += 1
        if kind == "AliasEvent":
            if event.anchor not in self._anchors:
                raise _problem(event, f"'*{event.anchor}' stands for nothing before it")
            value, size = self._anchors[event.anchor]
            self._values += size
        elif kind == "ScalarEvent":
            value = self._scalar(event)
        else:
            value = self._collection(event, kind, depth)
        if self._values > limits.YAML_VALUES:
            raise _problem(
                event, f"more than {limits.YAML_VALUES} values; aliases count as what they stand for"
            )
        if event.anchor is not None:
            self._anchors[event.anchor] = value, self._values - before
        return value

    def _collection(self, event: Any, kind: str, depth: int) -> Any:
        if depth >= limits.YAML_DEPTH:
            raise _problem(event, f"nested more than {limits.YAML_DEPTH} deep")
        if event.tag is not None and str(event.tag) not in (f"{_TAG}map", f"{_TAG}seq", "!"):
            raise _problem(event, f"the tag {event.tag} is not known here")
        if kind == "SequenceStartEvent":
            return [self._value(item, depth + 1) for item in self._until("SequenceEndEvent")]
        mapping: dict[Any, Any] = {}
        for at in self._until("MappingEndEvent"):
            if getattr(at, "value", None) == "<<" and at.implicit[0]:
                raise _problem(at, "merge keys '<<' are not allowed; write the keys out")
            key = self._value(at, depth + 1)
            if isinstance(key, (dict, list)):
                raise _problem(at, "a key must be a plain value")
            if key in mapping:
                raise _problem(at, f"the key '{key}' is there twice")
            mapping[key] = self._value(next(self._events), depth + 1)
        return mapping

    def _until(self, end: str) -> Iterator[Any]:
        while type(event := next(self._events)).__name__ != end:
            yield event

    def _scalar(self, event: Any) -> Any:
        tag = str(event.tag) if event.tag is not None else None
        if tag is None or tag == "!":
            implicit = event.implicit if tag is None else (False, True)
            tag = str(self._yaml.resolver.resolve(self._scalar_node, event.value, implicit))
        kind = tag.removeprefix(_TAG)
        if kind in ("str", "timestamp", "merge", "value"):
            return event.value
        if kind not in ("int", "float", "bool", "null"):
            raise _problem(event, f"the tag {tag} is not known here")
        if len(event.value) > limits.YAML_NUMBER:
            raise _problem(event, f"a number of {len(event.value)} characters")
        node = self._scalar_node(tag, event.value, event.start_mark, event.end_mark)
        return getattr(self._yaml.constructor, f"construct_yaml_{kind}")(node)


def _problem(event: Any, text: str) -> Exception:
    from ruamel.yaml.error import MarkedYAMLError

    return MarkedYAMLError(problem=text, problem_mark=event.start_mark)
