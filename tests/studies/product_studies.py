"""Studies of the product as a whole: logs and their readers, the first hour, attacks on it."""

from __future__ import annotations

from tests.studies.study import OUT, Study, module

PRODUCT = (
    Study(
        "good_logs",
        "Do the log checks offer repairs for logs in which nothing is wrong?",
        module("good_logs", "--out", OUT),
        5,
        {
            "field_logs_changed": r"field logs \d+, of which a repair would change (\d+)",
            "runs_changed": r"simulated runs \d+, of which a repair would change (\d+)",
        },
        spread=True,
    ),
    Study(
        "first_hour",
        "How long is each step of the first hour, does it work after `pip install .`, and how large is it?",
        module("first_hour", "--out", OUT),
        6,
        {
            **{
                f"{step}_s": rf"{step} +[\d.]+ +([\d.]+)"
                for step in ("install", "help", "self_check", "demo", "inspect", "replay", "python", "init")
            },
            "installed_mb": r"installed (\d+) MB",
            "failed": r"steps that failed: (\d+)",
        },
        picture="report.png",
    ),
    Study(
        "ice_picture",
        "What does a real robot on ice do without GNSS, with fixed and with adaptive weights?",
        module("ice_picture", "--out", OUT),
        4,
        {
            "drives": r"median of (\d+)",
            "fixed_m": r"median of \d+: fixed ([\d.]+)",
            "adaptive_m": r"median of \d+: .*adaptive ([\d.]+) m",
            "won": r"median of .*adaptive better in (\d+)",
        },
        picture="ice_picture.png",
    ),
    Study(
        "fuzz",
        "Does any input of readers, YAML, live API or command line end in a crash or a hang?",
        module("fuzz", "--readers", "5000", "--yaml", "4500", "--live", "200", "--cli", "300", "--out", OUT),
        12,
        {"cases": r"all (\d+) cases", "defects": r"all \d+ cases, defects (\d+)"},
    ),
    Study(
        "fuzz_guided",
        "Do inputs that reach new lines of the readers lead to a crash or a hang?",
        module("fuzz_guided", "--cases", "1000", "--out", OUT),
        5,
        {
            "cases": r"all (\d+) cases",
            "defects": r"all \d+ cases, defects (\d+)",
            "blind": r"blind .*?(\d+) lines",
            "guided": r"guided .*?(\d+) lines",
        },
    ),
    Study(
        "fault_matrix",
        "Do faults of sensors, clocks and links end in a crash, or in a wrong estimate that passes as good?",
        module("fault_matrix.matrix", "--cells", "1000", "--minutes", "120", "--out", OUT),
        35,
        {
            "cells": r"cells (\d+)",
            **{name: rf"{name} (\d+ of \d+)" for name in ("crash", "hang", "slow", "not_finite", "silent")},
            "good_refused": r"ok and yet not good (\d+ of \d+)",
        },
        spread=True,
    ),
    Study(
        "fault_matrix_judged",
        "Does a wrong estimate pass as good where faults set no rule of the verdict?",
        module("fault_matrix.matrix", "--first", "1000", "--cells", "200", "--minutes", "60", "--out", OUT),
        8,
        {
            "cells": r"cells (\d+)",
            "silent": r"silent (\d+ of \d+)",
            "good_refused": r"ok and yet not good (\d+ of \d+)",
            "named_by_check": r"- (\d+) cells in which a log check alone names a fault",
        },
        spread=True,
    ),
    Study(
        "kills",
        "Does a command that is killed, or a machine in trouble, leave half a result that passes for whole?",
        module("kills.kills", "--out", OUT),
        40,
        {
            **{name: rf"{name} (\d+)$" for name in ("kills", "defects", "troubles")},
            "odd_troubles": r"troubles that end oddly (\d+)",
        },
    ),
    Study(
        "mutation",
        "Do the tests notice when a number or an operator of the core is changed?",
        module("mutation", "--mutants", "12", "--out", OUT),
        20,
        {"mutants": r"mutants (\d+),", "noticed": r"mutants \d+, noticed (\d+)"},
    ),
    Study(
        "branch_coverage",
        "Which share of the lines and branches of the three packages do the tests run?",
        module("branch_coverage", "--jobs", "2", "--out", OUT),
        30,
        {package: rf"{package}: ([\d.]+ %)" for package in ("datasets", "twin", "fusion")},
    ),
    Study(
        "soak",
        "Do memory, computing time and snapshots stay bounded over hours of live data?",
        module("soak", "--hours", "3"),
        12,
        {
            f"{key}_{what}": rf"{name}: .*{pattern}"
            for key, name in (("self", "self-calibration"), ("states", "calibration states"))
            for what, pattern in (
                ("hours", r"hours ([\d.]+)"),
                ("mb", r"grown (-?[\d.]+) MB"),
                ("p99", r"ratio ([\d.]+)"),
                ("snapshot_kb", r"largest (\d+) kB"),
                ("targets", "targets (met|missed)"),
            )
        },
    ),
    Study(
        "survey",
        "Do the public recordings hold what their publishers say of them?",
        module("survey.survey"),
        3,
    ),
    Study(
        "bag_speed",
        "How long does a bag of a million messages take to read, beside rosbags' own reader?",
        ("tests/datasets/bench_bags.py",),
        3,
    ),
)
