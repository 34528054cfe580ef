from .calibration.calibration_file import read_calibration as read_calibration
from .calibration.error_model import ErrorModel as ErrorModel
from .calibration.values import Calibration as Calibration
from .effects.catalogue import catalogue as catalogue
from .effects.effect import Effect as Effect, Parameter as Parameter
from .errors import EstimatorError as EstimatorError
from .estimation.calibrate import calibrate as calibrate
from .geometry.array import (
    SensorArray as SensorArray,
    cone as cone,
    dodecahedron as dodecahedron,
    sensor_array as sensor_array,
    tetrahedron as tetrahedron,
    triad as triad,
)
from .geometry.kinematics import Site as Site
from .importing.importing import import_recording as import_recording
from .importing.mapping.mapping import read_mapping as read_mapping
from .plots import plot_errors as plot_errors, plot_rates as plot_rates, plot_states as plot_states
from .recordings.reading import read_recording as read_recording
from .recordings.recording import ImuData as ImuData, Recording as Recording
from .recordings.writing import write_recording as write_recording
from .tracing.investigate import investigate as investigate
