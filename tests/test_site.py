"""The documentation builds without a warning, holds what the code holds, and asks nothing from outside."""

from __future__ import annotations

import html
import importlib.util
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from typer.main import get_command

import terrafusion
from terrafusion.fusion.cli.main import app
from terrafusion.twin.effects import catalogue

ROOT = Path(__file__).parents[1]
TOOLS = ("mkdocs", "material", "mkdocstrings_handlers.python")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if any(importlib.util.find_spec(name.partition(".")[0]) is None for name in TOOLS):
        pytest.skip("the site needs the extra `docs`: pip install '.[docs]'")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert built.returncode == 0, built.stdout + built.stderr
    return out


def words_of(page: Path) -> str:
    return html.unescape(re.sub(r"<[^>]+>", "", page.read_text(encoding="utf-8")))


def test_the_command_line_is_whole(site: Path) -> None:
    """Every command and every option of its parser."""
    text = words_of(site / "reference" / "cli.html")
    for name, command in get_command(app).commands.items():  # type: ignore[attr-defined]
        assert f"terrafusion {name}" in text, name
        for parameter in getattr(command, "params", []):
            if not getattr(parameter, "hidden", False) and parameter.opts[0].startswith("--"):
                assert parameter.opts[0] in text, (name, parameter.opts)


def test_every_public_name_has_its_docstring(site: Path) -> None:
    text = words_of(site / "reference" / "api.html")
    for name in terrafusion.__all__:
        if name == "__version__":
            continue
        assert f"tf.{name}" in text, name
        first = (getattr(terrafusion, name).__doc__ or "").strip().partition("\n")[0].partition("`")[0]
        assert first in text, (name, first)


def test_schemas_and_effects_are_whole(site: Path) -> None:
    schemas = words_of(site / "reference" / "schemas.html")
    for path in (ROOT / "docs" / "schemas").iterdir():
        assert path.name in schemas
        assert (site / "schemas" / path.name).is_file()
    assert "wheel_radius_m" in schemas
    assert "sensor axes that point along body x" in schemas
    assert "Attributes:" not in schemas
    effects = words_of(site / "reference" / "all-effects.html")
    for form in catalogue.built_in().values():
        assert " ".join(form.equation.replace("`", "").split()) in " ".join(effects.split()), form.key
        for parameter in form.parameters:
            assert (
                f"{form.parameter_key(parameter)}\n{parameter.scale:g} {parameter.unit}".rstrip() in effects
            )


def test_the_architecture_is_a_drawing(site: Path) -> None:
    """Each package of the chart is a box with its name."""
    page = (site / "explanation" / "architecture.html").read_text(encoding="utf-8")
    names = re.findall(
        r"^ +\w+\[(\w+)\]$", (ROOT / "docs/explanation/architecture.md").read_text("utf-8"), re.M
    )
    assert len(names) > 30
    drawing = page[page.index("<svg viewBox") : page.index("</svg>", page.index("<svg viewBox"))]
    assert drawing.count("<rect") >= len(names)
    for name in names:
        assert f">{name}</text>" in drawing, name


def test_no_page_asks_anything_from_outside(site: Path) -> None:
    """Links may lead out; scripts, styles, pictures and fonts lie in the site."""
    asking = re.compile(r"<(?:script|img|iframe|source)\b[^>]*?src=[\"']?(?:https?:)?//[^\"' >]*")
    styles = re.compile(
        r"<link\b[^>]*?rel=[\"']?(?:stylesheet|preconnect|icon)[^>]*?href=[\"']?(?:https?:)?//"
    )
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not asking.search(text), page.name
        assert not styles.search(text), page.name
        assert 'class="mermaid"' not in text, "a drawing whose program would be fetched from outside"
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:@import|url\()\s*[\"']?(?:https?:)?//", style.read_text("utf-8")), (
            style.name
        )


def test_the_source_distribution_holds_the_site_and_makes_the_same_wheel(site: Path, tmp_path: Path) -> None:
    """What `make dist` does, in a copy: the wheel made from the archive has every file of the packages."""
    tree, out = tmp_path / "tree", tmp_path / "dist"
    left_out = shutil.ignore_patterns(
        ".*", "build", "dist", "demo-out", "studies-work", "__pycache__", "*.egg-info"
    )
    shutil.copytree(ROOT, tree, ignore=left_out)
    shutil.copytree(site, tree / "site", dirs_exist_ok=True)
    command = [sys.executable, "-m", "build", "--outdir", str(out), str(tree)]
    built = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert built.returncode == 0, built.stdout[-2000:] + built.stderr[-2000:]
    (archive,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    with tarfile.open(archive) as opened:
        held = {name.partition("/")[2] for name in opened.getnames()}
    assert {"site/index.html", "site/reference/cli.html", "tests/conftest.py", "docs/README.md"} <= held
    with zipfile.ZipFile(wheel) as opened_wheel:
        installed = set(opened_wheel.namelist())
    for top in ("datasets", "twin", "fusion"):
        for path in (ROOT / top).rglob("*"):
            if path.is_file() and path.suffix != ".pyc":
                place = "terrafusion/" + path.relative_to(ROOT).as_posix().removeprefix("fusion/_root/")
                assert place in installed, place
