"""The command line: one function for the options of each command; what they do is elsewhere."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Mapping, Sequence
from typing import NoReturn

from station.errors import EXIT_ABORTED, EXIT_USAGE
from station.exporting.held import HELD
from station.worker_pool import ONE_BLAS_THREAD

# Matrices here are small: threads of the linear algebra library gain nothing, and on a busy machine they wait for
# each other for seconds. It reads this when it is loaded.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

_MODULES = {
    "run": "station.commands",
    "twin": "station.commands",
    "calibrate": "station.calibrate_command",
    "import": "station.commands",
    "check": "station.check_command",
    "completion": "station.completion_command",
    "effects": "station.effects_command",
    "export": "station.export_command",
    "init": "station.init_command",
    "investigate": "station.investigate_command",
    "loop": "station.loop_command",
    "plan": "station.plan_command",
    "report": "station.report_command",
    "study": "station.studies.command",
    "ui": "station.ui_command",
}
"""Where the function of each command is, by the command's name: ``command_NAME(arguments) -> exit code``."""


_GROUPS = (
    ("set up a bench", ("init", "check", "twin", "completion")),
    ("measure", ("plan", "run", "ui", "loop")),
    ("recordings", ("import", "calibrate", "investigate", "effects")),
    ("hand over", ("report", "export")),
    ("studies", ("study",)),
)
"""The commands in the order of work, as --help shows them."""

_EXAMPLES = (
    ("station run", "the 360 s script on the built-in twins, no hardware needed"),
    ("station init my_bench.toml", "describe your own hardware"),
    ("station check my_bench.toml", "does everything answer? nothing moves"),
    ("station run --bench my_bench.toml", "drive the script, record, calibrate"),
    ("station calibrate --write recordings", "estimate again from all recordings in a folder"),
    ("station export RUN.h5 --format c -o gyros.h", "the correction function for your firmware"),
)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_USAGE, f"station: {message}\ntry: {self.prog} --help\n")


class _Commands:
    """The commands of the station; keeps the line that --help has for each."""

    def __init__(self, parser: argparse.ArgumentParser) -> None:
        self._added = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
        self.lines: dict[str, str] = {}

    def add_parser(self, name: str, *, help: str, description: str) -> argparse.ArgumentParser:
        self.lines[name] = help
        return self._added.add_parser(name, help=help, description=description)


class _Station(_Parser):
    """The parser above the commands: its help lists them in the order of work."""

    lines: Mapping[str, str] = {}

    def format_help(self) -> str:
        listed = {name for _, names in _GROUPS for name in names}
        groups = (*_GROUPS, ("more", tuple(name for name in self.lines if name not in listed)))
        parts = [f"{self.description}\n\nusage: station COMMAND [options]; station COMMAND --help says what it takes\n"]
        for title, names in groups:
            there = [name for name in names if name in self.lines]
            if there:
                parts.append("\n".join([f"{title}:", *(f"  {name:<12} {self.lines[name]}" for name in there), ""]))
        parts.append("\n".join(["examples:", *(f"  {typed:<46} {does}" for typed, does in _EXAMPLES), ""]))
        return "\n".join([*parts, f"{self.epilog}\n"])


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0 pass, 1 fail, 2 wrong usage, 3 aborted, 4 device fault."""
    arguments = make_parser().parse_args(argv)
    os.environ.update(ONE_BLAS_THREAD)  # before any command imports numpy
    command = "ui" if getattr(arguments, "ui", False) else arguments.command
    try:
        # The libraries behind the commands cost a second: --help does without.
        module = importlib.import_module(_MODULES[command])
        return int(getattr(module, f"command_{command}")(arguments))
    except KeyboardInterrupt:
        print("station: stopped by Ctrl-C before anything moved", file=sys.stderr)
        return EXIT_ABORTED
    except BrokenPipeError:
        sys.stderr.close()
        return EXIT_USAGE


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line; no library is imported for it."""
    parser = _Station(
        prog="station",
        description="Turntable calibration station: drives a rate table, records gyros, calibrates them live.",
        epilog="exit codes: 0 pass, 1 fail against limits, 2 wrong usage or unreadable input, 3 aborted,"
        " 4 device fault",
    )
    commands = _Commands(parser)
    parser.lines = commands.lines

    run = commands.add_parser(
        "run",
        help="run a script on a bench and calibrate",
        description="Run a script on a bench; without options: the 360 s script on the built-in twins, virtual time.",
    )
    _bench_options(run)
    run.add_argument("--script", metavar="FILE", help="script (.toml); default: the 360 s script, x, y and z in turn")
    run.add_argument("--output", "-o", metavar="FILE", help="recording to write; default: recordings/run-DATE-TIME.h5")
    _speed_options(run)
    _model_option(run)
    run.add_argument(
        "--end-early",
        action="store_true",
        help="stop when every sigma that the bench requires ([limits], sd_...) is reached and the residual is clean",
    )
    _hosting_options(run)
    run.add_argument("--json", action="store_true", help="print the result as one JSON object")
    run.add_argument("--ui", action="store_true", help="begin on the operator's screen, with these options filled in")

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

    check = commands.add_parser(
        "check",
        help="see that everything on a bench answers",
        description="Open every device of a bench, ask what it is, read the table and listen to each source for two"
        " seconds; say what is wrong and what to do. Nothing moves. Exit code 4 if something is wrong.",
    )
    check.add_argument("bench", nargs="?", metavar="BENCH", help="bench file (.toml); default: the built-in bench")
    _device_options(check)
    check.add_argument("--scale", type=_positive, metavar="F", help="twins run F times as fast as real time")
    check.add_argument("--json", action="store_true", help="print the result as one JSON object")

    calibrate = commands.add_parser(
        "calibrate",
        help="estimate the states of the gyros in recordings",
        description="Estimate bias, scale factor error and misalignments of every gyro in each recording,"
        " several at once on all cores or on a Dask cluster.",
    )
    calibrate.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="recording (.h5), or a folder: every .h5 in it and below"
    )
    calibrate.add_argument(
        "--bench", metavar="FILE", help="bench file whose limits to judge by; default: the recording's"
    )
    calibrate.add_argument(
        "--write", action="store_true", help="write the result into the recording, group /calibration"
    )
    _model_option(calibrate)
    _campaign_options(calibrate)
    calibrate.add_argument("--json", action="store_true", help="print each result as one JSON object, one a line")

    bring = commands.add_parser(
        "import",
        help="bring in data measured elsewhere",
        description="Turn CSV, TSV, MATLAB or binary files, or captures, into a recording, as a mapping file says. "
        "Files that cannot be used are named at the end, with exit code 2; the others are taken.",
    )
    bring.add_argument("mapping", metavar="MAPPING", help="mapping file (.toml)")
    bring.add_argument("data", nargs="+", metavar="DATA", help="data files; several become one recording")
    bring.add_argument("--output", "-o", metavar="FILE", required=True, help="recording to write")
    bring.add_argument("--json", action="store_true", help="print the result as one JSON object")

    study = commands.add_parser(
        "study",
        help="run a comparison over many seeds",
        description="Run a comparison on recordings made from the twins' physics, many seeds on all cores.",
    )
    studies = study.add_subparsers(dest="study", required=True, metavar="STUDY", parser_class=_Parser)
    paper = studies.add_parser(
        "paper",
        help="the paper's experiment again, beside its Tables 2 and 3",
        description="Run the paper's experiment to the letter and by this station's default, beside its own tables.",
    )
    _study_options(paper, seeds=200)
    paper.add_argument("--plot", metavar="FILE", help="draw the convergence of every state (.png, .svg or .pdf)")
    paper.add_argument("--output", "-o", metavar="FILE", help="write the curves and their recording (.h5)")
    baselines = studies.add_parser(
        "baselines",
        help="other ways to calibrate, on the same data",
        description="Run the methods that the paper names beside this station's: error, stated sigma, time, work.",
    )
    _study_options(baselines, seeds=20)
    detection = studies.add_parser(
        "detection",
        help="how often effects that only the twin knows are found",
        description="Give twins effects that the estimator is not told of; count what it finds, by effect and size.",
    )
    _study_options(detection, seeds=20)
    detection.add_argument(
        "--effects",
        default="clean,single",
        metavar="LIST",
        help="names of effects, or clean, single, pairs, triples, unknown; default: %(default)s",
    )
    detection.add_argument(
        "--sizes", default="1,0.3,0.1", metavar="LIST", help="sizes, 1 being plain to see; default: %(default)s"
    )
    _plan_options(
        commands.add_parser(
            "plan",
            help="say what a script will show, before anything moves",
            description="Say what a script will show on a bench before anything moves: sigmas of the states, the"
            " smallest effects that would be found, effects that look alike. Exit code 1 if a sigma that the bench"
            " requires is not reached.",
        )
    )
    _investigate_options(
        commands.add_parser(
            "investigate",
            help="trace in recordings what the error model lacks",
            description="Find the residual of recordings, trace it to the effect that the model lacks, add that effect,"
            " state the error before and after. Exit code 0: nothing to add, or added; 1: cannot tell, or unexplained.",
        )
    )
    effects = commands.add_parser(
        "effects",
        help="list the effects that an investigation looks for",
        description="List the catalogue: parameters with their largest plausible size, what shows each effect, what it"
        " is confused with.",
    )
    effects.add_argument("--json", action="store_true", help="print the list as JSON")
    _loop_options(
        commands.add_parser(
            "loop",
            help="calibrate, explore, verify, trace on the bench, and drive what tells rivals apart",
            description="Close the loop on a bench: drive the 360 s script, an exploration and a verification script,"
            " investigate, drive the next script if causes cannot be told apart, and end with one report. Exit codes as"
            " investigate; 3 and 4 if a run is aborted or a device fails.",
        )
    )
    _ui_options(
        commands.add_parser(
            "ui",
            help="show the operator's screen",
            description="Prepare, run, judge and look back, in a terminal of 80 x 24 characters or more. A run is a"
            " session of its own: it goes on when the screen is closed, and --attach shows it again. F9 stops the table"
            " from everywhere.",
        )
    )
    _init_options(
        commands.add_parser(
            "init",
            help="write a bench file, asking what hardware there is",
            description="Ask what stands in the lab, check every answer at once, and write a bench file with comments."
            " What is not there yet gets a twin, so that the file runs as it is.",
        )
    )
    _export_options(
        commands.add_parser(
            "export",
            help="write a calibration for firmware, robotics tools, autopilots",
            description="Write the calibration in a recording as data, as source code with the correction function, or"
            " for other systems. What a format cannot hold is said on stderr and in the file. --list tells them all.",
        )
    )
    _completion_options(
        commands.add_parser(
            "completion",
            help="print what a shell needs to complete commands and files",
            description="Print what a shell needs to complete commands, options and files. bash: station completion"
            " bash > ~/.local/share/bash-completion/completions/station; zsh: > a folder of $fpath, as _station;"
            " fish: > ~/.config/fish/completions/station.fish; tcsh: > ~/.station.tcsh, and source it in ~/.tcshrc.",
        )
    )
    _report_options(
        commands.add_parser(
            "report",
            help="write the report of a recording: HTML and PDF",
            description="Write the report of a calibrated recording as one HTML file that needs nothing else: a"
            " certificate if it passed its limits. Exit code 0 if it is written, whatever it says.",
        )
    )
    return parser


def _ui_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--script", metavar="FILE", help="script (.toml); default: the 360 s script")
    _bench_options(parser)
    parser.add_argument(
        "--scale", type=_positive, metavar="F", help="run F times as fast as real time, with twins only; default: 5"
    )
    parser.add_argument("--folder", metavar="FOLDER", help="folder of the recordings; default: recordings")
    parser.add_argument("--attach", action="store_true", help="show the session that runs")
    parser.add_argument(
        "--web",
        nargs="?",
        type=int,
        const=8000,
        metavar="PORT",
        help="show it in a browser of this machine, at the address that is printed; default port: 8000",
    )


def _init_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", default="bench.toml", metavar="FILE", help="default: bench.toml")
    parser.add_argument(
        "--defaults", action="store_true", help="ask nothing: take what is proposed, and what the options below say"
    )
    parser.add_argument("--table", metavar="PROTOCOL", help="modbus, galil, acutrol or aerosmith")
    parser.add_argument("--table-link", metavar="URL", help="where the table is; default: twin:")
    parser.add_argument(
        "--imu",
        action="append",
        default=[],
        metavar="PROTOCOL",
        help="can, j1939, stim300, vectornav or xsens; may be repeated",
    )
    parser.add_argument(
        "--imu-link", action="append", default=[], metavar="URL", help="where each --imu is, in their order"
    )
    parser.add_argument("--force", action="store_true", help="write over a file that is there")


def _export_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", nargs="?", metavar="RUN", help="recording (.h5) that holds a calibration")
    parser.add_argument("--format", choices=tuple(HELD), metavar="FORMAT", help=f"one of {', '.join(HELD)}")
    parser.add_argument("--output", "-o", default="-", metavar="FILE", help="file to write, a new one; default: stdout")
    parser.add_argument("--force", action="store_true", help="write over a file that is there")
    parser.add_argument(
        "--device",
        action="append",
        default=[],
        metavar="NAME",
        help="device under test, if the recording holds several; several that are one array: repeat it",
    )
    parser.add_argument(
        "--instance",
        type=int,
        default=0,
        metavar="N",
        help="which of the gyros of an autopilot (px4, ardupilot) it is, from 0; default: 0",
    )
    parser.add_argument("--list", action="store_true", help="say what each format holds, and what it does not")
    parser.add_argument("--json", action="store_true", help="print what was written, or the list, as one JSON object")


def _completion_options(parser: argparse.ArgumentParser) -> None:
    shells = ("bash", "zsh", "fish", "tcsh")
    parser.add_argument("shell", choices=shells, metavar="SHELL", help="bash, zsh, fish or tcsh")


def _report_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recording", metavar="RECORDING", help="recording (.h5) that holds a calibration")
    parser.add_argument(
        "--output", "-o", metavar="FILE", help="new file to write, .html, or .pdf for both; default: beside RECORDING"
    )
    parser.add_argument(
        "--pdf", action="store_true", help="print a PDF, too, by Chromium, Chrome, Edge or $STATION_BROWSER"
    )
    parser.add_argument(
        "--investigation",
        metavar="FILE",
        help="what `station investigate -o FILE` wrote of this device; default: what RECORDING holds",
    )
    parser.add_argument("--json", action="store_true", help="print what was written as one JSON object")


def _investigate_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="recording (.h5) to fit and trace, or a folder of them"
    )
    parser.add_argument(
        "--verify",
        nargs="+",
        action="extend",
        default=[],
        metavar="RECORDING",
        help="recording that only judges: used neither to fit nor to choose",
    )
    _effects_option(parser)
    parser.add_argument(
        "--bench", metavar="FILE", help="bench file whose table the next script is for; default: the recording's"
    )
    parser.add_argument(
        "--next-script",
        metavar="FILE",
        help="script to write if causes cannot be told apart, a new file; default: next-script.toml, or"
        " next-script-2.toml",
    )
    parser.add_argument("--output", "-o", metavar="FILE", help="file to keep the results in (.h5), a new file")
    parser.add_argument("--plot", metavar="FILE", help="draw the residuals before and after (.png, .svg or .pdf)")
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def _loop_options(parser: argparse.ArgumentParser) -> None:
    _bench_options(parser)
    _speed_options(parser)
    _effects_option(parser)
    parser.add_argument(
        "--minutes",
        type=_positive,
        default=30.0,
        metavar="M",
        help="table time that may be used, the first three runs (16.6 min) included; default: 30",
    )
    parser.add_argument(
        "--output", "-o", metavar="FOLDER", help="folder for the recordings; default: recordings/loop-DATE-TIME"
    )
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def _effects_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--most-effects", type=_count, default=4, metavar="N", help="effects to add at the most; default: 4"
    )


def _model_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model",
        metavar="FILE",
        help="error model of this type of gyro, to begin with: what `station investigate -o FILE` wrote of another"
        " device; its effects are estimated beside the states",
    )


def _speed_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scale",
        type=_positive,
        metavar="F",
        help="run F times as fast as real time, with twins only; default: virtual time if every link is twin:, else 1",
    )
    parser.add_argument("--reset-fault", action="store_true", help="clear faults of the table before enabling it")


def _hosting_options(run: argparse.ArgumentParser) -> None:
    run.add_argument("--operator", metavar="NAME", help="who runs it, for the record; the bench may state a pattern")
    run.add_argument(
        "--serial-number",
        metavar="TEXT",
        help="serial number of the device under test, for the record; default: what the device itself says",
    )
    run.add_argument(
        "--host",
        action="store_true",
        help="let a screen look on, stop, pause and add notes through a local socket; the run then outlives its"
        " terminal, and takes real time unless --scale says otherwise",
    )


def _plan_options(plan: argparse.ArgumentParser) -> None:
    plan.add_argument("script", nargs="?", metavar="SCRIPT", help="script (.toml); default: the 360 s script")
    plan.add_argument("--bench", metavar="FILE", help="bench file (.toml); default: the built-in twins")
    plan.add_argument(
        "--device", action="append", default=[], metavar="NAME", help="device under test to plan for; may be repeated"
    )
    plan.add_argument(
        "--temperature-rise",
        metavar="QUANTITY",
        help='how much the gyros are taken to warm in an hour; default: "8 degC"',
    )
    plan.add_argument("--json", action="store_true", help="print the plan as one JSON object")
    _improve_options(
        plan.add_argument_group(
            "a better script",
            "--improve searches the scripts that the table can do for the least time to the sigmas that SCRIPT reaches,"
            " and writes what it finds. Exit code 1 if they cannot be reached.",
        )
    )


def _improve_options(better: argparse._ArgumentGroup) -> None:
    better.add_argument("--improve", action="store_true", help="find a better script and write it")
    better.add_argument(
        "--output", "-o", metavar="FILE", help="script to write, a new file; default: improved.toml, or improved-2.toml"
    )
    better.add_argument(
        "--for", dest="time_given", metavar="TIME", help='find the least sigmas in this time, for instance "150 s"'
    )
    better.add_argument(
        "--criterion",
        choices=("D", "A"),
        default="D",
        help="what is made small where time is left: D, the determinants of the covariances, or A, the mean of the"
        " variances, each against what is required; default: D",
    )
    better.add_argument(
        "--states",
        metavar="LIST",
        default="k,b,sigma",
        help="states that count, of k, b, sigma, sigma_j and sigma_k; default: k,b,sigma",
    )
    better.add_argument(
        "--sigmas",
        choices=("script", "bench"),
        default="script",
        help="what is required: the sigmas that SCRIPT reaches, or those of the bench file ([limits], sd_...);"
        " default: script",
    )
    better.add_argument(
        "--margin",
        metavar="SHARE",
        default="2 %",
        help='stay this much below, since the noise that a run finds scatters; default: "2 %%"',
    )
    better.add_argument(
        "--rest", metavar="TIME", default="5 s", help='least rest at the beginning and at the end; default: "5 s"'
    )
    better.add_argument(
        "--one-way",
        action="store_true",
        help="also take scripts that turn no axis back: shorter, but blind to scale factors that differ by direction",
    )


def _study_options(parser: argparse.ArgumentParser, *, seeds: int) -> None:
    parser.add_argument("--seeds", type=_count, default=seeds, metavar="N", help=f"how many; default: {seeds}")
    _campaign_options(parser)
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def _bench_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--bench", metavar="FILE", help="bench file (.toml); default: the built-in twins")
    _device_options(parser)


def _device_options(parser: argparse.ArgumentParser) -> None:
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


def _campaign_options(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=_count, metavar="N", help="work in N processes; default: one a core")
    where.add_argument("--scheduler", metavar="tcp://HOST:PORT", help="work on the Dask cluster of this scheduler")


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < 1e4:
        raise argparse.ArgumentTypeError("must be above 0 and below 10000")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return value


def _seed(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


if __name__ == "__main__":
    sys.exit(main())
