"""Wrong words on the command line, and bags that are none: exit status 1 or 2, one line, no traceback."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("quick")

ENTRY = "from terrafusion.fusion.cli.main import main; main()"

OUTAGES = (
    "soon",
    "12",
    ":",
    "5:",
    ":5",
    "-5:10",
    "5:0",
    "5:-1",
    "nan:5",
    "5:inf",
    "1e999:5",
    "1:2:3",
)

BAD_WORDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "missing file": ("replay gone.bag --out results", ("gone.bag", "no such file", "check the path")),
    "missing folder": ("inspect gone", ("gone", "no such file")),
    "empty bag": ("replay empty.bag --out results", ("empty.bag", "empty", "again")),
    "empty mcap": ("replay empty.mcap --out results", ("empty.mcap", "empty")),
    "text as bag": ("replay text.bag --out results", ("text.bag", "cannot be read as a ROS bag", "copy")),
    "text as mcap": ("replay text.mcap --out results", ("text.mcap", "cannot be read", "mcap recover")),
    "text as db3": ("replay text.db3 --out results", ("text.db3",)),
    "zeros as bag": ("replay magic.bag --out results", ("magic.bag",)),
    "zeros as mcap": ("replay magic.mcap --out results", ("magic.mcap",)),
    "no log folder": ("replay folder --out results", ("folder", "no meta.yaml")),
    "broken ROS 2 folder": ("replay ros2 --out results", ("ros2", "cannot be read")),
    "unknown kind": ("replay notes.txt --out results", ("notes.txt", "unknown kind", "log folder")),
    "a device": ("inspect /dev/null", ("/dev/null",)),
    "unknown vehicle": (
        "replay LOG --vehicle tank --out results",
        ("unknown vehicle 'tank'", "known are", "husky"),
    ),
    "vehicle file is gone": ("replay LOG --vehicle my.yaml --out results", ("my.yaml", "no such file")),
    "vehicle file is a folder": ("replay LOG --vehicle folder --out results", ("'folder'", "known are")),
    "policy is gone": ("replay LOG --policy my.yaml --out results", ("my.yaml", "no such file")),
    "policy is a text": ("replay LOG --policy notes.txt --out results", ("notes.txt", "mapping")),
    "policy is a log's meta": ("replay LOG --policy LOG/meta.yaml --out results", ("meta.yaml",)),
    "outage after the end": (
        "replay LOG --out results --gnss-outage 1000:10",
        ("outage", "1000", "after the end", "lasts 26"),
    ),
    "results into a file": ("replay LOG --out notes.txt", ("notes.txt", "folder")),
    "results below a file": ("replay LOG --out notes.txt/results", ("notes.txt", "choose a folder")),
    "results into proc": ("replay LOG --out /proc/results", ("/proc/results", "cannot be written")),
    "demo into a file": ("demo --out notes.txt", ("notes.txt", "choose a folder")),
    "demo into proc": ("demo --out /proc/demo", ("/proc/demo", "cannot be written")),
    "demo, negative seed": ("demo --out d --seed=-1", ("seed", "-1")),
    "simulate into a file": ("simulate straight --out notes.txt", ("notes.txt", "folder")),
    "simulate onto an mcap": ("simulate straight --out empty.mcap", ("empty.mcap", "exists")),
    "simulate into proc": ("simulate straight --out /proc/run", ("/proc/run", "cannot be written")),
    "simulate into another folder": ("simulate straight --out ros2", ("ros2", "not empty")),
    "unknown scenario": ("simulate moonwalk --out s", ("unknown scenario 'moonwalk'", "paper_profile")),
    "scenario is a text": ("simulate notes.txt --out s", ("notes.txt", "mapping")),
    "unknown terrain": ("simulate straight --terrain lava --out s", ("'lava'", "loose_sand")),
    "steep": ("simulate straight --slope-deg 40 --out s", ("slope", "40", "25")),
    "slope nan": ("simulate straight --slope-deg nan --out s", ("slope", "nan")),
    "negative payload": ("simulate straight --payload-kg=-5 --out s", ("payload", "-5")),
    "heavy payload": ("simulate straight --payload-kg 5000 --out s", ("payload", "5000")),
    "negative seed": ("simulate straight --seed=-1 --out s", ("seed", "-1")),
    "unknown vehicle to simulate": ("simulate straight --vehicle tank --out s", ("'tank'", "elevate")),
    "unknown topic": ("convert notes.txt x", ("notes.txt", "unknown kind")),
    "convert into a file": ("convert LOG notes.txt", ("notes.txt", "folder")),
    "convert onto an mcap": ("convert LOG empty.mcap", ("empty.mcap", "exists")),
    "convert below a file": ("convert LOG notes.txt/a.mcap", ("notes.txt", "cannot be written")),
}


@pytest.mark.usefixtures("odd_files")
@pytest.mark.parametrize("case", BAD_WORDS)
def test_bad_words(case: str, good_log: Path, terrafusion) -> None:
    line, words = BAD_WORDS[case]
    outcome = terrafusion(*line.replace("LOG", str(good_log)).split())
    assert outcome.refused(*words)
    assert "Traceback" not in outcome.out


def test_a_bag_cut_off_before_its_first_message(husky_bag: Path, tmp_path: Path, terrafusion) -> None:
    (tmp_path / "cut.bag").write_bytes(husky_bag.read_bytes()[:147])
    outcome = terrafusion("replay", "cut.bag", "--vehicle", "husky", "--out", "results")
    assert outcome.refused("cut.bag", "copy it again")
    assert not (tmp_path / "results").exists()


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize(
    ("share", "words"), [(0.1, "replay cut.bag --vehicle husky --out results"), (1.0, "convert cut.bag log")]
)
def test_truncated_bag(share: float, words: str, husky_bag: Path, tmp_path: Path, terrafusion) -> None:
    data = husky_bag.read_bytes()
    (tmp_path / "cut.bag").write_bytes(data[: min(int(share * len(data)), len(data) - 10)])
    outcome = terrafusion(*words.split())
    assert outcome.status == 0, outcome
    assert "warning: cut.bag: cut.bag is cut off" in outcome.err
    assert "its data end at t = " in outcome.err


@pytest.mark.parametrize(("channel", "told"), [("wheels", "no wheel speeds")])
def test_bag_without_a_channel(channel: str, told: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    shutil.copytree(good_log, tmp_path / "log")
    (tmp_path / "log" / f"{channel}.csv").unlink()
    assert terrafusion("convert", "log", "part.mcap").status == 0
    outcome = terrafusion("replay", "part.mcap", "--vehicle", "elevate", "--out", "results")
    assert outcome.refused("part.mcap", channel, told)


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize(("share", "status"), [(0.0005, 1), (0.1, 1), (0.5, 0), (1.0, 0)])
def test_truncated_mcap(share: float, status: int, good_log: Path, tmp_path: Path, terrafusion) -> None:
    """What is complete is read; a tenth has no complete chunk."""
    assert terrafusion("convert", good_log, "whole.mcap").status == 0
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: min(int(share * len(data)), len(data) - 10)])
    outcome = terrafusion("replay", "cut.mcap", "--vehicle", "elevate", "--out", "results")
    if status:
        assert outcome.refused("cut.mcap", "copy it again")
    else:
        assert outcome.status == 0, outcome
        assert "cut.mcap is cut off (it has no footer): its data end at t = " in outcome.err


@pytest.mark.parametrize("words", [
    "replay LOG --out r --mode magic", "replay LOG --out r --colour red", "replay", "fly",
    "simulate straight --out s --seed many", "simulate straight --out s --slope-deg up",
    "replay LOG --out r --stamps arrival", "replay LOG --out r --topic imu", "convert LOG", "demo extra",
])  # fmt: skip
def test_wrong_usage_is_status_2(words: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    outcome = terrafusion(*words.replace("LOG", str(good_log)).split())
    assert outcome.status == 2, outcome
    assert "Traceback" not in outcome.err
    assert outcome.err.strip()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", OUTAGES)
def test_a_malformed_outage_is_wrong_usage(text: str, good_log: Path, tmp_path: Path, terrafusion) -> None:
    outcome = terrafusion("replay", good_log, "--out", "results", f"--gnss-outage={text}")
    assert outcome.status == 2, outcome
    assert outcome.err.count("\n") == 1
    assert all(word in outcome.err for word in (f"'{text}'", "--gnss-outage", "START:SECONDS"))
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("odd_files")
@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("replay gone.bag --out results", 1),
        ("replay text.bag --out results", 1),
        ("replay LOG --out results --gnss-outage=soon", 2),
        ("replay LOG --out results --mode magic", 2),
    ],
)
def test_as_the_shell_sees_it(line: str, status: int, good_log: Path, tmp_path: Path) -> None:
    words = line.replace("LOG", str(good_log)).split()
    done = subprocess.run(
        [sys.executable, "-c", ENTRY, *words], capture_output=True, text=True, timeout=60, check=False,
        cwd=tmp_path, env=os.environ | {"PYTHONWARNINGS": "default"},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (status, "")
    assert "Traceback" not in done.stderr
    if status == 1:
        assert done.stderr.startswith("error: ")
        assert all(": " in line for line in done.stderr.splitlines())  # one line an error
