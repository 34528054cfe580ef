"""An export form of one's own: a function for GNU Octave or MATLAB that makes body rates of raw ones.

``station export RUN.h5 --plugin octave_form.py --format octave -o calibrated.m`` writes it. It holds constants alone:
bias, scale and misalignment, with what effects of temperature come to at the mean of the calibration.
"""

from drivers.types import Floats
from station.exports.exported import Exported
from station.exports.formats import Format
from station.exports.written import Written, delay_line, head, lines_of, number


def write(exported: Exported) -> Written:
    """Return the text of the file, and a line for each thing that the calibration has and the file has not."""
    # What is not constant is left out, each with its reason.
    constants, dropped = exported.compensation.simplified((), exported.seen.temperature_c[1])
    not_held = (*lines_of({**exported.compensation.left_out, **dropped}), *delay_line(exported))
    what = "RATE = CALIBRATED(RAW): body rates (N, 3) of raw outputs (N, gyros), in rad/s"
    lines = [
        "function rate = calibrated(raw)",
        *head(exported, what, not_held, "%"),
        f"  solution = [{'; '.join(map(_row, constants.solution))}];",
        f"  bias = [{_row(constants.bias_rps)}];",
        "  rate = (raw - bias) * solution.';",
        "end",
    ]
    return Written("\n".join(lines) + "\n", not_held)


def _row(values: Floats) -> str:
    return " ".join(number(value) for value in values)  # 17 digits: the same doubles again


FORMAT = Format(
    name="octave",
    write=write,
    holds="function of GNU Octave or MATLAB with scale, misalignment and bias",
    lacks="no effects",
)
