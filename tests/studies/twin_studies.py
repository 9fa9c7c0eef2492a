"""Studies of the twin and of the diagnosis."""

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


TWIN = (
    Study(
        "gap_other_drives",
        "Does the diagnosis hold on drives that its references did not make?",
        module("gap_other_drives", "--out", OUT),
        6,
        {
            "alarms": r"false alarms (\d+ of \d+)",
            "detected": r"detected (\d+ of \d+)",
            "named": r"right effect in a named class (\d+ of \d+)",
        },
        spread=True,
    ),
    Study(
        "unseen_gap",
        "Does the diagnosis see and name changes of robots that no part of the library made?",
        module("unseen_gap.study", "--out", OUT, "--first-seed", "142", "--robots", "2"),
        25,
        {
            "alarms": r"false alarms, same drives: (\d+ of \d+)",
            "alarms_other": r"false alarms, other drives: (\d+ of \d+)",
            "large": r"large, detected: (\d+ of \d+)",
            "large_named": r"large, right effect in a named set: (\d+ of \d+)",
            "small": r"small, detected: (\d+ of \d+)",
            "small_named": r"small, right effect in a named set: (\d+ of \d+)",
        },
        spread=True,
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
        "coverage",
        "Do two sigma of `calibrate` hold the true number?",
        module("coverage", "--out", OUT),
        15,
        {"within_2_sigma_percent": r"all +\d+ +([\d.]+) %"},
        spread=True,
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
        "source_study",
        "Does the twin reproduce the source study?",
        module("source_study.command", "--out", OUT),
        8,
        {
            **{word: rf"- of all claims .*?(\d+) {word}" for word in ("agree", "partly", "disagree")},
            **{
                f"predicted_{word}": rf"- of those neither .*?(\d+) {word}"
                for word in ("agree", "partly", "disagree")
            },
            **{
                f"tab4_{terrain}": rf"quoted of {terrain}: (.*)"
                for terrain in ("mud", "loose_sand", "medium_sand")
            },
        },
        spread=True,
    ),
    Study(
        "effect_sweep",
        "Which effects does the diagnosis see in the twin's own runs, and at what size?",
        module("effect_sweep", "--out", OUT),
        20,
        spread=True,
    ),
    Study(
        "fault_injection",
        "Does the diagnosis name known changes that are put into real logs?",
        module("fault_injection.table", "--out", OUT),
        60,
        spread=True,
    ),
    Study(
        "field_nulls",
        "Does the diagnosis alarm on real logs that nothing was done to?",
        module("fault_injection.table", "--out", OUT, "--unchanged"),
        6,
        {"alarms": r"Alarms on unchanged segments: (.*)"},
        spread=True,
    ),
    Study(
        "effective_track",
        "Which track do wheels and gyro of a skid-steered robot imply on each ground?",
        module("effective_track", f"{DATA}/husky_parkinglot/test1.bag", "--vehicle", "husky"),
        1,
    ),
    Study(
        "course_lag",
        "By how much does the course of a robot that skids follow its heading?",
        module("course_lag"),
        1,
        {
            "asphalt": r"warthog on asphalt: (.*? s),",
            "gravel": r"warthog on gravel: (.*? s),",
            "ice": r"warthog on ice: (.*? s),",
            "husky": r"husky on unlabelled ground: (.*? s),",
        },
    ),
    Study(
        "gap_sites",
        "Does the diagnosis hold on ground that varies more than the references'?",
        module("gap_sites", "--out", OUT),
        3,
        {
            "alike": r"false alarms, ground as the references': (\d+ of \d+)",
            "patchier": r"false alarms, ground patchier: (\d+ of \d+)",
        },
        spread=True,
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
            "4211",
            "--minutes",
            "40",
            "--no-opponent",
            "--out",
            OUT,
        ),
        40,
        {
            "trials": r"(\d+ of \d+) trials",
            "plant": r".* trials of plant (\w+)",
            **{key: rf"{name} {{2,}}((?:\S+ )*?\S+)(?: {{2,}}|$)" for key, name in BLIND_FIGURES.items()},
        },
        spread=True,
    ),
    Study(
        "blind_plant",
        "How far do plant and twin lie apart without noise or effects?",
        module("blind.plant_against_twin"),
        1,
    ),
)
