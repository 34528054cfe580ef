"""IMUs on CAN as mapping files: the vectors of each maker, mappings of one's own, and the twin that speaks them."""

from __future__ import annotations

import asyncio
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from can_support import Flood, collect, gyros, in_virtual_time, vectors, wire

from drivers.errors import DeviceError, LinkLost
from drivers.imus.can.imu import CanChannel, CanImu, CanSource
from drivers.links.can_link import CanLink
from drivers.links.can_memory import MemoryBus
from drivers.specs import ImuSetup
from drivers.types import ImuBlock, SourceCounts
from sims.imus.can_nodes import CanNodes
from sims.wires.frames import ImuTwinSetup, NodeFaults
from station.bench.can_mappings import MAPPING_FOLDER, CanMapping, MappingError, channels_of, load_mapping

SHIPPED = ("sbg_ecan", "bosch_mm5_10", "xsens_mti600", "aceinna_openimu300ri")
RATES_DPS = (10.0, -20.0, 30.0)
TRIAD = ("x", "y", "z")
FORCE = np.array([1.0, -2.0, 9.8])


def up(t_s: Any) -> Any:
    return np.tile(FORCE / 9.80665, (len(t_s), 1))


def dbc(name: str) -> Any:
    return cantools.database.load_file(MAPPING_FOLDER / f"{name}.dbc")


def decoded(database: Any, vector: dict[str, Any]) -> list[float]:
    identifier = int(vector["can_id"], 16)
    message = next(
        m for m in database.messages if m.frame_id == identifier and m.is_extended_frame == vector["extended"]
    )
    return [float(v) for v in message.decode(bytes.fromhex(vector["hex"]), decode_choices=False).values()]


def numbers(vector: dict[str, Any]) -> list[float]:
    """Return the decoded numbers of a vector in the order of its fields."""
    out: list[float] = []
    for value in vector["decoded"].values():
        if isinstance(value, list):
            out += value
        elif not isinstance(value, str):
            out.append(value)
    return out


@pytest.mark.parametrize("vector", vectors("can_sbg_bosch_mm5"), ids=lambda v: f"{v['can_id']}-{v['hex']}")
def test_sbg_and_bosch_vectors_decode_and_encode(vector: dict[str, Any]) -> None:
    database = dbc("sbg_ecan" if vector["can_id"].startswith("12") else "bosch_mm5_10")
    values = decoded(database, vector)
    assert values == pytest.approx(numbers(vector), abs=1e-6)
    message = database.get_message_by_frame_id(int(vector["can_id"], 16))
    again = message.encode(dict(zip((s.name for s in message.signals), values, strict=True)))
    assert again.hex() == vector["hex"]


@pytest.mark.parametrize("vector", vectors("can_xsens_mti"), ids=lambda v: f"{v['can_id']}-{v['hex']}")
def test_xsens_vectors_decode_and_encode(vector: dict[str, Any]) -> None:
    database = dbc("xsens_mti600")
    values = decoded(database, vector)
    assert values == pytest.approx(numbers(vector), abs=1e-9)
    message = database.get_message_by_frame_id(int(vector["can_id"], 16))
    again = message.encode(dict(zip((s.name for s in message.signals), values, strict=True)))
    assert again.hex() == vector["hex"]


def channels(mapping: CanMapping) -> tuple[CanChannel, ...]:
    return channels_of(mapping, "imu", TRIAD[: mapping.gyros])


def run(
    mapping: CanMapping,
    rate_hz: float = 100.0,
    duration_s: float = 2.0,
    faults: NodeFaults | None = None,
    tamper: Any = None,
) -> tuple[dict[str, ImuBlock], dict[str, SourceCounts]]:
    """Return what the driver makes of the twin, both of one mapping, and the counts; ``tamper`` gets every frame."""

    async def main() -> tuple[dict[str, ImuBlock], dict[str, SourceCounts]]:
        name = wire()
        bus = MemoryBus(name)
        if tamper is not None:
            send = bus.send
            bus.send = lambda msg, timeout=None: [send(m) for m in tamper(msg)] and None  # type: ignore[method-assign]
        imu = CanImu(
            ImuSetup("imu", rate_hz, 0.5, signals=CanSource(mapping.dbc, channels(mapping), mapping.source_address)),
            CanLink("imu", "memory", name, {}),
        )
        await imu.open()
        array = gyros(rate_hz, RATES_DPS) if mapping.gyros == 3 else _Pair(gyros(rate_hz, RATES_DPS))
        signals = CanSource(mapping.dbc, channels(mapping))
        ride = ImuTwinSetup(gyros=array, rate_hz=rate_hz, up=up, faults=faults or NodeFaults(), signals=signals)  # type: ignore[arg-type]
        twin = CanNodes(ride, bus)
        task = asyncio.create_task(twin.serve())
        found = await collect(imu, duration_s)
        task.cancel()
        imu.close()
        bus.shutdown()
        return found, {channel: imu.counts(channel) for channel in imu.names}

    return in_virtual_time(main)


class _Pair:
    """The first two gyros of a triad."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def sample(self, t_s: Any) -> Any:
        return self._array.sample(t_s)[:, :2]

    def temperature_c(self, t_s: float) -> float:
        return float(self._array.temperature_c(t_s))


@pytest.mark.parametrize(
    ("name", "step_rps"), [("sbg_ecan", 1e-3), ("xsens_mti600", 2**-9), ("aceinna_openimu300ri", np.radians(1 / 128))]
)
def test_three_gyros_of_one_device_are_one_source_with_its_accelerometer(name: str, step_rps: float) -> None:
    found, counts = run(load_mapping(name))
    block = found["imu"]
    assert list(found) == ["imu"]
    np.testing.assert_allclose(block.rate_rps, np.tile(np.radians(RATES_DPS), (len(block.t_ns), 1)), atol=step_rps / 2)
    assert block.accel_mps2 is not None
    np.testing.assert_allclose(block.accel_mps2, np.tile(FORCE, (len(block.t_ns), 1)), atol=0.006)
    assert np.ptp(np.diff(block.t_ns)) < 1000
    assert counts["imu"].samples == len(block.t_ns) >= 160  # the last are still gathered
    assert (counts["imu"].lost, counts["imu"].corrupt) == (0, 0)


def test_each_bosch_gyro_is_a_source_under_the_name_of_its_gyro() -> None:
    found, counts = run(load_mapping("bosch_mm5_10"))
    assert sorted(found) == ["x", "y"]
    np.testing.assert_allclose(np.degrees(found["x"].rate_rps), 10.0, atol=0.0026)
    np.testing.assert_allclose(np.degrees(found["y"].rate_rps), -20.0, atol=0.0026)


def test_temperature_is_that_of_the_device() -> None:
    found, _ = run(load_mapping("sbg_ecan"))
    assert found["imu"].temperature_c == pytest.approx(25.0, abs=0.1)
    late, _ = run(load_mapping("xsens_mti600"))
    assert np.isnan(late["imu"].temperature_c[0])  # sent once a second
    assert late["imu"].temperature_c[-1] == pytest.approx(25.0, abs=0.1)


@pytest.mark.parametrize("name", ["sbg_ecan", "xsens_mti600"])
def test_with_a_counter_or_a_time_what_is_dropped_and_doubled_is_counted_and_times_stay_right(name: str) -> None:
    found, counts = run(load_mapping(name), faults=NodeFaults(dropped=0.05, doubled=0.05, seed=3), duration_s=5.0)
    block = found["imu"]
    count = counts["imu"]
    assert count.lost > 10
    assert count.repeated > 10
    assert count.samples == len(block.t_ns)
    assert count.samples + count.lost == pytest.approx(485, abs=20)  # the last of 500 are still gathered
    # Every sample is at a multiple of 10 ms of the twin's clock, whatever is missing before it.
    phase_ns = (block.t_ns + 5_000_000) % 10_000_000 - 5_000_000
    assert np.abs(phase_ns).max() < 1000


def test_the_counter_of_a_device_is_given() -> None:
    found, counts = run(load_mapping("xsens_mti600"), rate_hz=100.0, duration_s=2.0)
    counter = found["imu"].counter
    assert counter is not None
    np.testing.assert_array_equal(np.diff(counter), 1)


def test_a_short_counter_wraps_and_its_losses_are_known(tmp_path: Path) -> None:
    mapping = own_mapping(tmp_path, counter="M.N")
    found, counts = run(mapping, faults=NodeFaults(dropped=0.1, seed=5), duration_s=6.0)
    counter = found["imu"].counter
    assert counter is not None
    assert counter.max() == 15
    assert counts["imu"].lost > 30
    t_s = found["imu"].t_ns * 1e-9
    np.testing.assert_allclose(np.diff(t_s) / 0.01, np.diff(counter) % 16, atol=1e-3)


def test_a_frame_whose_time_is_missing_is_lost_and_takes_no_other_sample_with_it() -> None:
    seen = [0]

    def without_some_times(msg: can.Message) -> list[can.Message]:
        seen[0] += msg.arbitration_id == 0x120
        return [] if msg.arbitration_id == 0x120 and seen[0] in (50, 51, 90) else [msg]

    found, counts = run(load_mapping("sbg_ecan"), tamper=without_some_times)
    assert counts["imu"].lost == 3
    assert counts["imu"].repeated == 0
    phase_ns = (found["imu"].t_ns + 5_000_000) % 10_000_000 - 5_000_000
    assert np.abs(phase_ns).max() < 1000


@pytest.mark.parametrize(("name", "identifier"), [("sbg_ecan", 0x121), ("xsens_mti600", 0x34)])
def test_a_sample_whose_acceleration_is_missing_has_none(name: str, identifier: int) -> None:
    seen = [0]

    def without_one(msg: can.Message) -> list[can.Message]:
        seen[0] += msg.arbitration_id == identifier
        return [] if msg.arbitration_id == identifier and seen[0] == 50 else [msg]

    found, _ = run(load_mapping(name), tamper=without_one)
    accel = found["imu"].accel_mps2
    assert accel is not None
    assert np.flatnonzero(np.isnan(accel).any(axis=1)).tolist() == [49]


def test_stuck_and_saturated_gyros_show_on_their_channels() -> None:
    found, _ = run(load_mapping("sbg_ecan"), faults=NodeFaults(saturated={1}, stuck={2}))
    rate = found["imu"].rate_rps
    np.testing.assert_allclose(rate[:, 1], -32.768)
    assert np.ptp(rate[:, 2]) == 0


@pytest.mark.parametrize("name", ["sbg_ecan", "aceinna_openimu300ri"])
def test_a_clock_that_runs_fast_is_followed(name: str) -> None:
    found, _ = run(load_mapping(name), faults=NodeFaults(clock_ppm=1000.0), duration_s=30.0)
    t_s = found["imu"].t_ns * 1e-9
    true_s = 0.01 / 1.001 * np.arange(1, len(t_s) + 1)
    assert np.abs(t_s - true_s)[2000:].max() < 2e-4


@pytest.mark.parametrize("name", SHIPPED)
def test_foreign_and_damaged_frames_do_no_harm(name: str) -> None:
    rng = np.random.default_rng(1)

    def with_noise(msg: can.Message) -> list[can.Message]:
        extended = bool(rng.integers(2))
        foreign = can.Message(
            arbitration_id=int(rng.integers(1 << 29 if extended else 0x70)) | (0 if extended else 0x600),
            is_extended_id=extended,
            data=rng.bytes(int(rng.integers(9))),
        )
        damaged = can.Message(
            arbitration_id=msg.arbitration_id, is_extended_id=msg.is_extended_id, data=bytes(msg.data)[:-1]
        )
        return [foreign, msg, damaged]

    clean, _ = run(load_mapping(name))
    found, counts = run(load_mapping(name), tamper=with_noise)
    for source, block in clean.items():
        np.testing.assert_array_equal(found[source].rate_rps, block.rate_rps)
        np.testing.assert_array_equal(found[source].t_ns, block.t_ns)
        assert counts[source].corrupt >= len(block.t_ns)


def test_j1939_frames_of_other_senders_are_not_taken_for_ours() -> None:
    def from_two(msg: can.Message) -> list[can.Message]:
        other = can.Message(arbitration_id=msg.arbitration_id ^ 1, is_extended_id=True, data=bytes(8))
        urgent = can.Message(arbitration_id=msg.arbitration_id & ~(7 << 26), is_extended_id=True, data=msg.data)
        return [other, urgent]  # priority is no part of what a message is

    found, counts = run(load_mapping("aceinna_openimu300ri"), tamper=from_two)
    np.testing.assert_allclose(
        np.degrees(found["imu"].rate_rps), np.tile(RATES_DPS, (len(found["imu"].t_ns), 1)), atol=0.004
    )
    assert counts["imu"].lost == 0


def test_j1939_codes_for_no_measurement_are_none() -> None:
    def without_y(msg: can.Message) -> list[can.Message]:
        if msg.arbitration_id == 0x0CF02A80:
            msg.data[2:4] = b"\xff\xff"
        return [msg]

    found, _ = run(load_mapping("aceinna_openimu300ri"), tamper=without_y)
    assert np.isnan(found["imu"].rate_rps[:, 1]).all()
    assert np.isfinite(found["imu"].rate_rps[:, [0, 2]]).all()


OWN_DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 2147483700 M: 8 A
 SG_ X : 7|16@0- (0.01,0) [0|0] "" A
 SG_ Y : 23|16@0- (0.01,0) [0|0] "" A
 SG_ Z : 39|16@0- (0.01,0) [0|0] "" A
 SG_ N : 60|4@1+ (1,0) [0|15] "" A
BO_ 200 F: 4 A
 SG_ Q : 0|32@1- (1,0) [0|0] "deg/s" A
SIG_VALTYPE_ 200 Q : 1;
"""
OWN_TOML = """name = "own"
dbc = "own.dbc"

[units]
rate = "deg/s"

[[sources]]
rate = ["M.X", "M.Y", "M.Z"]
"""


def own_mapping(folder: Path, text: str = OWN_TOML, **more: str) -> CanMapping:
    (folder / "own.dbc").write_text(OWN_DBC)
    (folder / "own.toml").write_text(text + "".join(f'{key} = "{value}"\n' for key, value in more.items()))
    return load_mapping("own.toml", folder)


def test_a_mapping_of_ones_own_with_units_that_the_dbc_does_not_state(tmp_path: Path) -> None:
    found, _ = run(own_mapping(tmp_path))
    rate = np.degrees(found["imu"].rate_rps)
    np.testing.assert_allclose(rate, np.tile(RATES_DPS, (len(rate), 1)), atol=0.005)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (OWN_TOML.replace("name", "nam", 1), "name is missing"),
        (OWN_TOML.replace('dbc = "own.dbc"', ""), "dbc is missing"),
        (OWN_TOML.replace("[[sources]]", "[[source]]"), "source: unknown key; did you mean sources?"),
        (OWN_TOML.split("[[")[0], "needs at least one [[sources]]"),
        (OWN_TOML + "speed = 1\n", "sources.0.speed: unknown key"),
        (OWN_TOML + "temperature = 3\n", "sources.0.temperature: 3 is not a text"),
        (OWN_TOML + 'acceleration = ["M.X"]\n', "sources.0.acceleration: names 1 signals, not x, y and z"),
        (OWN_TOML.replace('["M.X", "M.Y", "M.Z"]', "[]"), "sources.0.rate: []: write names"),
        (OWN_TOML.replace("deg/s", "furlong"), "units.rate: 'furlong': give one of deg/s, rad/s"),
        (OWN_TOML.replace("rate =", "rat =", 1), "units.rat: unknown key"),
        ('source_address = "x"\n' + OWN_TOML, "source_address: 'x' is not a whole number"),
        ("name = ", "not valid TOML"),
    ],
)
def test_a_mapping_that_is_wrong_is_refused_by_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(MappingError, match=r"own\.toml.*" + re.escape(message)):
        own_mapping(tmp_path, text)


def test_an_unknown_mapping_is_answered_by_those_that_there_are() -> None:
    with pytest.raises(MappingError, match="no CAN mapping sbg: give one of .*bosch_mm5_10.*sbg_ecan"):
        load_mapping("sbg")


def test_a_mapping_must_fit_the_array() -> None:
    with pytest.raises(MappingError, match=r"imu: the mapping SBG Systems ECAN has 3 gyros, but the array has 4"):
        channels_of(load_mapping("sbg_ecan"), "imu", ("a", "b", "c", "d"))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"counter": "F.Q"}, "Q in own.dbc is not an integer"),
        ({"counter": "M.N", "time": "M.N"}, "has unit '', not s or ms"),
        ({"temperature": "M.W"}, "own.dbc has no signal M.W. Write it as MESSAGE.Signal"),
    ],
)
def test_signals_that_cannot_be_what_the_mapping_says_are_refused(
    tmp_path: Path, more: dict[str, str], message: str
) -> None:
    mapping = own_mapping(tmp_path, **more)
    with pytest.raises(DeviceError, match=re.escape(message)):
        CanImu(
            ImuSetup("imu", 100.0, 0.5, signals=CanSource(mapping.dbc, channels(mapping))),
            CanLink("imu", "memory", "nowhere", {}),
        )


def test_rates_of_one_source_must_be_of_one_message(tmp_path: Path) -> None:
    mapping = own_mapping(tmp_path, OWN_TOML.replace('"M.Z"', '"F.Q"'))
    with pytest.raises(DeviceError, match="X, Y, Q, rates of one source, are in several messages"):
        CanImu(
            ImuSetup("imu", 100.0, 0.5, signals=CanSource(mapping.dbc, channels(mapping))),
            CanLink("imu", "memory", "nowhere", {}),
        )


@pytest.mark.parametrize("name", SHIPPED)
def test_cantools_decodes_the_twins_frames(name: str) -> None:
    database: Any = cantools.database.load_file(load_mapping(name).dbc)
    seen = set()

    def decode(msg: can.Message) -> list[can.Message]:
        values = database.decode_message(msg.arbitration_id, bytes(msg.data))
        message = database.get_message_by_frame_id(msg.arbitration_id)
        for signal, value in values.items():
            if signal in ("gyrX", "GYRO_X"):
                assert value == pytest.approx(np.radians(10.0), abs=0.001)
            if signal in ("Rate1", "Yaw_Rate"):
                assert value == pytest.approx(10.0, abs=0.01)
        seen.add(message.name)
        return [msg]

    run(load_mapping(name), tamper=decode)
    assert len(seen) >= 2


@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("sbg_ecan", 25_000),
        ("xsens_mti600", 25_000),
        ("bosch_mm5_10", 5_000),
        ("aceinna_openimu300ri", 5_000),
        *(pytest.param(name, 1_700_000, marks=[pytest.mark.full, pytest.mark.timeout(1800)]) for name in SHIPPED),
    ],
)
def test_random_frames_never_raise_and_are_not_kept(name: str, frames: int) -> None:
    mapping = load_mapping(name)
    database: Any = cantools.database.load_file(mapping.dbc)
    own = [(message.frame_id, message.is_extended_frame) for message in database.messages]

    async def main() -> int:
        imu = CanImu(ImuSetup("imu", 100.0, 0.5, signals=CanSource(mapping.dbc, channels(mapping))), Flood(own, frames))
        most = 0
        with suppress(LinkLost):
            async for _ in imu.blocks():
                sources = imu._sources.values()
                waiting = sum(len(inlet.waiting) for source in sources for inlet in source.inlets)
                pieces = sum(len(companion._pieces) for source in sources for companion in source._companions.values())
                most = max(most, waiting + pieces + sum(len(getattr(source._clock, "_held", ())) for source in sources))
        return most

    assert in_virtual_time(main) < 1000
