"""`terrafusion calibrate --sensors`: its file, its words, its errors."""

from __future__ import annotations

import shutil
from pathlib import Path

from terrafusion.twin.model.vehicle import load_vehicle


def test_file_and_words(terrafusion, good_log: Path, tmp_path: Path) -> None:
    out = tmp_path / "my_robot.yaml"
    done = terrafusion("calibrate", good_log, "--sensors", "--out", out)
    assert done.status == 0, done.err
    assert "gained" in done.out
    assert "not observable in these logs: " in done.out
    assert f"written to {out}" in done.out
    known = load_vehicle(out).robot
    assert known.antenna_m is not None
    assert known.wheel_delay_s is not None
    assert known.wheel_delay_s.known == "assumed"
    again = terrafusion("replay", good_log, "--vehicle", out, "--out", tmp_path / "replay")
    assert again.status == 0, again.err


def test_errors_are_one_line(terrafusion, good_log: Path, tmp_path: Path) -> None:
    blind = Path(shutil.copytree(good_log, tmp_path / "blind"))
    (blind / "gnss.csv").unlink()
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("robot: {antenna: 3}\n")
    out = tmp_path / "my.yaml"
    for words, told in (
        ((blind, "--out", out), "none of the logs has fixes"),
        ((good_log, "--vehicle", wrong, "--out", out), "unknown key 'robot.antenna'"),
        ((good_log, "--out", tmp_path / "fit"), "--out is no YAML file"),
        ((good_log, "--vehicle", "nobody", "--out", out), "unknown vehicle 'nobody'"),
    ):
        done = terrafusion("calibrate", *words, "--sensors")
        assert done.status == 1, words
        assert told in done.err
        assert done.err.count("\n") == 1
    for option, value in (
        ("--parameters", "soil.x"), ("--input", "wheels"), ("--window-s", 5), ("--slope-deg", 3),
        ("--aspect-deg", 90), ("--payload-kg", 10),
    ):  # fmt: skip
        mixed = terrafusion("calibrate", good_log, "--sensors", option, value, "--out", out)
        assert mixed.status == 2, option
        assert f"{option}: does not go with --sensors" in mixed.err
    assert not out.exists()
