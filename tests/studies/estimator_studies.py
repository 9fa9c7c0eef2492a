"""Studies of the estimator: errors in outages, modes, grounds, consistency, speed."""

from __future__ import annotations

from tests.studies.study import OUT, Study, module

SHARES_OF_SLIP = ("in_50", "in_95", "following_50", "following_95")
"""Columns of the slip model's study: intervals as fitted, and those that follow the run."""

ESTIMATOR = (
    Study(
        "demo_seeds",
        "What do adaptive weights gain over fixed ones on drives of the twin, over ten seeds?",
        module("demo_seeds", "--seeds", "10", "--out", OUT),
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
        spread=True,
    ),
    Study(
        "found_grounds",
        "What do adaptive weights gain on several grounds with robots that no terrain model knows?",
        module("found_grounds", "--out", OUT),
        12,
        {
            f"{setting}_{mode}": rf"{setting} all +[\d.]+"
            + r" +[\d.]+ \[[\d.]+, [\d.]+\]" * i
            + r" +([\d.]+ \[[\d.]+, [\d.]+\])"
            for setting in ("mixed", "other_laws", "other_grounds", "coarse_fixes", "firm")
            for i, mode in enumerate(("adaptive", "memory", "told"))
        },
        spread=True,
    ),
    Study(
        "outage_causes",
        "What makes the error at the end of the demo's outage, and of mixed ground in the benchmark?",
        module("outage_causes", "--arms", "fixed;adaptive", "--out", OUT),
        8,
        {f"{f}_ratio": rf"{f} adaptive +[\d.]+ +([\d.]+ \[[\d.]+, [\d.]+\])" for f in ("demo", "mixed")},
        spread=True,
    ),
    Study(
        "estimator_speed",
        "How long does the estimator compute, live and in batch, beside GTSAM's own optimisers?",
        module("speed.speed"),
        3,
        {
            "keyframe_mean_ms": r"  keyframe, CPU : mean ([\d.]+)",
            "keyframe_p99_ms": r"  keyframe, CPU :.* p99 ([\d.]+)",
            "states_p99_ms": r"    keyframe, CPU :.* p99 ([\d.]+)",
            "live_pass_s": r"  batch: live pass [\d.]+ s wall, ([\d.]+)",
            "batch_s": r"  batch of \d{4} keyframes, ours: ([\d.]+)",
            "gtsam_batch_s": r"  batch of \d{4} keyframes, GTSAM GaussNewton[^:]*: ([\d.]+)",
        },
    ),
    Study(
        "slip",
        "How far off is the estimated slip, and how late is immobilisation seen?",
        module("slip_trials", "--out", OUT),
        30,
        {
            f"{ground}_{what}": rf" *{ground} \d+ deg:" + (r" [\d.]+," if i else "") + r" ([\d.]+)"
            for ground in ("mud", "loose_sand", "medium_sand", "asphalt")
            for i, what in enumerate(("filtered", "smoothed"))
        },
        spread=True,
    ),
    Study(
        "calibration_states",
        "Does the estimator find wrong numbers of the vehicle file while it drives?",
        module("calibration_trials", "--out", OUT),
        20,
        spread=True,
    ),
    Study(
        "twin_consistency",
        "Are NEES and NIS in their bands on every ground of the twin?",
        module("twin_consistency", "--out", OUT),
        15,
        spread=True,
    ),
    Study(
        "field_table",
        "How do the modes compare on every field log, with fixes and in outages?",
        module("field_table.table", "--out", OUT, "--starts", "6", "--seeds", "3", "--jobs", "2"),
        240,
        picture="field_table.png",
        spread=True,
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
            "ekf_tuned_by_this_rule": r"EKF tuned / best of the others and adaptive, 10 s: ([\d.]+)",
            "ins_by_this_rule": r"INS / best of the others and adaptive, 10 s: ([\d.]+)",
        },
        "opponents.png",
        spread=True,
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
        spread=True,
    ),
    Study(
        "unseen_starts",
        "Do errors soon after the start keep to sigma, on robots that no part of the library made?",
        module("unseen_robots.starts", "--out", OUT),
        10,
        {
            f"{name}_{warm_s}_s": rf"all, outage {warm_s} s .*{pattern}"
            for warm_s in (8, 20)
            for name, pattern in (
                ("over_ekf", r"over EKF ([\d.]+ \[[\d.]+, [\d.]+\])"),
                ("inside", r"95 % ellipses (\d+ %)"),
            )
        },
    ),
    Study(
        "unseen_slick",
        "What do adaptive weights gain on slick ground, on robots that no part of the library made?",
        module("unseen_robots.study", "--out", OUT, "--slick", "--seconds", "30"),
        15,
        {
            "adaptive_over_fixed": r"adaptive over fixed, 30 s: ([\d.]+ \[[\d.]+, [\d.]+\])",
            "worst": r"adaptive over fixed, 30 s: .* worst ([\d.]+)",
            "adaptive_over_ekf": r"adaptive over EKF, 30 s: ([\d.]+ \[[\d.]+, [\d.]+\])",
            "fixed_inside": r"fixed over EKF, 30 s: .* ellipses (\d+ %)",
            "adaptive_inside": r"adaptive over EKF, 30 s: .* ellipses (\d+ %)",
        },
        spread=True,
    ),
    Study(
        "coarse_slides",
        "What does watching the receiver's drift gain on ground that slips, with coarse fixes?",
        module("coarse_slides", "--out", OUT),
        5,
        {
            "judged": r"judged: .* logs: ([\d.]+ \[[\d.]+, [\d.]+\])",
            "developed": r"developed: .* logs: ([\d.]+ \[[\d.]+, [\d.]+\])",
        },
        spread=True,
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
        module("grounds", "--out", OUT),
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
        spread=True,
    ),
    Study(
        "own_grounds",
        "How well does a terrain model that is trained on a robot's own labelled logs know its grounds?",
        module("own_grounds"),
        4,
        {
            "runs": r"(\d+) runs:",
            "macro_f1": r"macro-F1 ([\d.]+)",
            "ece": r"macro-F1 .*; ECE ([\d.]+)",
            "unknown": r"macro-F1 .*; unknown ([\d.]+)",
            "in_time": r"ground change .*; within 2 s (\d+)%",
            "delay_s": r"ground change detected after ([\d.]+) s",
        },
    ),
    Study(
        "wrong_labels",
        "What do right and wrong labels of the ground cost, where wheels and IMU check them?",
        module("wrong_labels", "--out", OUT),
        6,
        {name: rf"all, {name} labels over fixed: (.*)" for name in ("true", "shuffled", "adversarial")}
        | {
            f"unseen_{name}": rf"unseen, {name} labels over fixed: (.*)"
            for name in ("true", "shuffled", "adversarial")
        },
        spread=True,
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
            for i, what in enumerate(("rmse", "constant", "own_past", *SHARES_OF_SLIP))
        }
        | {
            f"{robot}_{what}": rf"real, {robot} +\d+ +" + r"[\d.]+ +" * i + r"([\d.]+)"
            for robot in ("warthog", "husky", "pathfinder")
            for i, what in enumerate(("rmse", "constant", "own_past", *SHARES_OF_SLIP))
        }
        | {
            f"memory_{what}": r"own past, warthog +\d+ +" + r"[\d.]+ +" * i + r"([\d.]+)"
            for i, what in enumerate(("rmse", "constant", "own_past", *SHARES_OF_SLIP))
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
        }
        | {"borealtc_judged": r"twin to borealtc .*, (\d+ %) of the windows judged"},
    ),
    Study(
        "known_changes",
        "What do known changes in real logs cost an estimator that is not told, and do ellipses hold?",
        module("known_changes.table", "--out", OUT, "--jobs", "2"),
        240,
        {"ratio": r"all changes, not told: ([\d.]+)"},
        "known_changes.png",
        spread=True,
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
        spread=True,
    ),
    Study(
        "detector",
        "How well are grounds told apart, on fresh drives, with sensors missing, on grounds never seen?",
        module("detector_trials"),
        20,
    ),
)
