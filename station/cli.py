"""The command line: one function for the options of each command; what they do is elsewhere."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from station.errors import EXIT_ABORTED, EXIT_USAGE
from station.exporting.held import HELD
from station.worker_pool import ONE_BLAS_THREAD

_MODULES = dict.fromkeys(("run", "twin", "import"), "station.commands") | {"study": "station.studies.command"}
"""Where the function of a command is, if not in a module of its name: ``command_NAME(arguments) -> exit code``."""

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


class _Station(_Parser):
    """The parser above the commands: its help lists them in the order of work."""

    def format_help(self) -> str:
        parts = [f"{self.description}\n\nusage: station COMMAND [options]; station COMMAND --help says what it takes\n"]
        for title, names in _GROUPS:
            parts.append("\n".join([f"{title}:", *(f"  {name:<12} {COMMANDS[name][0]}" for name in names), ""]))
        parts.append("\n".join(["examples:", *(f"  {typed:<46} {does}" for typed, does in _EXAMPLES), ""]))
        return "\n".join([*parts, f"{self.epilog}\n"])


def _take(parser: argparse._ActionsContainer, spelled: str, help: str, **more: Any) -> None:
    """Add what is typed: a name in capitals says that a value follows, as in "--output -o FILE"; else it is a flag.

    "bench BENCH" is an argument by its place; ``more`` goes to argparse as it is.
    """
    names = spelled.split()
    if len(names) > 1 and not names[-1].startswith("-"):
        more["metavar"] = names.pop()
    elif not more.keys() & {"choices", "default", "type"}:
        more["action"] = "store_true"
    if more.get("action") == "append":
        more["default"] = []
    parser.add_argument(*names, help=help, **more)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0 pass, 1 fail, 2 wrong usage, 3 aborted, 4 device fault."""
    arguments = make_parser().parse_args(argv)
    # Before any command imports numpy. Matrices here are small: threads of the linear algebra library gain nothing,
    # and on a busy machine they wait for each other for seconds.
    os.environ.update(ONE_BLAS_THREAD)
    command = "ui" if getattr(arguments, "ui", False) else arguments.command
    try:
        # The libraries behind the commands cost a second: --help does without.
        module = importlib.import_module(_MODULES.get(command, f"station.{command}_command"))
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
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for name, (line, description, options) in COMMANDS.items():
        options(commands.add_parser(name, help=line, description=description))
    return parser


def _run_options(run: argparse.ArgumentParser) -> None:
    _bench_options(run)
    _take(run, "--script FILE", "script (.toml); default: the 360 s script, x, y and z in turn")
    _take(run, "--output -o FILE", "recording to write; default: recordings/run-DATE-TIME.h5")
    _speed_options(run)
    _model_option(run)
    _take(
        run,
        "--end-early",
        "stop when every sigma that the bench requires ([limits], sd_...) is reached and the residual is clean",
    )
    _take(run, "--operator NAME", "who runs it, for the record; the bench may state a pattern")
    _take(
        run,
        "--serial-number TEXT",
        "serial number of the device under test, for the record; default: what the device itself says",
    )
    _take(
        run,
        "--host",
        "let a screen look on, stop, pause and add notes through a local socket; the run then outlives its"
        " terminal, and takes real time unless --scale says otherwise",
    )
    _json_option(run)
    _take(run, "--ui", "begin on the operator's screen, with these options filled in")


def _twin_options(twin: argparse.ArgumentParser) -> None:
    _take(twin, "--bench FILE", "bench file (.toml); default: the built-in bench")
    _take(twin, "--scale F", "run F times as fast as real time", type=_positive, default=1.0)
    _seed_option(twin)
    _take(twin, "--host", "address to listen on; default: 127.0.0.1", default="127.0.0.1")
    _take(twin, "--port", "Modbus TCP port; default: any free one", type=int, default=0)


def _check_options(check: argparse.ArgumentParser) -> None:
    _take(check, "bench BENCH", "bench file (.toml); default: the built-in bench", nargs="?")
    _device_options(check)
    _take(check, "--scale F", "twins run F times as fast as real time", type=_positive)
    _json_option(check)


def _calibrate_options(calibrate: argparse.ArgumentParser) -> None:
    _take(calibrate, "recordings RECORDING", "recording (.h5), or a folder: every .h5 in it and below", nargs="+")
    _take(calibrate, "--bench FILE", "bench file whose limits to judge by; default: the recording's")
    _take(calibrate, "--write", "write the result into the recording, group /calibration")
    _model_option(calibrate)
    _campaign_options(calibrate)
    _json_option(calibrate, "each result as one JSON object, one a line")


def _import_options(bring: argparse.ArgumentParser) -> None:
    _take(bring, "mapping MAPPING", "mapping file (.toml)")
    _take(bring, "data DATA", "data files; several become one recording", nargs="+")
    _take(bring, "--output -o FILE", "recording to write", required=True)
    _json_option(bring)


def _study_options(study: argparse.ArgumentParser) -> None:
    studies = study.add_subparsers(dest="study", required=True, metavar="STUDY", parser_class=_Parser)
    paper, baselines, detection = (
        studies.add_parser(name, help=line, description=description) for name, line, description in _STUDIES
    )
    for parser, seeds in ((paper, 200), (baselines, 20), (detection, 20)):
        _take(parser, "--seeds N", f"how many; default: {seeds}", type=_count, default=seeds)
        _campaign_options(parser)
        _json_option(parser)
    _take(paper, "--plot FILE", "draw the convergence of every state (.png, .svg or .pdf)")
    _take(paper, "--output -o FILE", "write the curves and their recording (.h5)")
    _take(
        detection,
        "--effects LIST",
        "names of effects, or clean, single, pairs, triples, unknown; default: %(default)s",
        default="clean,single",
    )
    _take(detection, "--sizes LIST", "sizes, 1 being plain to see; default: %(default)s", default="1,0.3,0.1")


def _ui_options(ui: argparse.ArgumentParser) -> None:
    _take(ui, "--script FILE", "script (.toml); default: the 360 s script")
    _bench_options(ui)
    _take(ui, "--scale F", "run F times as fast as real time, with twins only; default: 5", type=_positive)
    _take(ui, "--folder FOLDER", "folder of the recordings; default: recordings")
    _take(ui, "--attach", "show the session that runs")
    _take(
        ui,
        "--web PORT",
        "show it in a browser of this machine, at the address that is printed; default port: 8000",
        nargs="?",
        type=int,
        const=8000,
    )


def _init_options(init: argparse.ArgumentParser) -> None:
    _take(init, "file FILE", "default: bench.toml", nargs="?", default="bench.toml")
    _take(init, "--defaults", "ask nothing: take what is proposed, and what the options below say")
    _take(init, "--table PROTOCOL", "modbus, galil, acutrol or aerosmith")
    _take(init, "--table-link URL", "where the table is; default: twin:")
    _take(init, "--imu PROTOCOL", "can, j1939, stim300, vectornav or xsens; may be repeated", action="append")
    _take(init, "--imu-link URL", "where each --imu is, in their order", action="append")
    _take(init, "--force", "write over a file that is there")


def _export_options(export: argparse.ArgumentParser) -> None:
    _take(export, "recording RUN", "recording (.h5) that holds a calibration", nargs="?")
    _take(export, "--format FORMAT", f"one of {', '.join(HELD)}", choices=tuple(HELD))
    _take(export, "--output -o FILE", "file to write, a new one; default: stdout", default="-")
    _take(export, "--force", "write over a file that is there")
    _take(
        export,
        "--device NAME",
        "device under test, if the recording holds several; several that are one array: repeat it",
        action="append",
    )
    _take(
        export,
        "--instance N",
        "which of the gyros of an autopilot (px4, ardupilot) it is, from 0; default: 0",
        type=int,
        default=0,
    )
    _take(export, "--list", "say what each format holds, and what it does not")
    _json_option(export, "what was written, or the list, as one JSON object")


def _completion_options(completion: argparse.ArgumentParser) -> None:
    _take(completion, "shell SHELL", "bash, zsh, fish or tcsh", choices=("bash", "zsh", "fish", "tcsh"))


def _report_options(report: argparse.ArgumentParser) -> None:
    _take(report, "recording RECORDING", "recording (.h5) that holds a calibration")
    _take(report, "--output -o FILE", "new file to write, .html, or .pdf for both; default: beside RECORDING")
    _take(report, "--pdf", "print a PDF, too, by Chromium, Chrome, Edge or $STATION_BROWSER")
    _take(
        report,
        "--investigation FILE",
        "what `station investigate -o FILE` wrote of this device; default: what RECORDING holds",
    )
    _json_option(report, "what was written as one JSON object")


def _investigate_options(investigate: argparse.ArgumentParser) -> None:
    _take(investigate, "recordings RECORDING", "recording (.h5) to fit and trace, or a folder of them", nargs="+")
    _take(
        investigate,
        "--verify RECORDING",
        "recording that only judges: used neither to fit nor to choose",
        nargs="+",
        action="extend",
        default=[],
    )
    _effects_option(investigate)
    _take(investigate, "--bench FILE", "bench file whose table the next script is for; default: the recording's")
    _take(
        investigate,
        "--next-script FILE",
        "script to write if causes cannot be told apart, a new file; default: next-script.toml, or next-script-2.toml",
    )
    _take(investigate, "--output -o FILE", "file to keep the results in (.h5), a new file")
    _take(investigate, "--plot FILE", "draw the residuals before and after (.png, .svg or .pdf)")
    _json_option(investigate)


def _loop_options(loop: argparse.ArgumentParser) -> None:
    _bench_options(loop)
    _speed_options(loop)
    _effects_option(loop)
    _take(
        loop,
        "--minutes M",
        "table time that may be used, the first three runs (16.6 min) included; default: 30",
        type=_positive,
        default=30.0,
    )
    _take(loop, "--output -o FOLDER", "folder for the recordings; default: recordings/loop-DATE-TIME")
    _json_option(loop)


def _plan_options(plan: argparse.ArgumentParser) -> None:
    _take(plan, "script SCRIPT", "script (.toml); default: the 360 s script", nargs="?")
    _take(plan, "--bench FILE", "bench file (.toml); default: the built-in twins")
    _take(plan, "--device NAME", "device under test to plan for; may be repeated", action="append")
    _take(plan, "--temperature-rise QUANTITY", 'how much the gyros are taken to warm in an hour; default: "8 degC"')
    _json_option(plan, "the plan as one JSON object")
    better = plan.add_argument_group(
        "a better script",
        "--improve searches the scripts that the table can do for the least time to the sigmas that SCRIPT reaches,"
        " and writes what it finds. Exit code 1 if they cannot be reached.",
    )
    _take(better, "--improve", "find a better script and write it")
    _take(better, "--output -o FILE", "script to write, a new file; default: improved.toml, or improved-2.toml")
    _take(better, "--for TIME", 'find the least sigmas in this time, for instance "150 s"', dest="time_given")
    _take(
        better,
        "--criterion",
        "what is made small where time is left: D, the determinants of the covariances, or A, the mean of the"
        " variances, each against what is required; default: D",
        choices=("D", "A"),
        default="D",
    )
    _take(
        better,
        "--states LIST",
        "states that count, of k, b, sigma, sigma_j and sigma_k; default: k,b,sigma",
        default="k,b,sigma",
    )
    _take(
        better,
        "--sigmas",
        "what is required: the sigmas that SCRIPT reaches, or those of the bench file ([limits], sd_...);"
        " default: script",
        choices=("script", "bench"),
        default="script",
    )
    _take(
        better,
        "--margin SHARE",
        'stay this much below, since the noise that a run finds scatters; default: "2 %%"',
        default="2 %",
    )
    _take(better, "--rest TIME", 'least rest at the beginning and at the end; default: "5 s"', default="5 s")
    _take(
        better,
        "--one-way",
        "also take scripts that turn no axis back: shorter, but blind to scale factors that differ by direction",
    )


def _json_option(parser: argparse.ArgumentParser, what: str = "the result as one JSON object") -> None:
    _take(parser, "--json", f"print {what}")


def _effects_option(parser: argparse.ArgumentParser) -> None:
    _take(parser, "--most-effects N", "effects to add at the most; default: 4", type=_count, default=4)


def _model_option(parser: argparse.ArgumentParser) -> None:
    _take(
        parser,
        "--model FILE",
        "error model of this type of gyro, to begin with: what `station investigate -o FILE` wrote of another"
        " device; its effects are estimated beside the states",
    )


def _speed_options(parser: argparse.ArgumentParser) -> None:
    _take(
        parser,
        "--scale F",
        "run F times as fast as real time, with twins only; default: virtual time if every link is twin:, else 1",
        type=_positive,
    )
    _take(parser, "--reset-fault", "clear faults of the table before enabling it")


def _bench_options(parser: argparse.ArgumentParser) -> None:
    _take(parser, "--bench FILE", "bench file (.toml); default: the built-in twins")
    _device_options(parser)


def _device_options(parser: argparse.ArgumentParser) -> None:
    _take(
        parser,
        "--link DEVICE=URL",
        "use another link for a device of the bench, for instance table=tcp://127.0.0.1:5020; may be repeated",
        action="append",
    )
    _take(parser, "--device NAME", "device under test to use; may be repeated", action="append")
    _seed_option(parser)


def _seed_option(parser: argparse.ArgumentParser) -> None:
    _take(parser, "--seed", "seed of the twins' noise, instead of the bench file's", type=_seed)


def _campaign_options(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group()
    _take(where, "--jobs N", "work in N processes; default: one a core", type=_count)
    _take(where, "--scheduler tcp://HOST:PORT", "work on the Dask cluster of this scheduler")


COMMANDS: dict[str, tuple[str, str, Callable[[argparse.ArgumentParser], None]]] = {
    "run": (
        "run a script on a bench and calibrate",
        "Run a script on a bench; without options: the 360 s script on the built-in twins, virtual time.",
        _run_options,
    ),
    "twin": (
        "serve the twins of a bench on real ports",
        "Serve the twins of a bench on real ports until Ctrl-C; each address is a line of JSON.",
        _twin_options,
    ),
    "check": (
        "see that everything on a bench answers",
        "Open every device of a bench, ask what it is, read the table and listen to each source for two"
        " seconds; say what is wrong and what to do. Nothing moves. Exit code 4 if something is wrong.",
        _check_options,
    ),
    "calibrate": (
        "estimate the states of the gyros in recordings",
        "Estimate bias, scale factor error and misalignments of every gyro in each recording,"
        " several at once on all cores or on a Dask cluster.",
        _calibrate_options,
    ),
    "import": (
        "bring in data measured elsewhere",
        "Turn CSV, TSV, MATLAB or binary files, or captures, into a recording, as a mapping file says. "
        "Files that cannot be used are named at the end, with exit code 2; the others are taken.",
        _import_options,
    ),
    "study": (
        "run a comparison over many seeds",
        "Run a comparison on recordings made from the twins' physics, many seeds on all cores.",
        _study_options,
    ),
    "plan": (
        "say what a script will show, before anything moves",
        "Say what a script will show on a bench before anything moves: sigmas of the states, the"
        " smallest effects that would be found, effects that look alike. Exit code 1 if a sigma that the bench"
        " requires is not reached.",
        _plan_options,
    ),
    "investigate": (
        "trace in recordings what the error model lacks",
        "Find the residual of recordings, trace it to the effect that the model lacks, add that effect,"
        " state the error before and after. Exit code 0: nothing to add, or added; 1: cannot tell, or unexplained.",
        _investigate_options,
    ),
    "effects": (
        "list the effects that an investigation looks for",
        "List the catalogue: parameters with their largest plausible size, what shows each effect, what it"
        " is confused with.",
        lambda parser: _json_option(parser, "the list as JSON"),
    ),
    "loop": (
        "calibrate, explore, verify, trace on the bench, and drive what tells rivals apart",
        "Close the loop on a bench: drive the 360 s script, an exploration and a verification script,"
        " investigate, drive the next script if causes cannot be told apart, and end with one report. Exit codes as"
        " investigate; 3 and 4 if a run is aborted or a device fails.",
        _loop_options,
    ),
    "ui": (
        "show the operator's screen",
        "Prepare, run, judge and look back, in a terminal of 80 x 24 characters or more. A run is a"
        " session of its own: it goes on when the screen is closed, and --attach shows it again. F9 stops the table"
        " from everywhere.",
        _ui_options,
    ),
    "init": (
        "write a bench file, asking what hardware there is",
        "Ask what stands in the lab, check every answer at once, and write a bench file with comments."
        " What is not there yet gets a twin, so that the file runs as it is.",
        _init_options,
    ),
    "export": (
        "write a calibration for firmware, robotics tools, autopilots",
        "Write the calibration in a recording as data, as source code with the correction function, or"
        " for other systems. What a format cannot hold is said on stderr and in the file. --list tells them all.",
        _export_options,
    ),
    "completion": (
        "print what a shell needs to complete commands and files",
        "Print what a shell needs to complete commands, options and files. bash: station completion"
        " bash > ~/.local/share/bash-completion/completions/station; zsh: > a folder of $fpath, as _station;"
        " fish: > ~/.config/fish/completions/station.fish; tcsh: > ~/.station.tcsh, and source it in ~/.tcshrc.",
        _completion_options,
    ),
    "report": (
        "write the report of a recording: HTML and PDF",
        "Write the report of a calibrated recording as one HTML file that needs nothing else: a"
        " certificate if it passed its limits. Exit code 0 if it is written, whatever it says.",
        _report_options,
    ),
}
"""Of each command its line in --help, what it does, and what adds its options."""
_STUDIES = (
    (
        "paper",
        "the paper's experiment again, beside its Tables 2 and 3",
        "Run the paper's experiment to the letter and by this station's default, beside its own tables.",
    ),
    (
        "baselines",
        "other ways to calibrate, on the same data",
        "Run the methods that the paper names beside this station's: error, stated sigma, time, work.",
    ),
    (
        "detection",
        "how often effects that only the twin knows are found",
        "Give twins effects that the estimator is not told of; count what it finds, by effect and size.",
    ),
)


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
