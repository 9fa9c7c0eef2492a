"""NMEA logs: sentences written here from a known track, read back; damage counted, never trusted."""

from __future__ import annotations

import random
import time
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from terrafusion.datasets.core.channels import Fix
from terrafusion.datasets.core.errors import DataError
from terrafusion.datasets.core.frames import enu_to_geodetic, geodetic_to_enu
from terrafusion.datasets.core.recording import Recording
from terrafusion.datasets.readers import open_recording
from terrafusion.twin.model.vehicle import load_vehicle

DATUM = (48.1, 11.5, 520.0)
START = "2024-02-29T23:59:58"
"""Two seconds before a midnight that ends a leap day."""
N = 40
V = (1.2, -0.8)


def start_ns(text: str = START) -> int:
    return int(np.datetime64(text, "ns").astype(np.int64))


def track() -> np.ndarray:
    s = np.arange(N) * 0.1
    return np.stack([V[0] * s, V[1] * s, 0.02 * s], axis=1)


def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n"


def angle(degrees: float, sides: str, width: int) -> str:
    whole, rest = divmod(abs(degrees), 1.0)
    return f"{whole:0{width}.0f}{rest * 60.0:011.8f},{sides[int(degrees < 0)]}"


def of_day(k: int, start: str = START) -> tuple[str, str]:
    """hhmmss.ss and ddmmyy of sample k."""
    text = str(np.datetime64(start, "ms") + np.timedelta64(100 * k, "ms"))
    return text[11:23].replace(":", "")[:9], f"{text[8:10]}{text[5:7]}{text[2:4]}"


def gga(k: int, llh: np.ndarray, quality: int = 4, talker: str = "GP", hdop: str = "0.8") -> str:
    lat, lon = angle(llh[0], "NS", 2), angle(llh[1], "EW", 3)
    return sentence(
        f"{talker}GGA,{of_day(k)[0]},{lat},{lon},{quality},12,{hdop},{llh[2] - 47.5:.4f},M,47.5,M,1.0,0001"
    )


def rmc(k: int, llh: np.ndarray, *, date: str | None = None, mode: str = ",,,R", talker: str = "GN") -> str:
    lat, lon = angle(llh[0], "NS", 2), angle(llh[1], "EW", 3)
    knots, course = np.hypot(*V) / (1852 / 3600), np.degrees(np.arctan2(V[0], V[1])) % 360
    day = of_day(k)[1] if date is None else date
    return sentence(f"{talker}RMC,{of_day(k)[0]},A,{lat},{lon},{knots:.8f},{course:.8f},{day}{mode}")


def gst(k: int) -> str:
    return sentence(f"GNGST,{of_day(k)[0]},0.9,0.02,0.01,45.0,0.014,0.012,0.030")


def log(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "drive.nmea"
    path.write_bytes(text.encode("latin-1"))
    return path


def llh_of(datum: tuple[float, float, float] = DATUM) -> np.ndarray:
    return enu_to_geodetic(track(), datum)


def assert_track(recording: Recording, datum: tuple[float, ...] = DATUM) -> None:
    assert recording.gnss is not None
    assert recording.datum is not None
    back = geodetic_to_enu(enu_to_geodetic(recording.gnss.enu_m, recording.datum), datum)
    np.testing.assert_allclose(back, track(), atol=1e-3)
    np.testing.assert_array_equal(recording.gnss.t_ns, start_ns() + np.arange(N) * 100_000_000)


@pytest.mark.parametrize(
    "datum",
    [DATUM, (-33.45, -70.66, 570.0), (-17.5, 179.999999, 3.0), (1e-6, -1e-6, 0.0), (-89.99999, 5.0, 2800.0)],
    ids=["northeast", "southwest", "across 180", "across 0", "at the pole"],
)
def test_track_across_midnight(tmp_path: Path, datum: tuple[float, float, float]) -> None:
    llh = llh_of(datum)
    path = log(tmp_path, "".join(gga(k, p) + rmc(k, p) + gst(k) for k, p in enumerate(llh)))
    recording = open_recording(path)
    assert_track(recording, datum)
    gnss = recording.gnss
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    np.testing.assert_allclose(gnss.velocity_enu_mps[:, :2], np.tile(V, (N, 1)), atol=1e-6)
    np.testing.assert_array_equal(gnss.sigma_enu_m, np.tile([0.012, 0.014, 0.03], (N, 1)))
    assert set(gnss.fix.tolist()) == {Fix.FIXED}


@pytest.mark.parametrize("order", ["rmc first", "rmc last", "zda", "rmc at the end only"])
def test_the_date_reaches_all_epochs(tmp_path: Path, order: str) -> None:
    llh = llh_of()
    if order == "zda":
        parts = [
            gga(k, p) + sentence(f"GPZDA,{of_day(k)[0]},{'29,02' if k < 20 else '01,03'},2024,00,00")
            for k, p in enumerate(llh)
        ]
    elif order == "rmc at the end only":
        parts = [gga(k, p) for k, p in enumerate(llh)] + [rmc(N - 1, llh[-1])]
    else:
        parts = [
            rmc(k, p) + gga(k, p) if order == "rmc first" else gga(k, p) + rmc(k, p)
            for k, p in enumerate(llh)
        ]
    assert_track(open_recording(log(tmp_path, "".join(parts))))


@pytest.mark.parametrize("quality", range(9))
def test_quality(tmp_path: Path, quality: int) -> None:
    llh = llh_of()
    text = "".join(gga(k, p, quality if k % 2 else 1) + rmc(k, p) for k, p in enumerate(llh))
    gnss = open_recording(log(tmp_path, text)).gnss
    assert gnss is not None
    known = {1: Fix.SINGLE, 2: Fix.DGPS, 3: Fix.SINGLE, 4: Fix.FIXED, 5: Fix.FLOAT}
    if quality in known:
        assert gnss.fix[1] == known[quality]
        assert len(gnss) == N
    else:
        assert len(gnss) == N // 2


def test_sigma_from_hdop_is_told(tmp_path: Path) -> None:
    llh = llh_of()
    recording = open_recording(
        log(tmp_path, "".join(gga(k, p, 1, hdop="1.5") + rmc(k, p) for k, p in enumerate(llh)))
    )
    assert recording.gnss is not None
    np.testing.assert_allclose(recording.gnss.sigma_enu_m[0], [4.5, 4.5, 9.0])
    assert any("HDOP times" in note for note in recording.notes)


def test_sigma_from_hdop_is_that_of_the_class_where_the_receiver_is_coarser(tmp_path: Path) -> None:
    """The receiver of 'generic' has 1.5 m: no RTK."""
    text = "".join(gga(k, p, 4, hdop="0.8") + rmc(k, p) for k, p in enumerate(llh_of()))
    recording = open_recording(log(tmp_path, text), rig=load_vehicle("generic").rig())
    assert recording.gnss is not None
    np.testing.assert_allclose(recording.gnss.sigma_enu_m[0], [0.016, 0.016, 0.032])


@pytest.mark.parametrize("mode", [",,,A", ",,,D", ",,,F", "", ",,,N"])
def test_rmc_alone(tmp_path: Path, mode: str) -> None:
    text = "".join(rmc(k, p, mode=mode, talker="GA") for k, p in enumerate(llh_of()))
    path = log(tmp_path, text)
    if mode.endswith("N"):
        with pytest.raises(DataError, match="holds no fix"):
            open_recording(path)
        return
    gnss = open_recording(path).gnss
    assert gnss is not None
    wanted = {"A": Fix.SINGLE, "D": Fix.DGPS, "F": Fix.FLOAT, "": Fix.SINGLE}[mode[-1:]]
    assert set(gnss.fix.tolist()) == {wanted}
    assert np.isnan(gnss.enu_m[:, 2]).all()


def test_velocity_of_vtg_and_at_rest(tmp_path: Path) -> None:
    llh = llh_of()
    text = "".join(
        gga(k, p) + sentence("GPVTG,90.0,T,,M,2.0,N,3.7,K,A" if k else "GPVTG,,T,,M,0.0,N,0.0,K,A")
        for k, p in enumerate(llh)
    )
    gnss = open_recording(log(tmp_path, text)).gnss
    assert gnss is not None
    assert gnss.velocity_enu_mps is not None
    np.testing.assert_allclose(gnss.velocity_enu_mps[:2, :2], [[0, 0], [2 * 1852 / 3600, 0]], atol=1e-12)


@pytest.mark.parametrize("stamp", ["{s:.1f} ", "gnss  {iso}Z  ", "[{s:.3f}] RX: "])
def test_time_stamps_in_front_give_the_date(tmp_path: Path, stamp: str) -> None:
    text = ""
    for k, p in enumerate(llh_of()):
        s = start_ns() * 1e-9 + 0.1 * k + 0.4
        iso = str(np.datetime64(round(s * 1e3), "ms"))
        text += stamp.format(s=s, iso=iso) + gga(k, p)
    recording = open_recording(log(tmp_path, text))
    assert_track(recording)
    assert any("own time stamps" in note for note in recording.notes)


def test_week_rollover_is_mended_where_stamps_prove_it(tmp_path: Path) -> None:
    old = str(np.datetime64(START[:10]) - np.timedelta64(1024 * 7, "D"))
    text = "".join(
        f"{start_ns() * 1e-9 + 0.1 * k:.1f} {gga(k, p)}{rmc(k, p, date=old[8:] + old[5:7] + old[2:4])}"
        for k, p in enumerate(llh_of()[:20])
    )
    recording = open_recording(log(tmp_path, text))
    assert recording.start_ns == start_ns()
    assert any("rolled over" in note for note in recording.notes)


def test_no_date_at_all(tmp_path: Path) -> None:
    recording = open_recording(log(tmp_path, "".join(gga(k, p) for k, p in enumerate(llh_of()))))
    assert recording.start_ns == 86_398 * 10**9
    assert recording.duration_s() == pytest.approx(3.9)
    assert any("no sentence has a date" in note for note in recording.notes)


def test_damaged_sentences_are_counted_and_left_out(tmp_path: Path) -> None:
    llh = llh_of()
    parts = [gga(k, p) + rmc(k, p) for k, p in enumerate(llh)]
    parts[7] = parts[7].replace("N,", "S,", 1)  # the checksum no longer fits
    parts[9] = parts[9][:30] + "\r\n" + parts[9][30:]
    recording = open_recording(log(tmp_path, "".join(parts) + "$GPGGA,000002.00,48"))
    assert recording.gnss is not None
    assert recording.gnss.enu_m[:, 1].min() > -10.0
    assert any("3 of 81 sentences are damaged" in note for note in recording.notes)


def test_epochs_whose_gga_is_lost_are_counted(tmp_path: Path) -> None:
    parts = [("" if k in (7, 9) else gga(k, p)) + rmc(k, p) for k, p in enumerate(llh_of())]
    recording = open_recording(log(tmp_path, "".join(parts)))
    assert recording.gnss is not None
    assert len(recording.gnss) == N - 2
    assert any("2 of 40 epochs have an RMC and no GGA; left out" in note for note in recording.notes)


def test_mostly_damaged_is_refused(tmp_path: Path) -> None:
    parts = [gga(k, p) for k, p in enumerate(llh_of())]
    parts = [p if k % 3 == 0 else p.replace("12", "13") for k, p in enumerate(parts)]
    with pytest.raises(DataError, match=r"\d+ of 40 sentences are damaged"):
        open_recording(log(tmp_path, "".join(parts)))


def test_without_checksums_and_before_the_first_fix(tmp_path: Path) -> None:
    cold = "$GPGGA,,,,,,0,00,99.99,,,,,,\r\n$GPRMC,,V,,,,,,,,,,N\r\n"
    text = cold * 50 + "".join((gga(k, p) + rmc(k, p)) for k, p in enumerate(llh_of()))
    text = "\r\n".join(line.split("*")[0] for line in text.splitlines()) + "\r\n"
    recording = open_recording(log(tmp_path, text))
    assert_track(recording)
    assert any("no checksum" in note for note in recording.notes)
    assert any("100 sentences of a receiver without time" in note for note in recording.notes)


def test_sentences_between_binary_messages(tmp_path: Path) -> None:
    noise = random.Random(3)
    parts = [gga(k, p) + rmc(k, p) for k, p in enumerate(llh_of())]
    text = "".join(part + noise.randbytes(60).decode("latin-1").replace("$", "") for part in parts)
    assert_track(open_recording(log(tmp_path, text)))


def test_a_leap_second_and_two_talkers(tmp_path: Path) -> None:
    p = llh_of()[0]
    lat, lon = angle(p[0], "NS", 2), angle(p[1], "EW", 3)
    text = ""
    for when, day in (
        ("235959.00", "311216"),
        ("235960.00", "311216"),
        ("000000.00", "010117"),
        ("000001.00", "010117"),
    ):
        for talker in ("GP", "GL"):
            text += sentence(f"{talker}RMC,{when},A,{lat},{lon},0.0,,{day}")
    gnss = open_recording(log(tmp_path, text)).gnss
    assert gnss is not None
    first = start_ns("2016-12-31T23:59:59")
    assert (gnss.t_ns - first).tolist() == [0, 10**9, 10**9, 2 * 10**9]


def test_backward_times(tmp_path: Path) -> None:
    llh = np.tile(llh_of()[0], (200, 1))
    ks = [k if k < 100 else k - 30 for k in range(200)]
    path = log(tmp_path, "".join(gga(k, p) + rmc(k, p) for k, p in zip(ks, llh, strict=True)))
    with pytest.raises(DataError, match=r"backwards by 2\.9"):
        open_recording(path)
    recording = open_recording(path, repair_clock=True)
    assert recording.gnss is not None
    assert set(np.diff(recording.gnss.t_ns).tolist()) == {100_000_000}
    assert [jump.step_s for jump in recording.clock_jumps] == [-3.0]


FIELDS = st.lists(st.one_of(st.sampled_from(["", "N", "S", "E", "A", "1", "4807.03", "123519", "-1", "1e9", "nan", "99999.9"]), st.text(st.characters(codec="ascii"), max_size=8)), max_size=15)  # fmt: skip  # noqa: E501


@settings(deadline=None, max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.tuples(st.sampled_from(["GGA", "RMC", "GST", "ZDA", "VTG"]), FIELDS), min_size=1, max_size=5)
)
def test_any_fields_are_told_as_errors_or_read(
    tmp_path: Path, sentences: list[tuple[str, list[str]]]
) -> None:
    text = "".join(sentence(f"GP{kind}," + ",".join(fields)) for kind, fields in sentences)
    told = ""
    try:
        recording = open_recording(log(tmp_path, "$GPGSV,1\r\n" + text))
    except DataError as error:
        told = str(error)
    else:
        assert recording.gnss is not None
    assert "\n" not in told


@pytest.mark.parametrize(
    "piece", ["$GPGGA,1,2,3,", "$GPGGA,", "$", "$GPRMC,123519,A,4807.038,N,01131.000,E,"]
)
def test_ten_megabytes_of_one_line(tmp_path: Path, piece: str) -> None:
    path = log(tmp_path, "$GPGGA,1\r\n" + piece * (10_000_000 // len(piece)))
    begun = time.process_time()
    with pytest.raises(DataError, match="more than 65 536 bytes in line 2"):
        open_recording(path)
    assert time.process_time() - begun < 1.0
