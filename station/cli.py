"""The command line: station run, twin, calibrate, import."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from typing import NoReturn

from station.errors import EXIT_ABORTED, EXIT_USAGE

_MODULES = {
    "run": "station.commands",
    "twin": "station.commands",
    "calibrate": "station.commands",
    "import": "station.commands",
}
"""Where the function of each command is, by the command's name: ``command_NAME(arguments) -> exit code``."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_USAGE, f"station: {message}\ntry: {self.prog} --help\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0 pass, 1 fail, 2 wrong usage, 3 aborted, 4 device fault."""
    arguments = _parser().parse_args(argv)
    try:
        # The libraries behind the commands cost a second: --help does without.
        module = importlib.import_module(_MODULES[arguments.command])
        return int(getattr(module, f"command_{arguments.command}")(arguments))
    except KeyboardInterrupt:
        print("station: stopped by Ctrl-C before anything moved", file=sys.stderr)
        return EXIT_ABORTED
    except BrokenPipeError:
        sys.stderr.close()
        return EXIT_USAGE


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="station",
        description="Turntable calibration station: drives a rate table, records gyros, calibrates them live.",
        epilog="exit codes: 0 pass, 1 fail against limits, 2 wrong usage or unreadable input, 3 aborted,"
        " 4 device fault",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    run = commands.add_parser(
        "run",
        help="run a script on a bench and calibrate",
        description="Run a script on a bench; without options: the 360 s script on the built-in twins, virtual time.",
    )
    _bench_options(run)
    run.add_argument("--script", metavar="FILE", help="script (.toml); default: the 360 s script, x, y and z in turn")
    run.add_argument("--output", "-o", metavar="FILE", help="recording to write; default: recordings/run-DATE-TIME.h5")
    run.add_argument(
        "--scale",
        type=_positive,
        metavar="F",
        help="run F times as fast as real time, with twins only; default: virtual time if every link is twin:, else 1",
    )
    run.add_argument("--reset-fault", action="store_true", help="clear faults of the table before enabling it")
    run.add_argument("--json", action="store_true", help="print the result as one JSON object")

    twin = commands.add_parser(
        "twin",
        help="serve the twins of a bench on real ports",
        description="Serve the twins of a bench on real ports until Ctrl-C; each address is a line of JSON.",
    )
    twin.add_argument("--bench", metavar="FILE", help="bench file (.toml); default: the built-in bench")
    twin.add_argument("--scale", type=_positive, default=1.0, metavar="F", help="run F times as fast as real time")
    twin.add_argument("--seed", type=_seed, help="seed of the twins' noise, instead of the bench file's")
    twin.add_argument("--host", default="127.0.0.1", help="address to listen on; default: 127.0.0.1")
    twin.add_argument("--port", type=int, default=0, help="Modbus TCP port; default: any free one")

    calibrate = commands.add_parser(
        "calibrate",
        help="estimate the states of the gyros in recordings",
        description="Estimate bias, scale factor error and misalignments of every gyro in each recording.",
    )
    calibrate.add_argument("recordings", nargs="+", metavar="RECORDING", help="recording (.h5)")
    calibrate.add_argument(
        "--bench", metavar="FILE", help="bench file whose limits to judge by; default: the recording's"
    )
    calibrate.add_argument(
        "--write", action="store_true", help="write the result into the recording, group /calibration"
    )
    calibrate.add_argument("--json", action="store_true", help="print each result as one JSON object, one a line")

    bring = commands.add_parser(
        "import",
        help="bring in data measured elsewhere",
        description="Turn CSV, TSV or MATLAB files into a recording, as a mapping file says.",
    )
    bring.add_argument("mapping", metavar="MAPPING", help="mapping file (.toml)")
    bring.add_argument("data", nargs="+", metavar="DATA", help="data files; several become one recording")
    bring.add_argument("--output", "-o", metavar="FILE", required=True, help="recording to write")
    bring.add_argument("--json", action="store_true", help="print the result as one JSON object")
    return parser


def _bench_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--bench", metavar="FILE", help="bench file (.toml); default: the built-in twins")
    parser.add_argument(
        "--link",
        action="append",
        default=[],
        metavar="DEVICE=URL",
        help="use another link for a device of the bench, for instance table=tcp://127.0.0.1:5020; may be repeated",
    )
    parser.add_argument(
        "--device", action="append", default=[], metavar="NAME", help="device under test to use; may be repeated"
    )
    parser.add_argument("--seed", type=_seed, help="seed of the twins' noise, instead of the bench file's")


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < 1e4:
        raise argparse.ArgumentTypeError("must be above 0 and below 10000")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


if __name__ == "__main__":
    sys.exit(main())
