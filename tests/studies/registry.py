"""Every experiment whose figures the documents quote: what it asks, how it is run, which figures it gives.

A study is a command. What it prints is its table; figures are read from it by patterns, as they are printed.
"""

from __future__ import annotations

from tests.studies.study import DATA, OUT, Study, module

BLIND_FIGURES = {
    "alarms": "false alarms, same drives", "alarms_other": "false alarms, other drives",
    "power_5": "power at d' 5", "power_10": "power at d' 10", "power_25": "power at d' 25",
    "power_other": "power on other drives, d' 10 and 25",
    "right_same": "right and not unknown, same form", "right_shifted": "right and not unknown, form-shifted",
    "right_other": "right and not unknown, other drives",
    "set_same": "mean credible set, same form", "set_shifted": "mean credible set, form-shifted",
    "top1_same": "class top-1, same form", "top1_shifted": "class top-1, form-shifted",
    "top3_same": "class top-3, same form", "top3_shifted": "class top-3, form-shifted",
    "ece_same": "ECE, same form", "ece_shifted": "ECE, form-shifted",
    "unknown": "unknown recall", "false_unknown": "false unknown",
    "pairs": "both of a pair, each seen alone", "extras": "false extras a pair",
    "sizes": "size within 2 sigma", "shrink": "shrink over the oracle's",
    "seconds": "CPU seconds a data set, median",
}  # fmt: skip
"""Rows of the headline of `gap-blind`, by the name under which the page quotes them."""


STUDIES = (
    Study(
        "good_logs",
        "Do the log checks offer repairs for logs in which nothing is wrong?",
        module("good_logs"),
        5,
        {
            "field_logs_changed": r"field logs \d+, of which a repair would change (\d+)",
            "runs_changed": r"simulated runs \d+, of which a repair would change (\d+)",
        },
    ),
    Study(
        "first_hour",
        "How long is each step of the first hour, does it work after `pip install .`, and how large is it?",
        module("first_hour"),
        6,
        {
            **{
                f"{step}_s": rf"{step} +[\d.]+ +([\d.]+)"
                for step in ("install", "help", "self_check", "demo", "inspect", "replay", "python", "init")
            },
            "installed_mb": r"installed (\d+) MB",
            "failed": r"steps that failed: (\d+)",
        },
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
        module(
            "fuzz", "--readers", "4000", "--yaml", "2000", "--live", "2000", "--cli", "2000", "--out", OUT
        ),
        40,
        {"cases": r"all (\d+) cases", "defects": r"all \d+ cases, defects (\d+)"},
    ),
    Study(
        "fault_matrix",
        "Do faults of sensors, clocks and links end in a crash, or in a wrong estimate that passes as good?",
        module("fault_matrix.matrix", "--cells", "1000", "--seconds", "7200", "--out", OUT),
        35,
        {
            "cells": r"cells (\d+)",
            **{name: rf"{name} (\d+ of \d+)" for name in ("crash", "hang", "slow", "not_finite", "silent")},
            "good_refused": r"ok and yet not good (\d+ of \d+)",
        },
    ),
    Study(
        "fault_matrix_late",
        "Do sensors that are late or swapped pass as good on cells that no rule was set on?",
        module(
            "fault_matrix.matrix",
            "--first",
            "640",
            "--cells",
            "360",
            "--faults",
            "lag",
            "swapped",
            "--out",
            OUT,
        ),
        3,
        {
            "cells": r"cells (\d+)",
            **{name: rf"{name} (\d+ of \d+)" for name in ("crash", "hang", "slow", "not_finite", "silent")},
        },
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
        "demo_seeds",
        "What do adaptive weights gain over fixed ones on drives of the twin, over ten seeds?",
        module("demo_seeds", "--seeds", "10"),
        12,
        {
            f"{drive}_{mode}_{what}": rf"{drive} +{mode}" + r" +[\d.]+" * i + r" +([\d.]+)"
            for drive in ("demo", "mixed_terrain", "paper_profile", "figure_eight")
            for mode in ("fixed", "adaptive")
            for i, what in enumerate(("ate_m", "median_m", "end_m"))
        }
        | {
            f"{drive}_ratio": rf"{drive}, adaptive over fixed at the end: ([\d.]+ \[[\d.]+, [\d.]+\])"
            for drive in ("demo", "mixed_terrain", "paper_profile", "figure_eight")
        },
    ),
    Study(
        "outage_causes",
        "What makes the error at the end of the demo's outage, and of mixed ground in the benchmark?",
        module("outage_causes", "--arms", "fixed;adaptive"),
        8,
        {f"{f}_ratio": rf"{f} adaptive +[\d.]+ +([\d.]+ \[[\d.]+, [\d.]+\])" for f in ("demo", "mixed")},
    ),
    Study(
        "gap_other_drives",
        "Does the diagnosis hold on drives that its references did not make?",
        module("gap_other_drives"),
        6,
        {
            "alarms": r"false alarms (\d+ of \d+)",
            "detected": r"detected (\d+ of \d+)",
            "named": r"right effect in a named class (\d+ of \d+)",
        },
    ),
    Study(
        "engine_accuracy",
        "How accurate is the twin's integrator at its own step?",
        module("engine_accuracy"),
        1,
        {"parked_creep_mud_mmps": r"parked on .*mud ([\d.]+)"},
    ),
    Study(
        "engine_speed",
        "How fast is the twin, beside other ways to integrate the same drive?",
        module("engine_speed"),
        3,
        {
            "run_300_s": r"one run of 300 s +([\d.]+) s",
            "batch_s": r"1000 runs of 60 s, 2 threads +([\d.]+) s",
        },
    ),
    Study(
        "estimator_speed",
        "How long does the estimator compute, live and in batch, beside GTSAM's own optimisers?",
        module("speed.speed"),
        3,
    ),
    Study(
        "coverage",
        "Do two sigma of `calibrate` hold the true number?",
        module("coverage"),
        15,
        {"within_2_sigma_percent": r"all +\d+ +([\d.]+) %"},
    ),
    Study(
        "single_wheel",
        "Does the wheel model predict forces on a measured wheel that it was not fitted to?",
        module("twin_field.single_wheel", f"{DATA}/cmu_single_wheel/all_smooth_data.mat", "--out", OUT),
        1,
        {
            "along": r"halves +fitted +R2 ([\d.]+)",
            "across": r"halves +fitted +R2 [\d.]+ from .*? R2 ([\d.]+)",
            "linear_along": r"halves +linear +R2 ([\d.]+)",
            "linear_across": r"halves +linear +R2 [\d.]+ from .*? R2 ([\d.]+)",
        },
        "single_wheel.png",
    ),
    Study(
        "twin_field",
        "Does the twin predict measured drives better than kinematic models?",
        module("twin_field.compare_drives", DATA, "--out", OUT),
        20,
    ),
    Study(
        "survey",
        "Do the public recordings hold what their publishers say of them?",
        module("survey.survey"),
        3,
    ),
    Study(
        "source_study",
        "Does the twin reproduce the source study?",
        ("terrafusion", "study", "--out", OUT),
        8,
        {
            "agree": r".*?(\d+) agree",
            "partly": r".*?(\d+) partly",
            "disagree": r".*?(\d+) disagree",
        },
    ),
    Study(
        "slip",
        "How far off is the estimated slip, and how late is immobilisation seen?",
        module("slip_trials"),
        30,
        {
            f"{ground}_{what}": rf" *{ground} \d+ deg:" + (r" [\d.]+," if i else "") + r" ([\d.]+)"
            for ground in ("mud", "loose_sand", "medium_sand", "asphalt")
            for i, what in enumerate(("filtered", "smoothed"))
        },
    ),
    Study(
        "calibration_states",
        "Does the estimator find wrong numbers of the vehicle file while it drives?",
        module("calibration_trials"),
        20,
    ),
    Study(
        "twin_consistency",
        "Are NEES and NIS in their bands on every ground of the twin?",
        module("twin_consistency"),
        15,
    ),
    Study(
        "field_table",
        "How do the modes compare on every field log, with fixes and in outages?",
        module("field_table.table", "--out", OUT, "--starts", "6", "--seeds", "3", "--jobs", "2"),
        240,
        picture="field_table.png",
    ),
    Study(
        "opponents",
        "Are errors in outages smaller than those of an EKF, a GTSAM smoother and an INS, tuned alike?",
        module("opponents.table", "--out", OUT, "--jobs", "2"),
        240,
        {
            f"{mode}_{what}_{seconds}_s": rf"{mode}, {known}, {seconds} s: ([\d.]+)"
            for mode in ("fixed", "adaptive")
            for what, known in (("log", "vehicle of the log"), ("unknown", "wheel radius and track alone"))
            for seconds in (10, 30, 60)
        }
        | {
            "over_ekf": r"adaptive / EKF, vehicle of the log: ([\d.]+)",
            "over_ekf_interval": r"adaptive / EKF, vehicle of the log: ([\d.]+ \[[\d.]+, [\d.]+\])",
            "lost_to_ekf": r"adaptive / EKF, vehicle of the log: .*lost (\d+ of \d+)",
        },
        "opponents.png",
    ),
    Study(
        "unseen_robots",
        "Are errors in outages smaller than a plain EKF's on robots that no part of the library made?",
        module("unseen_robots.study", "--out", OUT),
        15,
        {
            f"{mode}_{seconds}_s": rf"{mode} over EKF, {seconds} s: ([\d.]+ \[[\d.]+, [\d.]+\])"
            for mode in ("fixed", "adaptive")
            for seconds in (10, 30)
        }
        | {
            f"{mode}_{seconds}_s_lost": rf"{mode} over EKF, {seconds} s: .* lost (\d+ of \d+)"
            for mode in ("fixed", "adaptive")
            for seconds in (10, 30)
        }
        | {
            f"inside_{seconds}_s": rf"adaptive over EKF, {seconds} s: .* ellipses (\d+ %)"
            for seconds in (10, 30)
        }
        | {
            f"{number}_held": rf"{number}: within 2 sigma (\d+ of \d+)"
            for number in ("antenna_x_m", "gnss_delay_s", "imu_yaw_rad", "wheel_scale")
        },
    ),
    Study(
        "coarse_slides",
        "What does watching the receiver's drift gain on ground that slips, with coarse fixes?",
        module("coarse_slides"),
        5,
        {
            "judged": r"judged: .* logs: ([\d.]+ \[[\d.]+, [\d.]+\])",
            "developed": r"developed: .* logs: ([\d.]+ \[[\d.]+, [\d.]+\])",
        },
    ),
    Study(
        "outage_terms",
        "Which term of dead reckoning are errors after 10 s without fixes made of?",
        module("opponents.decompose"),
        5,
    ),
    Study(
        "grounds",
        "What does adaptive mode gain in outages on logs of one robot, and does memory know its grounds?",
        module("grounds"),
        8,
        {
            f"{group}_adaptive": rf"{group}, adaptive over fixed: ([\d.]+) "
            for group in ("slipping", "firm", "all", "ice", "loose_sand", "gravel", "grass")
        }
        | {"slipping_interval": r"slipping, adaptive over fixed: ([\d.]+ \[[\d.]+, [\d.]+\])"}
        | {
            f"memory_{ground}_right": rf"memory on {ground}: right (\d+ %)"
            for ground in ("asphalt", "grass", "gravel", "ice", "loose_sand")
        },
    ),
    Study(
        "ground_changes",
        "How soon is a change of ground noticed, and named, by a classifier of the robot's own grounds?",
        module("ground_changes"),
        3,
        {
            "macro_f1": r"macro-F1 ([\d.]+)",
            "ece": r"macro-F1 [\d.]+, ECE ([\d.]+)",
            "alarm_within_2_s": r"alarm within 2 s: (\d+ ?%)",
            "false_alarms": r"false alarms a minute: ([\d.]+)",
            "named_within_2_s": r"new ground named within 2 s: (\d+ ?%)",
            "named_after_s": r"new ground named after, median: ([\d.]+)",
        },
    ),
    Study(
        "slip_model",
        "Can wheels and IMU alone predict slip on a robot, soil or data set that nothing was fitted to?",
        module("slip_model.study"),
        5,
        {
            "drives": r"(\d+) drives of the twin",
        }
        | {
            f"fresh_{what}": r"twin, fresh drives +\d+ +" + r"[\d.]+ +" * i + r"([\d.]+)"
            for i, what in enumerate(("rmse", "constant", "own_past", "in_50", "in_95"))
        }
        | {
            f"{robot}_{what}": rf"real, {robot} +\d+ +" + r"[\d.]+ +" * i + r"([\d.]+)"
            for robot in ("warthog", "husky", "pathfinder")
            for i, what in enumerate(("rmse", "constant", "own_past", "in_50", "in_95"))
        }
        | {
            f"memory_{what}": r"own past, warthog +\d+ +" + r"[\d.]+ +" * i + r"([\d.]+)"
            for i, what in enumerate(("rmse", "constant", "own_past", "in_50", "in_95"))
        }
        | {
            f"slippery_{source}": rf"twin to {source} +\d+ runs: balanced accuracy [\d.]+ by window, ([\d.]+)"
            for source in ("norlab_drive", "borealtc")
        },
    ),
    Study(
        "slippery",
        "Is slippery ground told from firm on a robot left out, by features relative to the robot itself?",
        module("slip_model.slippery"),
        4,
        {
            f"{fit.split()[0]}_{source}": rf"{fit} to {source} +\d+ runs: .* by window, ([\d.]+) by run"
            for source in ("norlab_drive", "borealtc")
            for fit in ("twin", "other robot", "both")
        },
    ),
    Study(
        "known_changes",
        "What do known changes in real logs cost an estimator that is not told, and do ellipses hold?",
        module("known_changes.table", "--out", OUT, "--jobs", "2"),
        240,
        {"ratio": r"all changes, not told: ([\d.]+)"},
        "known_changes.png",
    ),
    Study(
        "benchmark",
        "What do adaptive weights gain over fixed and other baselines, in pairs of the same drives?",
        ("terrafusion", "benchmark", "--out", OUT),
        300,
        {
            f"{family}_{plant}_over_fixed": rf"\| {family}, {plant} (?:\|[^|]*){{5}}\| ([^|]+?) \|"
            for family, plant in (("mixed", "twin"), ("mixed", "second"), ("unseen", "second"))
        },
        picture="ratios.png",
    ),
    Study(
        "detector",
        "How well are grounds told apart, on fresh drives, with sensors missing, on grounds never seen?",
        ("terrafusion", "terrain", "eval"),
        20,
    ),
    Study(
        "effect_sweep",
        "Which effects does the diagnosis see in the twin's own runs, and at what size?",
        module("effect_sweep"),
        20,
    ),
    Study(
        "fault_injection",
        "Does the diagnosis name known changes that are put into real logs?",
        module("fault_injection.table", "--out", OUT),
        60,
    ),
    Study(
        "effective_track",
        "Which track do wheels and gyro of a skid-steered robot imply on each ground?",
        module("effective_track", f"{DATA}/husky_parkinglot/test1.bag", "--vehicle", "husky"),
        1,
    ),
    Study(
        "blind",
        "Does the diagnosis hold on a plant that is not the twin, with sealed labels?",
        (
            "terrafusion",
            "gap-blind",
            "--share",
            "0.25",
            "--seed",
            "28",
            "--minutes",
            "27",
            "--no-opponent",
            "--out",
            OUT,
        ),
        35,
        {
            "trials": r"(\d+ of \d+) trials",
            "plant": r".* trials of plant (\w+)",
            **{key: rf"{name} {{2,}}((?:\S+ )*?\S+)(?: {{2,}}|$)" for key, name in BLIND_FIGURES.items()},
        },
        "sheet.png",
    ),
    Study(
        "blind_plant",
        "How far do plant and twin lie apart without noise or effects?",
        module("blind.plant_against_twin"),
        1,
    ),
    Study(
        "bag_speed",
        "How long does a bag of a million messages take to read, beside rosbags' own reader?",
        ("tests/datasets/bench_bags.py",),
        3,
    ),
)
"""All of them, quick ones and long ones."""
