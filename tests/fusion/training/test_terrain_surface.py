"""Features and learner of labelled drives: symmetry, gaps, folds, files, and what they learn."""

from __future__ import annotations

import dataclasses
import glob
import itertools
import json
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from terrafusion.datasets.core.errors import ConfigError, DataError
from terrafusion.fusion.cli.terrain import app
from terrafusion.fusion.training.cross_validation import (
    FOLDS,
    LabelledRun,
    assign_folds,
    check_runs,
    cross_validate,
    hashes_of,
    open_runs,
    train_on,
    window_ms,
)
from terrafusion.fusion.training.softmax import SoftmaxModel, read_softmax
from terrafusion.fusion.training.surface_features import (
    GROUPS,
    SURFACE_FEATURES,
    Signals,
    SurfaceWindows,
    surface_windows,
    window_features,
)
from terrafusion.fusion.training.surface_report import (
    figures_lines,
    lines_of,
    report_on,
    score,
    transfer,
)
from tests.studies.ground_classifier import experiments
from tests.studies.ground_classifier.change_detection import changes_seen, spliced

SHAKES = {"gravel": 1.0, "lawn": 0.35, "pavement": 0.12}


def made_drive(label: str, seed: int, seconds: float = 40.0, level: float | None = None) -> Signals:
    """A drive at a speed and turning rate of its own; each ground shakes and drags as much as it does."""
    rng = np.random.default_rng(seed)
    t, w = np.arange(0.0, seconds, 0.01), np.arange(0.0, seconds, 0.1)
    speed, rate = rng.uniform(0.3, 0.8), rng.uniform(-0.3, 0.3)
    shake = (SHAKES[label] if level is None else level) * np.sqrt(speed)
    gyro = 0.2 * shake * rng.normal(size=(len(t), 3)) + [0.0, 0.0, 0.9 * rate]
    accel = shake * rng.normal(size=(len(t), 3)) + [0.0, 0.0, 9.8]
    sides = np.column_stack([np.full(len(w), speed - 0.25 * rate), np.full(len(w), speed + 0.25 * rate)])
    current = 3.0 + 2.0 * shake + 0.3 * rng.normal(size=(len(w), 2))
    return Signals(t, gyro, accel, w, sides + 0.005 * rng.normal(size=sides.shape), 0.5, w, current)


def made_run(label: str, seed: int, **how: float) -> LabelledRun:
    signals = made_drive(label, seed, **how)
    return LabelledRun(f"{label}/{seed}", label, signals, surface_windows(signals))


@pytest.fixture(autouse=True)
def short_routes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.studies.ground_classifier.change_detection.PATCHES", 6)


@pytest.fixture(scope="module")
def runs() -> list[LabelledRun]:
    return [made_run(label, 10 * i + n) for i, label in enumerate(SHAKES) for n in range(6)]


@pytest.fixture(scope="module")
def model(runs: Sequence[LabelledRun]) -> SoftmaxModel:
    return train_on([r for r in runs if not r.name.endswith("5")])


def test_left_and_right_do_not_matter() -> None:
    drive = made_drive("lawn", 3).between(0.0, 2.0)
    mirror = dataclasses.replace(
        drive,
        gyro_radps=drive.gyro_radps * [-1.0, 1.0, -1.0],
        accel_mps2=drive.accel_mps2 * [1.0, -1.0, 1.0],
        sides_mps=drive.sides_mps[:, ::-1],
        current_a=drive.current_a[:, ::-1],
    )
    assert window_features(mirror) == pytest.approx(window_features(drive), abs=1e-9)


@given(st.floats(1.5, 5.0))
def test_a_louder_ground_shifts_all_levels_alike(gain: float) -> None:
    drive = made_drive("gravel", 1).between(0.0, 2.0)
    louder = dataclasses.replace(drive, accel_mps2=gain * drive.accel_mps2)
    moved = dict(zip(SURFACE_FEATURES, window_features(louder) - window_features(drive), strict=True))
    for name in GROUPS["accelerometer spectrum"]:
        assert moved[name] == pytest.approx(np.log10(gain), abs=1e-3)
    for name in (*GROUPS["gyro spectrum"], *GROUPS["shape of the vibration"], "driving_current", "yaw_lost"):
        assert moved[name] == pytest.approx(0.0, abs=1e-9)


def test_tilt_and_bias_are_not_seen() -> None:
    drive = made_drive("lawn", 4).between(0.0, 2.0)
    moved = dataclasses.replace(
        drive,
        accel_mps2=drive.accel_mps2 + np.array([0.7, -0.4, -0.1]),
        gyro_radps=drive.gyro_radps + np.array([0.01, 0.02, 0.0]),
    )
    assert window_features(moved) == pytest.approx(window_features(drive), abs=1e-9)


def test_what_a_log_lacks_is_not_a_number() -> None:
    drive = made_drive("lawn", 5).between(0.0, 2.0)
    bare = dataclasses.replace(
        drive,
        gyro_radps=np.full_like(drive.gyro_radps, np.nan),
        current_s=np.empty(0),
        current_a=np.empty((0, 2)),
    )
    missing = {n for n, v in zip(SURFACE_FEATURES, window_features(bare), strict=True) if np.isnan(v)}
    assert missing == {*GROUPS["gyro spectrum"], *GROUPS["gyro against wheels"], "driving_current"}
    slow = dataclasses.replace(
        drive, imu_s=drive.imu_s[::5], gyro_radps=drive.gyro_radps[::5], accel_mps2=drive.accel_mps2[::5]
    )
    missing = {n for n, v in zip(SURFACE_FEATURES, window_features(slow), strict=True) if np.isnan(v)}
    assert missing == set(GROUPS["spectrum above 10 Hz"]) | {f"{a}_6_hz" for a in _axes()}


def _axes() -> list[str]:
    return [n.split("_")[0] for n in SURFACE_FEATURES if n.endswith("_1.5_hz")]


def test_no_run_is_in_two_folds_and_every_ground_is_in_each(runs: Sequence[LabelledRun]) -> None:
    fold_of = assign_folds(runs)
    assert len(fold_of) == len(runs)
    assert set(fold_of.tolist()) == set(range(FOLDS))
    for fold in range(FOLDS):
        assert {r.label for r, f in zip(runs, fold_of, strict=True) if f != fold} == set(SHAKES)
    assert np.array_equal(assign_folds(runs), fold_of)


def test_grounds_are_learnt_by_run(runs: Sequence[LabelledRun]) -> None:
    folded = cross_validate(runs)
    single, filtered = folded.scores(filtered=False), folded.scores()
    assert single.macro_f1 > 0.9
    assert filtered.macro_f1 > 0.9
    assert filtered.ece < 0.1
    assert np.sum(filtered.confusion, axis=1) == pytest.approx(1.0)
    held = [
        [(r.signals, r.label) for r, f in zip(runs, folded.fold_of, strict=True) if f == k]
        for k in range(FOLDS)
    ]
    changes = changes_seen(folded.models, held)
    assert changes.never < 0.1
    assert changes.median_s < 2.0


def test_labels_at_random_are_not_learnt(runs: Sequence[LabelledRun]) -> None:
    names = list(SHAKES)
    mixed = [dataclasses.replace(r, label=names[i % 3]) for i, r in enumerate(runs)]
    assert cross_validate(mixed, temperature=4.0).scores().macro_f1 < 0.6


def test_every_window_gets_probabilities_whatever_is_missing(
    model: SoftmaxModel, runs: Sequence[LabelledRun]
) -> None:
    whole = runs[0].windows
    x, recent = whole.x.copy(), whole.recent.copy()
    rng = np.random.default_rng(0)
    x[rng.random(x.shape) < 0.5] = np.nan
    recent[rng.random(x.shape) < 0.5] = np.nan
    x[0], recent[:3] = np.nan, np.nan
    p = model.filtered(dataclasses.replace(whole, x=x, recent=recent))
    assert np.isfinite(p).all()
    assert p.sum(axis=1) == pytest.approx(1.0)
    assert (p > 0.0).all()


def test_a_ground_unlike_all_others_is_odd(model: SoftmaxModel, runs: Sequence[LabelledRun]) -> None:
    known = np.vstack([r.x for r in runs if r.name.endswith("5")])
    strange = made_run("gravel", 99, level=8.0)
    assert np.mean(model.oddness(known) > model.odd_distance) < 0.25
    assert np.mean(model.oddness(strange.x) > model.odd_distance) > 0.9


def test_a_change_is_seen_while_the_window_still_shows_both_grounds(
    model: SoftmaxModel, runs: Sequence[LabelledRun]
) -> None:
    lawn, gravel = (next(r for r in runs if r.label == label).windows for label in ("lawn", "gravel"))
    # After the change the window of two seconds answers as before for as long as we please: 2 s here.
    kept = np.vstack([lawn.x[:20], lawn.x[20:24], gravel.x[:6]])
    recent = np.vstack([lawn.recent[:20], gravel.recent[:10]])
    drive = SurfaceWindows(0.5 * np.arange(30.0), kept, recent, np.full(30, 0.25))
    named = np.array(model.classes)[model.filtered(drive).argmax(axis=1)]
    assert (named[:20] == "lawn").all()
    assert (named[20:] == "gravel").all()


def test_a_change_raises_one_alarm_within_two_seconds_and_a_drive_on_one_ground_none(
    model: SoftmaxModel, runs: Sequence[LabelledRun]
) -> None:
    lawn, gravel = (next(r for r in runs if r.label == label).windows for label in ("lawn", "gravel"))
    drive = SurfaceWindows(
        0.5 * np.arange(40.0), np.vstack([lawn.x[:20], gravel.x[:20]]),
        np.vstack([lawn.recent[:20], gravel.recent[:20]]), np.full(40, 0.25),
    )  # fmt: skip
    alarms = np.flatnonzero(model.changes(drive))
    assert len(alarms) == 1
    assert 20 <= alarms[0] < 24
    held_out = [r for r in runs if r.name.endswith("5")]
    assert np.mean([model.changes(r.windows).mean() for r in held_out]) < 0.02
    silent = dataclasses.replace(model, alarm=np.zeros_like(model.alarm))
    assert not silent.changes(drive).any()


def test_one_odd_second_does_not_lose_the_ground(model: SoftmaxModel, runs: Sequence[LabelledRun]) -> None:
    lawn, gravel = (next(r for r in runs if r.label == label).windows for label in ("lawn", "gravel"))
    recent = lawn.recent.copy()
    recent[20] = gravel.recent[0]
    named = np.array(model.classes)[model.filtered(dataclasses.replace(lawn, recent=recent)).argmax(axis=1)]
    assert (named[:20] == "lawn").all()
    assert (named[22:] == "lawn").all()


def test_a_route_is_made_of_the_raw_samples(runs: Sequence[LabelledRun]) -> None:
    route, begins = spliced([(r.signals, r.label) for r in runs], 1)
    assert (np.diff(route.imu_s) > 0.0).all()
    assert all(a[1] != b[1] for a, b in itertools.pairwise(begins))
    again, _ = spliced([(r.signals, r.label) for r in runs], 1)
    assert np.array_equal(again.accel_mps2, route.accel_mps2)


def test_written_and_read_back(model: SoftmaxModel, tmp_path: Path, runs: Sequence[LabelledRun]) -> None:
    model.write(tmp_path / "a.yaml")
    again = read_softmax(tmp_path / "a.yaml")
    again.write(tmp_path / "b.yaml")
    assert (tmp_path / "a.yaml").read_bytes() == (tmp_path / "b.yaml").read_bytes()
    x = runs[3].x
    assert again.log_probabilities(x) == pytest.approx(model.log_probabilities(x), abs=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("terrafusion.surface/2", "terrafusion.surface/7", "no model"),
        ("temperature:", "heat:", "no model"),
        ("temperature: ", "temperature: -", "positive"),
        ("offsets: [", "offsets: [1.0, ", "'offsets'"),
        ("offsets: [", "offsets: [x, ", "no number"),
        ("speed_scatter", "speed_scutter", "features"),
    ],
)
def test_a_wrong_file_is_one_line(
    model: SoftmaxModel, tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = tmp_path / "model.yaml"
    model.write(path)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        read_softmax(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_ground_is_too_few(runs: Sequence[LabelledRun]) -> None:
    with pytest.raises(ConfigError, match="two grounds"):
        train_on([r for r in runs if r.label == "lawn"])


def test_the_report_of_made_drives(runs: Sequence[LabelledRun]) -> None:
    short = [dataclasses.replace(r, windows=r.windows.first(15)) for r in runs]
    others = [
        dataclasses.replace(r, windows=dataclasses.replace(r.windows, x=r.x + 0.01)) for r in short[::2]
    ]
    report = report_on(short, others)
    assert report["filtered"]["macro_f1"] > 0.9
    assert report["other set"]["there"]["macro_f1"] > 0.8
    text = "\n".join(lines_of(report))
    assert "macro-F1" in text
    assert "gravel" in text
    assert transfer(short, short[:6])["common grounds"] == ["gravel"]


def test_the_experiments_on_made_drives(runs: Sequence[LabelledRun]) -> None:
    short = [dataclasses.replace(r, windows=r.windows.first(15)) for r in runs]
    table = experiments.ablation(short)
    assert table["accelerometer spectrum"]["alone"] > table["gyro against wheels"]["alone"]
    assert experiments.leaking(short)["softmax"] > 0.9
    assert set(experiments.never_seen(short)) == set(SHAKES)
    assert 0.5 < experiments.trees(short, assign_folds(short)) <= 1.0


@pytest.mark.parametrize("counts", [(6, 6, 1), (1, 1, 1)])
def test_a_ground_of_one_run_is_refused_by_name(
    runs: Sequence[LabelledRun], counts: tuple[int, int, int]
) -> None:
    few = [
        r for label, n in zip(SHAKES, counts, strict=True) for r in [x for x in runs if x.label == label][:n]
    ]
    ground = next(label for label, n in sorted(zip(SHAKES, counts, strict=True)) if n == 1)
    for refused in (check_runs, report_on):
        with pytest.raises(DataError, match=f"ground '{ground}' has 1 run, 2 are needed"):
            refused(few)
    if max(counts) == 1:
        with pytest.raises(DataError, match="nothing to calibrate on"):
            train_on(few)


def test_two_runs_a_ground_are_reported_with_what_they_cannot_tell() -> None:
    few = [
        made_run(label, 10 * i + n, seconds=8.0) for i, label in enumerate(("gravel", "lawn")) for n in (0, 1)
    ]
    report = report_on(few)
    assert report["filtered"]["windows"] == sum(len(r.x) for r in few)
    assert "fold 0" in lines_of(report)[0]


def test_folds_of_one_ground_or_of_short_runs_are_left_out_of_the_changes(
    model: SoftmaxModel, runs: Sequence[LabelledRun]
) -> None:
    whole = [(r.signals, r.label) for r in runs if r.name.endswith("5")]
    short = [(signals.between(0.0, 10.0), label) for signals, label in whole]
    one = [(signals, label) for signals, label in whole if label == "lawn"]
    alone = changes_seen([model], [whole])
    assert alone is not None
    assert alone.changes == 10  # five on each of two routes
    assert changes_seen([model] * 3, [whole, short, one]) == alone
    assert changes_seen([model] * 2, [short, one]) is None


def test_what_was_learnt_from_is_every_file_that_was_read(tmp_path: Path) -> None:
    folders = [tmp_path / day / "ICE" for day in ("one", "two")]
    for i, folder in enumerate(folders):
        folder.mkdir(parents=True)
        for kind, head in (("imu", "time,wx,wy,wz,ax,ay,az"), ("pro", "time,curL,curR,velL,velR")):
            (folder / f"{kind}_01.csv").write_text(
                f"{head}\n" + ",".join([str(i)] * (head.count(",") + 1)) + "\n"
            )
        (folder / "imu_02.csv").write_text("of another run")
    hashes = hashes_of([str(folder / "imu_01.csv") for folder in folders])
    assert list(hashes) == [f"{day}/ICE/{kind}_01.csv" for day in ("one", "two") for kind in ("imu", "pro")]
    assert len(set(hashes.values())) == 4
    one = hashes_of([str(folders[0] / "pro_01.csv")])
    assert list(one) == ["ICE/imu_01.csv", "ICE/pro_01.csv"]
    assert set(one.values()) < set(hashes.values())
    with pytest.raises(DataError, match="no such file"):
        hashes_of(["absent.csv"])


def test_a_learner_is_scored_on_grounds_it_knows(model: SoftmaxModel, runs: Sequence[LabelledRun]) -> None:
    held = [r for r in runs if r.name.endswith("5")]
    report = score(model, held)
    assert report["filtered"]["macro_f1"] > 0.9
    assert figures_lines(report)[1].startswith("window by window: macro-F1")
    with pytest.raises(DataError, match="does not know tarmac"):
        score(model, [*held, dataclasses.replace(held[0], label="tarmac")])


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("train", "--seeds", "2"), "--seeds is for simulated runs"),
        (("eval", "--seeds", "2"), "--seeds is for simulated runs"),
        (("eval", "--model", "a.yaml", "--test", "b"), "--test needs a model trained by this command"),
    ],
)
def test_options_that_mean_nothing_beside_logs_are_refused(tmp_path: Path, words, why: str) -> None:
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out"), "log"])
    assert why in str(result.exception)


FIELD = os.environ.get("TERRAFUSION_DATA", "")


@pytest.mark.skipif(not FIELD, reason="TERRAFUSION_DATA names no folder of field logs")
def test_a_real_husky_is_told_ice_from_loam_by_run(tmp_path: Path) -> None:
    logs = sorted(
        glob.glob(f"{FIELD}/borealtc/ICE/imu_0*.csv") + glob.glob(f"{FIELD}/borealtc/SANDY_LOAM/imu_*.csv")
    )
    if not logs:
        pytest.skip("no BorealTC among the field logs")
    runs = open_runs(logs)
    assert cross_validate(runs, temperature=8.0).scores().macro_f1 > 0.95
    assert window_ms(train_on(runs, temperature=8.0), runs[0], 50) < 20.0
    out, figures = tmp_path / "grounds.yaml", tmp_path / "figures.json"
    held = logs[::4]
    known = [log for log in logs if log not in held]
    result = CliRunner().invoke(app, ["train", "--out", str(out), *known])
    assert result.exit_code == 0, result.output
    model = read_softmax(out)
    assert model.classes == ("ice", "sandy_loam")
    assert len(model.inputs) == 2 * len(known)  # IMU and wheels of each
    result = CliRunner().invoke(app, ["eval", "--model", str(out), "--out", str(figures), *held])
    assert result.exit_code == 0, result.output
    found = json.loads(figures.read_text())
    assert found["filtered"]["macro_f1"] > 0.95
    assert not set(found["inputs"].values()) & set(model.inputs.values())
    seen = CliRunner().invoke(app, ["eval", "--model", str(out), held[0], known[0]])
    assert "was trained on 2 of these files" in str(seen.exception)
