"""What a script shows of accelerometers, found by a simulated run of it with the noise of the data sheet."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from estimator.calibration.accelerometer import ForceCalibration
from estimator.estimation.accelerometers.calibrate_forces import calibrate_forces
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.recordings.recording import Recording
from estimator.tracing.accelerometers.trace_forces import effect_sigmas
from estimator.types import Floats
from sims.physics.accelerometer import AccelerometerTruth
from station.bench.bench import Bench, ForceLimits
from station.bench.imu import ImuConfig
from station.opening.simulate import DeviceTruth, SimulatedForces, simulate
from station.scripts.script import Script

_SEED = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlannedForces:
    """What a script shows of the accelerometers of one device.

    ``calibration`` has the sigmas that a run will have; its values are those of a simulated run without errors.
    ``notes`` say what the script does not show. ``effects`` are by name the standard deviations (p,) of the parameters
    of each effect, looked for alone, rms over the accelerometers.
    """

    device: str
    calibration: ForceCalibration
    notes: tuple[str, ...]
    effects: Mapping[str, Floats]

    def missed(self, limits: ForceLimits) -> tuple[str, ...]:
        """Return the names of the accelerometers whose sigmas exceed the limits, and "lever arm" if its sigma does."""
        wide = [one.name for one in self.calibration.accelerometers if not np.all(one.sd <= limits.sds)]
        return tuple(wide) if np.all(self.calibration.arm_sd_m <= limits.sd_arm_m) else (*wide, "lever arm")


def planned_forces(script: Script, bench: Bench) -> list[PlannedForces]:
    """Return what a script shows of the accelerometers of each used device that states a data sheet for them."""
    return [one for imu in bench.imus if imu.used and imu.force_sheet and (one := _planned(script, bench, imu))]


def _planned(script: Script, bench: Bench, imu: ImuConfig) -> PlannedForces | None:
    """Return what a script shows of one device, which states a sheet; None if it is too short to show anything."""
    recording = simulated_run(script, bench, imu)
    forces, notes = calibrate_forces(recording)
    if not forces or not forces[0].accelerometers:
        return None
    effects = effect_sigmas(recording, imu.name)
    return PlannedForces(device=imu.name, calibration=forces[0], notes=tuple(notes), effects=effects)


def simulated_run(script: Script, bench: Bench, imu: ImuConfig) -> Recording:
    """Return a simulated run of a device without errors, the same at every call.

    Its noise is that of the data sheets: white noise of gyros, white noise and instability of accelerometers. The
    device has to state a sheet for the latter. Gravity is that of the site, else the standard one; the table's
    uncertainty is that of the bench.
    """
    sheet = imu.force_sheet
    assert sheet is not None
    count = len(imu.array.p[:3])
    none = np.zeros(count)
    truth = AccelerometerTruth(
        k=none,
        b_mps2=none,
        sigma_j_rad=none,
        sigma_k_rad=none,
        places_m=np.zeros((count, 3)),
        vrw_mps2_rthz=sheet.noise.arw,
        bias_instability_mps2=sheet.noise.instability,
    )
    gravity_mps2 = GRAVITY_MPS2 if bench.site is None else bench.site.local_gravity_mps2
    device = DeviceTruth(imu.array, np.zeros((len(imu.array), 4)), imu.noise.arw, rate_hz=imu.rate_hz, prior=imu.prior)
    recording = simulate(
        script,
        {imu.name: device},
        _SEED,
        site=bench.site,
        gimbals=bench.table.gimbals,
        forces={imu.name: SimulatedForces(truth=truth, gravity_mps2=gravity_mps2, sheet=sheet)},
    )
    table = recording.table
    assert table is not None
    return replace(recording, reference=replace(table, uncertainty=bench.table.uncertainty))
