"""Recordings made straight from the physics of the twins, without a wire: for studies and for planning."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from drivers.types import Floats
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import GRAVITY_MPS2, Site
from estimator.geometry.model import Prior
from estimator.geometry.noise import NoiseModel
from estimator.recordings.recording import ForceSheet, ImuData, Recording
from estimator.recordings.reference import TableReadings
from sims.direct import DirectRun, TimedMove, direct_run
from sims.physics.accelerometer import AccelerometerTruth
from sims.physics.geometry import MOUNTS_DEG, Mounting, mounted
from sims.physics.gyro import GyroTruth
from sims.physics.hidden import Hidden as Hidden, HiddenError
from station.bench.bench import Bench
from station.errors import BenchError
from station.opening.twins import force_truth_of, hidden_of, mounting_of, truth_of
from station.scripts.script import Script

GIMBALS = ("z", "y", "x")


@dataclass(frozen=True, slots=True, eq=False)
class DeviceTruth:
    """The true states (n, 4) of a simulated device, as in ``estimator.geometry.model.STATES``, and its noise.

    ``kind`` names a mounting known to the twins (triad, tetrahedron, dodecahedron); otherwise the twin is mounted as
    the array says. ``stated`` is the noise of the data sheet, which the recording holds.
    """

    array: SensorArray
    states: Floats
    arw_rps_rthz: float
    bias_instability_rps: float = 0.0
    rate_random_walk_rps_rts: float = 0.0
    rate_hz: float = 100.0
    prior: Prior = field(default_factory=Prior)
    kind: str | None = None
    stated: NoiseModel | None = None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SimulatedForces:
    """The accelerometers of a simulated device along its first three gyros: truth, true gravity, data sheet."""

    truth: AccelerometerTruth
    gravity_mps2: float
    sheet: ForceSheet | None = None


def simulate(
    script: Script,
    devices: Mapping[str, DeviceTruth],
    seed: int,
    *,
    site: Site | None,
    gimbals: Sequence[str] = GIMBALS,
    earth_turns: bool = True,
    hidden: Hidden | None = None,
    started_s: float = 0.0,
    mounts: Mapping[str, tuple[Mounting, GyroTruth]] | None = None,
    forces: Mapping[str, SimulatedForces] | None = None,
) -> Recording:
    """Return the recording of a script on a simulated table with these devices, one source each.

    No limits of a table are checked. Steps of open duration take their least. The same ``seed`` gives the same noise.
    Without a ``site`` the table stands at 45 deg latitude; without ``earth_turns`` there is no Earth rate in the data.
    ``hidden`` has the errors of devices and table; the recording does not mention them. Stamps begin at 0, when the
    bench clock, which temperature and hidden effects follow, is at ``started_s``: runs of one session follow each
    other. ``mounts`` replaces the mounting and truth of each device; ``forces`` states the accelerometers of those that
    have some. The only attribute of the recording is an empty text of a bench. ValueError without devices; HiddenError
    if the hidden effects do not fit a device.
    """
    moves = [
        TimedMove(start_s, turn.axis, turn.to_rad, abs(turn.rate_rps), turn.acceleration_rps2)
        for timed in script.timeline()
        for start_s, turn in timed.turns()
    ]
    latitude, heading = (site.latitude_rad, site.heading_rad) if site else (math.pi / 4, 0.0)
    sources: dict[str, ImuData] = {}
    reference: TableReadings | None = None
    for index, (name, device) in enumerate(devices.items()):
        mounting, truth = mounts[name] if mounts is not None else _stated_truth(device)
        felt = forces.get(name) if forces is not None else None
        first = Mounting(mounting.p[:3], mounting.j[:3], mounting.k[:3])
        run = direct_run(
            moves,
            script.least_s,
            mounting,
            truth,
            (seed, index),
            gimbals=gimbals,
            latitude_rad=latitude,
            heading_rad=heading,
            rate_hz=device.rate_hz,
            earth_turns=earth_turns,
            hidden=hidden.of_device(name) if hidden is not None else None,
            started_s=started_s,
            accelerometers=(first, felt.truth) if felt is not None else None,
            gravity_mps2=felt.gravity_mps2 if felt is not None else GRAVITY_MPS2,
        )
        sources[name] = _samples(name, device, run, felt)
        reference = TableReadings(
            t_ns=run.table_t_ns, angle_rad=run.angle_rad, rate_rps=run.rate_rps, gimbals=tuple(gimbals)
        )
    if reference is None:
        raise ValueError("a simulation needs one device or more")
    # An empty bench, not none: stamps of gyros and table are those of one clock, as of every run of the station.
    return Recording(sources, reference, site, {"bench": ""})


def _samples(name: str, device: DeviceTruth, run: DirectRun, felt: SimulatedForces | None) -> ImuData:
    """Return the samples of a device from its ``run``, with those of its accelerometers if it ``felt`` any.

    These lie along its first three gyros.
    """
    data = ImuData(
        device.array,
        run.t_ns,
        run.output_rps,
        temperature_c=run.temperature_c,
        prior=device.prior,
        noise=device.stated,
        device=name,
    )
    if felt is None:
        return data
    return replace(data, accel_mps2=run.force_mps2, accel_axes=device.array.p[:3], accel_sheet=felt.sheet)


def simulate_bench(bench: Bench, script: Script, seed: int) -> Recording:
    """Return the recording of a script on the twins of a bench, one source for each used device.

    The same ``seed`` gives the same noise. The recording has the mountings of the devices, the stated uncertainty of
    the table, and the text of the bench, the seed and the script's name as attributes. BenchError if the hidden effects
    do not fit the devices or a truth is invalid.
    """
    truths = bench.twin.truths.again()
    used = [imu for imu in bench.imus if imu.used]
    devices = {
        imu.name: DeviceTruth(
            imu.array,
            np.zeros((len(imu.array), 4)),
            imu.noise.arw,
            rate_hz=imu.rate_hz,
            prior=imu.prior,
            stated=imu.noise,
        )
        for imu in used
    }
    forces: dict[str, SimulatedForces] = {}
    for imu in used:
        felt = force_truth_of(truths, imu, bench.site)
        if felt is not None:
            forces[imu.name] = SimulatedForces(truth=felt[0], gravity_mps2=felt[1], sheet=imu.force_sheet)
    mounts = {imu.name: (mounting_of(truths, imu), truth_of(truths, imu)) for imu in used}
    try:
        recording = simulate(
            script,
            devices,
            seed,
            site=bench.site,
            gimbals=bench.table.gimbals,
            hidden=hidden_of(bench),
            started_s=bench.twin.started_s,
            mounts=mounts,
            forces=forces,
        )
    except HiddenError as error:
        raise BenchError(f"{bench.twin.hidden}: {error}") from None
    if recording.table is not None:
        reference = replace(recording.table, uncertainty=bench.table.uncertainty)
        recording = replace(recording, reference=reference)
    sources = {imu.name: replace(recording.sources[imu.name], mounting=imu.mounting) for imu in used}
    recording = replace(recording, sources=sources)
    return replace(recording, attributes={"bench": bench.text, "seed": seed, "script": script.name})


def _stated_truth(device: DeviceTruth) -> tuple[Mounting, GyroTruth]:
    """Return the mounting and the truth that a device states itself.

    One that names a ``kind`` of array is mounted as that on the bench is, else as its array says.
    """
    mounting = mounted(MOUNTS_DEG[device.kind]) if device.kind else None
    k, b_rps, sigma_j, sigma_k = device.states.T
    truth = GyroTruth(
        k,
        b_rps,
        sigma_j,
        sigma_k,
        device.arw_rps_rthz,
        bias_instability_rps=device.bias_instability_rps,
        rate_random_walk_rps_rts=device.rate_random_walk_rps_rts,
    )
    return mounting or Mounting(device.array.p, device.array.j, device.array.k), truth
