"""`station import` of captures of the protocols that the drivers decode, and of several files of which some fail."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest

from drivers.imus.stim300.codec import Datagrams, encode, encode_special
from drivers.imus.stim300.special import Configuration
from drivers.imus.vectornav.codec import COMMON, IMU, Sentence, encode_frames, encode_sentence, layout_of
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import TableReadings
from station.bench.can_mappings import load_mapping
from station.cli import main

DATA = Path(__file__).parents[1] / "data"
SHAPES = DATA / "shapes"
DEVICE = '[device]\nname = "unit"\n[reference]\nkind = "rest"\nwhere = "everywhere"\nrest_limit_dps = 500\n'
BY_TIME = '[time]\ncolumn = "time"\nunit = "s"\n'


def imported(tmp_path: Path, mapping: str, *files: Path, code: int = 0) -> ImuData:
    (tmp_path / "mapping.toml").write_text(mapping)
    output = tmp_path / "out.h5"
    output.unlink(missing_ok=True)
    assert main(["import", str(tmp_path / "mapping.toml"), *map(str, files), "-o", str(output)]) == code
    return read_recording(output).sources["imu"]


def told(tmp_path: Path) -> str:
    return str(read_recording(tmp_path / "out.h5").attributes.get("imported", ""))


# --- Xsens

XBUS = (SHAPES / "mti_capture.toml").read_text()


@pytest.mark.parametrize("name", ["capture1", "capture2"])
def test_a_real_capture_of_an_mti_gives_what_another_decoder_reads(tmp_path: Path, name: str) -> None:
    data = imported(tmp_path, XBUS, DATA / "xsens" / f"{name}.bin")
    text = (DATA / "xsens" / f"{name}.decoded.txt").read_text()
    number = r"(-?[\d.e-]+)"
    rates = re.findall(rf"RateOfTurn\(\w+\):\n  X:{number}\n  Y:{number}\n  Z:{number}", text)
    ticks = [int(tick) for tick in re.findall(r"SampleTimeFine:\n  (\d+)\n(?:(?!\n\n).|\n(?!\n))*?RateOfTurn", text)]
    np.testing.assert_allclose(data.rate_rps, np.array(rates, dtype=float), rtol=1e-6)
    np.testing.assert_allclose(data.t_ns * 1e-9, (np.array(ticks) - ticks[0]) * 1e-4, atol=2e-3)
    assert data.accel_mps2 is not None
    assert np.linalg.norm(data.accel_mps2, axis=1).mean() == pytest.approx(9.8, abs=0.3)


def test_damaged_bytes_in_a_capture_cost_their_messages_only(tmp_path: Path) -> None:
    raw = bytearray((DATA / "xsens" / "capture1.bin").read_bytes())
    raw[len(raw) // 2] ^= 0xFF
    (tmp_path / "damaged.bin").write_bytes(raw[:-7])
    data = imported(tmp_path, XBUS, tmp_path / "damaged.bin")
    whole = imported(tmp_path, XBUS, DATA / "xsens" / "capture1.bin")
    assert len(whole.t_ns) - 2 <= len(data.t_ns) < len(whole.t_ns)
    assert np.isin(data.rate_rps, whole.rate_rps).all()


# --- STIM300

STIM300 = (
    DEVICE
    + '[file]\nformat = "stim300"\n'
    + BY_TIME
    + '[gyro]\ncolumns = "gyro"\nunit = "rad/s"\n[temperature]\ncolumn = "temperature"\nunit = "degC"\n'
)


def datagrams(count: int, gyro: np.ndarray) -> Datagrams:
    zero = np.zeros(count, dtype=np.int64)
    warm = np.full((count, 3), 25 * 256)
    groups = {"gyro": (gyro.astype(np.int64), zero), "gyro_temperature": (warm, zero)}
    return Datagrams(0x94, np.arange(count) * 16 % 256, zero + 300, groups)


@pytest.mark.parametrize(("output", "lsb_dps"), [("rate", 2.0**-14), ("increment", 125 * 2.0**-21)])
def test_datagrams_of_a_stim300_have_the_unit_that_its_configuration_or_the_mapping_says(
    tmp_path: Path, output: str, lsb_dps: float
) -> None:
    counts = np.round(np.random.default_rng(1).normal(scale=1000, size=(300, 3)))
    stream = encode(datagrams(300, counts))
    (tmp_path / "plain.bin").write_bytes(b"\x00\x01" + stream[:-3])  # line noise; cut within a datagram
    code = {"rate": 0, "increment": 1}[output]
    settings = encode_special(Configuration.of(rate_hz=125, temperature=True, gyro_unit=code))
    (tmp_path / "told.bin").write_bytes(settings + stream)
    stated = imported(
        tmp_path, STIM300.replace('"stim300"', f'"stim300"\ngyro_output = "{output}"'), tmp_path / "plain.bin"
    )
    assert len(stated.t_ns) == 299
    as_told = imported(tmp_path, STIM300, tmp_path / "told.bin")
    for data in (stated, as_told):
        n = len(data.t_ns)
        np.testing.assert_allclose(np.degrees(data.rate_rps), counts[:n] * lsb_dps, rtol=1e-9)
        np.testing.assert_allclose(data.t_ns * 1e-9, np.arange(n) / 125, atol=1e-9)
        assert data.temperature_c is not None
        np.testing.assert_allclose(data.temperature_c, 25.0)


def test_a_gap_in_a_capture_of_a_stim300_keeps_its_length(tmp_path: Path) -> None:
    stream = encode(datagrams(300, np.ones((300, 3))))
    size = len(stream) // 300
    (tmp_path / "log.bin").write_bytes(stream[: 100 * size] + stream[110 * size :])
    t_s = imported(tmp_path, STIM300, tmp_path / "log.bin").t_ns * 1e-9
    np.testing.assert_allclose(t_s, np.delete(np.arange(300), slice(100, 110)) / 125, atol=1e-9)


def test_a_stim300_that_does_not_say_what_it_puts_out_is_told(tmp_path: Path) -> None:
    (tmp_path / "log.bin").write_bytes(encode(datagrams(300, np.ones((300, 3)))))
    imported(tmp_path, STIM300, tmp_path / "log.bin")
    assert "the kind of gyro output is not stated, so a rate is assumed. Otherwise state gyro_output in [file]" in told(
        tmp_path
    )


# --- VectorNav


def test_binary_output_and_sentences_of_a_vectornav_are_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    layout = layout_of({COMMON: 1 << 0, IMU: 1 << 2 | 1 << 3 | 1 << 4})
    rows = np.zeros(200, dtype=layout.dtype)
    rows["common.time_startup"] = 5_000_000_000 + np.arange(200) * 20_000_000
    rows["imu.uncomp_gyro"], rows["imu.temperature"] = rng.normal(size=(200, 3)), 31
    (tmp_path / "binary.bin").write_bytes(
        encode_sentence(Sentence("VNRRG", ("01", "VN-100"))) + encode_frames(layout, rows)
    )
    gyro = '[gyro]\ncolumns = "imu.uncomp_gyro"\nunit = "rad/s"\n'
    gyro += '[temperature]\ncolumn = "imu.temperature"\nunit = "degC"\n'
    data = imported(tmp_path, DEVICE + '[file]\nformat = "vectornav"\n' + BY_TIME + gyro, tmp_path / "binary.bin")
    np.testing.assert_array_equal(data.rate_rps, rows["imu.uncomp_gyro"].astype(float))
    np.testing.assert_allclose(data.t_ns * 1e-9, np.arange(200) / 50, atol=1e-9)
    fields = [("0", "0", "0", "0", "0", "9.8", *(f"{v:.6f}" for v in w), "31.0", "101.3") for w in data.rate_rps]
    fields.insert(7, ("x", *fields[7][1:]))  # its checksum is right
    (tmp_path / "ascii.txt").write_bytes(b"".join(encode_sentence(Sentence("VNIMU", row)) for row in fields))
    by_rate = imported(
        tmp_path, DEVICE + '[file]\nformat = "vectornav"\n[time]\nrate_hz = 50\n' + gyro, tmp_path / "ascii.txt"
    )
    np.testing.assert_allclose(by_rate.rate_rps, data.rate_rps, atol=1e-6)


# --- CAN

CANDUMP = (SHAPES / "can_log.toml").read_text()


def table_style(message: can.Message) -> str:
    """As candump prints it with -ta, without -L."""
    data = " ".join(f"{byte:02X}" for byte in message.data)
    return f" ({message.timestamp:.6f})  can0  {message.arbitration_id:03X}   [{message.dlc}]  {data}"


def log_style(message: can.Message) -> str:
    return f"({message.timestamp:.6f}) can0 {message.arbitration_id:03X}#{message.data.hex().upper()}"


def can_log(path: Path, style: Callable[[can.Message], str]) -> np.ndarray:
    """Rates and, 3 ms later, specific force of a node at 100 Hz, its counter left out; one acceleration is lost."""
    database: Any = cantools.database.load_file(load_mapping("xsens_mti600").dbc)
    rates = np.round(np.random.default_rng(4).normal(size=(150, 3)) * 512) / 512
    lines = []
    for i, rate in enumerate(rates):
        for name, values, later in (
            ("XCDI_RateOfTurn", dict(zip(("gyrX", "gyrY", "gyrZ"), rate, strict=True)), 0.0),
            ("XCDI_Acceleration", {"accX": 0.0, "accY": i / 256, "accZ": 9.75}, 0.003),
        ):
            message = database.get_message_by_name(name)
            frame = can.Message(1e9 + i / 100 + later, message.frame_id, False, data=message.encode(values))
            if (name, i) != ("XCDI_Acceleration", 70):
                lines.append(style(frame))
    path.write_text("\n".join([*lines, "(100", lines[0][:30]]) + "\n")
    return rates


@pytest.mark.parametrize("style", [log_style, table_style])
def test_a_log_of_candump_is_read_by_the_signals_of_a_dbc(tmp_path: Path, style: Callable[[can.Message], str]) -> None:
    rates = can_log(tmp_path / "can.log", style)
    data = imported(tmp_path, CANDUMP, tmp_path / "can.log")
    np.testing.assert_allclose(data.rate_rps, rates, atol=1e-9)
    np.testing.assert_allclose(data.t_ns * 1e-9, np.arange(150) / 100, atol=1e-6)
    assert data.accel_mps2 is not None
    np.testing.assert_allclose(data.accel_mps2[:, 1], np.arange(150) / 256, atol=1e-6)  # the lost one is interpolated
    assert "damaged frames were skipped" in told(tmp_path)


# --- what cannot be read


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        (XBUS.replace('"xbus"', '"stim300"'), "capture1.bin: holds no message of stim300. Check [file]"),
        (XBUS.replace('"RateOfTurn"', '"Rate"'), "has no column Rate: the capture has "),
        (
            STIM300.replace('"stim300"', '"stim300"\ngyro_output = "turns"'),
            "line 9: file.gyro_output: 'turns' is not one",
        ),
        (CANDUMP.replace("xsens_mti600", "none"), "line 8: file.dbc: no CAN mapping none: give one of aceinna"),
        (CANDUMP.replace("gyrX", "gyro_x", 1), "has no signal XCDI_RateOfTurn.gyro_x. Write it as MESSAGE.Signal"),
    ],
)
def test_a_capture_that_cannot_be_read_says_why(
    tmp_path: Path, mapping: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mapping.toml").write_text(mapping)
    capture = str(DATA / "xsens" / "capture1.bin")
    assert main(["import", str(tmp_path / "mapping.toml"), capture, "-o", str(tmp_path / "out.h5")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out.h5").exists()


def test_files_that_cannot_be_read_cost_themselves_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = DATA / "xsens" / "capture1.bin"
    (tmp_path / "empty.bin").touch()
    (tmp_path / "noise.bin").write_bytes(np.random.default_rng(6).bytes(5000))
    files = [tmp_path / "empty.bin", good, tmp_path / "absent.bin", tmp_path / "noise.bin", good, tmp_path]
    data = imported(tmp_path, XBUS, *files, code=2)
    assert len(data.t_ns) == 2 * len(imported(tmp_path, XBUS, good).t_ns)
    refused = [line for line in capsys.readouterr().err.splitlines() if line.startswith("refused ")]
    assert refused[:3] == [
        "refused empty.bin: is empty",
        "refused absent.bin: cannot be read: No such file or directory",
        "refused noise.bin: holds no message of xbus. Check [file]",
    ]
    assert refused[3].endswith("cannot be read: Is a directory")
    as_json = ["import", str(tmp_path / "mapping.toml"), *map(str, files), "-o", str(tmp_path / "b.h5"), "--json"]
    assert main(as_json) == 2
    out = json.loads(capsys.readouterr().out)
    assert [entry["name"] for entry in out["refused"]] == ["empty.bin", "absent.bin", "noise.bin", tmp_path.name]
    assert out["samples"] == {"imu": len(data.t_ns)}


# --- Galil data records: the controller's own stream of its axes' positions


def galil_record(number: int, positions: list[int], *, family: str) -> bytes:
    """A data record as the maker's manuals lay it out: a header of four bytes, I, S, T, and a block an axis."""
    counts, planes, axis = {"4000": (58, 10, 36), "2103": (24, 8, 28)}[family]
    axes = (1 << len(positions)) - 1
    body = bytearray(number.to_bytes(2, "little") + bytes(counts - 2 + 2 * planes))
    for position in positions:
        block = bytearray(axis)
        block[4:8], block[8:12] = (
            (position + 3).to_bytes(4, "little", signed=True),
            position.to_bytes(4, "little", signed=True),
        )
        block[20:24] = (64 * 1000).to_bytes(4, "little", signed=True)
        body += block
    return bytes([0x87, axes]) + (4 + len(body)).to_bytes(2, "little") + bytes(body)


GALIL = (
    (SHAPES / "galil_records.toml")
    .read_text()
    .replace('"{stem}.bin"', '"table.bin"')
    .replace('offset_s = "from data"', "")
)


@pytest.mark.parametrize(("family", "end"), [("4000", b""), ("4000", b":"), ("2103", b"\r\n:")])
def test_data_records_of_a_galil_are_the_angles_of_a_table(tmp_path: Path, family: str, end: bytes) -> None:
    period_s = 976.5625e-6  # TM 1000
    samples = 60000 + np.arange(2000) * 16  # goes round at 65536
    t = (samples - samples[0]) * period_s
    angle_deg = 40 * np.sin(t)
    stream = b"".join(
        galil_record(int(n) % 65536, [7, -9, round(a * 3600)], family=family) + end
        for n, a in zip(samples, angle_deg, strict=True)
    )
    size = len(stream) // 2000
    (tmp_path / "table.bin").write_bytes(stream[5 : 500 * size] + b"\x00" + stream[500 * size + 9 :])
    at = np.arange(0, t[-1], 0.01)
    rows = np.column_stack([at, 40 * np.cos(at) + 0.3 + np.random.default_rng(2).normal(scale=0.01, size=len(at))])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,gz", comments="")
    (tmp_path / "mapping.toml").write_text(GALIL)
    assert (
        main(["import", str(tmp_path / "mapping.toml"), str(tmp_path / "log.csv"), "-o", str(tmp_path / "o.h5")]) == 0
    )
    recording = read_recording(tmp_path / "o.h5")
    assert isinstance(recording.reference, TableReadings)
    t_s = recording.reference.t_ns * 1e-9
    assert len(t_s) == pytest.approx(1998, abs=1)
    # The first record is damaged, so the stream begins with the second, which is of the first gyro sample's instant.
    np.testing.assert_allclose(
        np.degrees(recording.reference.angle_rad[:, 0]), 40 * np.sin(t_s + 16 * period_s), atol=2e-3
    )
    assert "2 damaged" in str(recording.attributes["imported"])


def test_what_is_no_data_record_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "table.bin").write_bytes(bytes(range(256)) * 40)
    rows = np.column_stack([np.arange(100) / 100, np.random.default_rng(2).normal(size=100)])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,gz", comments="")
    (tmp_path / "mapping.toml").write_text(GALIL)
    assert (
        main(["import", str(tmp_path / "mapping.toml"), str(tmp_path / "log.csv"), "-o", str(tmp_path / "o.h5")]) == 2
    )
    assert "table.bin holds no message of galil. Check [file]" in " ".join(capsys.readouterr().err.split())
