"""Pages of the site that are made from the code: command line, Python API, file schemas, effects.

`mkdocs.yml` names this file as a hook. Results of studies, the changelog and the guide for contributors are
shown where the repository keeps them; a link to any other file outside docs becomes plain text.
"""

from __future__ import annotations

import importlib.util
import json
import posixpath
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = "tests/studies/results/"
SHOWN = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
"""Pages of the repository that the site shows, and where."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table; a bar inside a cell is escaped."""

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(" ".join(c.split()).replace("|", "\\|") for c in cells) + " |"

    return [line(head), line(["---"] * len(head)), *(line(row) for row in rows), ""]


def cli_page() -> str:
    """Every command with its arguments and options, from the parsers."""
    from typer.main import get_command

    from terrafusion.fusion.cli.main import app

    lines = ["# Command line", "", "`terrafusion COMMAND --help` prints the same.", ""]
    for words, command in commands("terrafusion", get_command(app)):
        text, _, example = (command.help or "").partition("\nExample:")
        lines += [f"## {words}", "", text.replace("\f", "").strip(), ""]
        if example:
            lines += ["```text", " ".join(example.split()), "```", ""]
        rows = [option_row(p) for p in command.params if not getattr(p, "hidden", False)]
        lines += table(("argument", "default", "meaning"), rows) if rows else []
    return "\n".join(lines)


def commands(words: str, command: Any) -> Iterator[tuple[str, Any]]:
    """Words and command of each command below a group, in its order."""
    for name, below in command.commands.items():
        if hasattr(below, "commands"):
            yield from commands(f"{words} {name}", below)
        else:
            yield f"{words} {name}", below


def option_row(parameter: Any) -> tuple[str, str, str]:
    """Name, default and meaning of an argument or an option."""
    names = [*parameter.opts, *parameter.secondary_opts]
    if not names[0].startswith("-"):
        names = [parameter.metavar or names[0].upper()]
    default = parameter.default
    shown = "" if callable(default) or default in (None, False, [], ()) else f"`{default}`"
    required = "required" if parameter.required else shown
    return ", ".join(f"`{name}`" for name in names), required, parameter.help or ""


def api_page() -> str:
    """The names of `import terrafusion as tf`, from their docstrings."""
    import terrafusion

    lines = [
        "# Python",
        "",
        "`import terrafusion as tf` offers these names; all else may change without notice.",
        "",
    ]
    for name in terrafusion.__all__:
        home = terrafusion._HOMES.get(name)
        if home is None:
            continue
        path = f"terrafusion.{home.rstrip(':').replace(':', '.')}"
        lines += [
            f"::: {path}",
            f"    options: {{heading: tf.{name}, toc_label: tf.{name}, heading_level: 2}}",
            "",
        ]
    return "\n".join(lines)


def schemas_page() -> str:
    """Keys of every YAML and JSON file, from docs/schemas."""
    lines = [
        "# File schemas",
        "",
        "Keys of the files that are read and written; editors take the linked JSON schema.",
        "",
    ]
    for path in sorted((ROOT / "docs" / "schemas").glob("*.json")):
        found = json.loads(path.read_text(encoding="utf-8"))
        name = path.name.partition(".")[0].replace("_", " ")
        lines += [
            f"## {name}",
            "",
            described(found)[0],
            "",
            f"[{path.name}](../schemas/{path.name})",
            "",
        ]
        parts = [("", found), *found.get("$defs", {}).items()]
        for part, schema in parts:
            if schema.get("properties"):
                lines += [f"### {name}: {part}", "", described(schema)[0], ""] if part else []
                lines += table(("key", "type", "meaning"), list(key_rows(schema)))
    return "\n".join(lines)


def described(schema: dict[str, Any]) -> tuple[str, dict[str, str]]:
    """A schema's description without the list of its attributes, and the meaning of each attribute."""
    text, _, listed = schema.get("description", "").partition("Attributes:")
    listed, *_ = re.split(r"\n(?:\n|Raises:|Returns:)", listed.strip("\n"))
    said: dict[str, str] = {}
    names: list[str] = []
    for line in listed.splitlines():
        started = re.match(r"\s*(\w+(?:, \w+)*): (.*)", line)
        words = started[2] if started else line.strip()
        names = started[1].split(", ") if started else names
        for name in names:
            said[name] = f"{said.get(name, '')} {words}".strip()
    return text.strip(), said


def key_rows(schema: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Key, type and meaning of each property; required keys are bold."""
    _, said = described(schema)
    for key, value in schema["properties"].items():
        name = f"**`{key}`**" if key in schema.get("required", ()) else f"`{key}`"
        meaning = [said.get(key, ""), value.get("description", "")]
        if value.get("default") not in (None, {}, []):
            meaning.append(f"Default `{json.dumps(value['default'])}`.")
        yield name, type_name(value), " ".join(filter(None, meaning))


def type_name(schema: Any) -> str:
    """A schema's type in words, with its range or values."""
    if not isinstance(schema, dict):
        return "any"
    if "$ref" in schema:
        return str(schema["$ref"]).rpartition("/")[2]
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{v}`" for v in schema.get("enum", [schema.get("const")]))
    for word in ("anyOf", "oneOf"):
        if word in schema:
            return " or ".join(dict.fromkeys(type_name(s) for s in schema[word]))
    found = schema.get("type", "any")
    name = " or ".join(found) if isinstance(found, list) else str(found)
    if name == "array" and "items" in schema:
        name = f"list of {type_name(schema['items'])}"
    if name == "object" and isinstance(schema.get("additionalProperties"), dict):
        name = f"mapping to {type_name(schema['additionalProperties'])}"
    signs = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
    limits = [f"{sign} {schema[key]:g}" for key, sign in signs.items() if key in schema]
    return " ".join([name, ", ".join(limits)]).strip()


def effects_page() -> str:
    """Every effect that can be added to the twin, from the catalogue."""
    from terrafusion.twin.effects.catalogue import built_in

    lines = [
        "# Effects of the twin: all forms",
        "",
        "*Typical* is the size assumed for a robot of the nominal class. *Enters at* names the stages. In a"
        " law, `e` is the value; laws marked *ours* are phenomenological."
        " [Optional effects](effects.md) says how to use them.",
        "",
    ]
    rows = [
        (
            f"`{form.parameter_key(p)}`",
            f"{p.scale:g} {p.unit}".rstrip(),
            f"{p.low:g} to {p.high:g}",
            ", ".join(form.terms),
            form.equation,
            form.source if form.candidate else f"{form.source} (not tried by a diagnosis)",
        )
        for form in built_in().values()
        for p in form.parameters
    ]
    return "\n".join([*lines, *table(("parameter", "typical", "range", "enters at", "law", "source"), rows)])


def results() -> list[Path]:
    """Result pages of the studies."""
    return sorted((ROOT / RESULTS).glob("*.md"))


GENERATED = {
    "reference/cli.md": cli_page,
    "reference/api.md": api_page,
    "reference/schemas.md": schemas_page,
    "reference/all-effects.md": effects_page,
}


SECTIONS = {
    "Tutorials": "tutorials",
    "How-to": "how-to",
    "Reference": "reference",
    "Explanation": "explanation",
    "Evidence": "evidence",
}


def drawing() -> Any:
    """The module beside this one, which mkdocs does not find by its name."""
    spec = importlib.util.spec_from_file_location("drawing", Path(__file__).with_name("drawing.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def on_config(config: Any) -> Any:
    """The navigation: every page of each folder, after those that are made from the code."""
    nav: list[Any] = ["README.md"]
    for title, folder in SECTIONS.items():
        made = [name for name in GENERATED if name.startswith(f"{folder}/")]
        written = [f"{folder}/{path.name}" for path in sorted((ROOT / "docs" / folder).glob("*.md"))]
        nav.append({title: [*made, *written]})
    nav[-1]["Evidence"].append({"Studies": [f"evidence/results/{path.name}" for path in results()]})
    nav.append({"Project": list(SHOWN.values())})
    config.nav = nav
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made, and those shown from elsewhere in the repository."""
    from mkdocs.structure.files import File

    for name, make in GENERATED.items():
        files.append(File.generated(config, name, content=make()))
    for name, shown in SHOWN.items():
        files.append(File.generated(config, shown, content=(ROOT / name).read_text(encoding="utf-8")))
    for path in results():
        text = path.read_text(encoding="utf-8")
        files.append(File.generated(config, f"evidence/results/{path.name}", content=text))
    for path in sorted((ROOT / RESULTS).glob("*.png")):
        files.append(File.generated(config, f"evidence/results/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn links between files of the repository into links of the site."""
    source = page.file.src_uri
    home = {shown: name for name, shown in SHOWN.items()}.get(source, f"docs/{source}")
    if source.startswith("evidence/results/"):
        home = RESULTS + posixpath.basename(source)

    def link(match: re.Match[str]) -> str:
        words, target, anchor = match[2], match[3], match[4] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(home), target))
        if path == "docs/schemas":
            path = "docs/reference/schemas.md"
        if path.startswith(RESULTS):
            path = f"docs/evidence/results/{posixpath.basename(path)}"
        path = f"docs/{SHOWN[path]}" if path in SHOWN else path
        if path == "README.md":
            path = "docs/README.md"
        inside = path.removeprefix("docs/")
        if inside == path or files.get_file_from_path(inside) is None:
            return words if words.startswith("`") else f"{words} (`{path}`)"
        return f"{match[1]}[{words}]({posixpath.relpath(inside, posixpath.dirname(source) or '.')}{anchor})"

    markdown = re.sub(
        r"```mermaid\n(.*?)```", lambda found: drawing().svg(found[1]), markdown, flags=re.DOTALL
    )
    return re.sub(r"(!?)\[([^\[\]]+)\]\((?!https?:|mailto:|#)([^)#\s]+)(#[^)\s]*)?\)", link, markdown)
