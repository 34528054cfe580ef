"""The command line: ``commands.toml`` defines commands and options, other modules carry them out."""

import argparse
import codecs
import difflib
import gc
import importlib
import io
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import entry_points
from types import ModuleType
from typing import Any, NoReturn

from drivers.errors import DeviceError
from drivers.packaged import packaged_toml
from drivers.plugins import PluginError
from estimator.errors import EstimatorError
from estimator.untrusted import harmless
from station.bench.plugins import use_effects
from station.campaigns import ONE_BLAS_THREAD
from station.computer.facilities import missing_facility
from station.errors import EXIT_ABORTED, EXIT_FAULT, EXIT_USAGE, UsageError, sentence
from station.exports import GROUP as EXPORTS
from station.render.lines import tell

_UNLOOKED = 10_000  # objects that may be made before garbage is looked for; by default 700
_NO_ROOM = ("can't start new thread", "failed to map segment")
_MODULES = {"import": "station.commands.importing"}
"""Where the function of a command is, if not in a module of its name: ``command_NAME(arguments) -> exit code``."""

_TYPED: dict[str, Any] = packaged_toml("station.commands", "commands.toml")
"""What can be typed, and its help."""
COMMANDS: dict[str, dict[str, Any]] = _TYPED["commands"]
"""Of each command its ``line`` in --help, the ``text`` of its own help, and its ``options``."""


class _Forms:
    """Names of the export formats, those of packages included, as choices.

    Any name is accepted, as a file may provide it.
    """

    def __contains__(self, name: object) -> bool:
        return True

    def __iter__(self) -> Iterator[str]:
        return iter((*packaged_toml("station.exports", "held.toml"), *(e.name for e in entry_points(group=EXPORTS))))


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        tell(f"station: {message}\ntry: {self.prog} --help", sys.stderr)
        self.exit(EXIT_USAGE)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Raise ArgumentError for a value that is not among the choices of ``action``.

        For a mistyped command the message names the nearest one, or all commands where none is near.
        """
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            near = difflib.get_close_matches(value, action.choices, n=1)
            suggestion = f": did you mean {near[0]!r}?" if near else f": the commands are {', '.join(action.choices)}"
            raise argparse.ArgumentError(None, f"there is no command {value!r}{suggestion}")
        super()._check_value(action, value)


class _Station(_Parser):
    """The parser above the commands; its help lists them in the order of work."""

    def format_help(self) -> str:
        parts = [f"{self.description}\n\nusage: station COMMAND [options]; station COMMAND --help says what it takes\n"]
        for title, names in _TYPED["groups"].items():
            parts.append("\n".join([f"{title}:", *(f"  {name:<12} {COMMANDS[name]['line']}" for name in names), ""]))
        parts.append("\n".join(["examples:", *(f"  {typed:<46} {does}" for typed, does in _TYPED["examples"]), ""]))
        return "\n".join([*parts, f"{self.epilog}\n"])


def _take(parser: argparse._ActionsContainer, spelled: str, help: str, **more: Any) -> None:
    """Add one option or argument to a parser from its description in the TOML file.

    A last word in capitals in ``spelled`` names the value that follows ("--output -o FILE"). Without one the option is
    a flag, unless ``more`` has choices, a default or a type. "bench BENCH" is a positional argument. ``more`` is
    passed to argparse, with the type by its name in ``_TYPES``; the choices "formats" stand for those of --format, and
    an option that may be repeated is an empty list by default.
    """
    names = spelled.split()
    if len(names) > 1 and not names[-1].startswith("-"):
        more["metavar"] = names.pop()
    elif not more.keys() & {"choices", "default", "type"}:
        more["action"] = "store_true"
    if more.get("action") == "append":
        more["default"] = []
    if "choices" in more:
        more["choices"] = _Forms() if more["choices"] == "formats" else tuple(more["choices"])
    if "type" in more:
        more["type"] = _TYPES[more["type"]]
    parser.add_argument(*names, help=help, **more)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0 pass, 1 fail, 2 wrong usage, 3 aborted, 4 device fault.

    ``argv`` defaults to the arguments of the process. 2, too, if the system lacks something or stdout was closed.
    SystemExit with 0 after --help, and with 2 for arguments that do not parse. With --ui the command ``ui`` is run in
    place of the one typed. Environment variables of this process are set, for it and all that it starts.
    Garbage is looked for less often from then on.
    """
    _spell_out()
    parser, typed = make_parser(), sys.argv[1:] if argv is None else list(argv)
    arguments = parser.parse_args(typed)
    arguments.parser, arguments.typed = parser, typed  # for a shell's completion; for the start of a browser's screen
    # Before any command imports numpy. Matrices here are small: threads of the linear algebra library gain nothing,
    # and on a busy machine they wait for each other for seconds.
    if missing := missing_facility():
        tell(f"station: {missing}", sys.stderr)
        return EXIT_USAGE
    os.environ.update(ONE_BLAS_THREAD)
    gc.set_threshold(_UNLOOKED)  # hardly any object here is garbage: to look for it took a seventh of a report's time
    os.environ["PYTHONSAFEPATH"] = "1"  # no process that is started, of a pool or a screen, imports from its folder
    command = "ui" if getattr(arguments, "ui", False) else arguments.command
    try:
        return _carry_out(command, arguments)
    except BrokenPipeError:  # the reader of stdout is gone
        sys.stderr.close()
        return EXIT_USAGE


def _carry_out(command: str, arguments: argparse.Namespace) -> int:
    """Import and call the function of a command, after registering effects of plug-ins; return its exit code.

    Problems of plug-ins are printed, and the command is run nevertheless. Errors of the station are printed, with
    --json as an empty result, too: a DeviceError gives 4, others 2. Lack of memory or threads gives 2, Ctrl-C 3. Any
    other exception is raised.
    """
    module = None
    try:
        # The libraries behind the commands cost a second: --help does without.
        module = importlib.import_module(_MODULES.get(command, f"station.commands.{command}"))
        for problem in use_effects(getattr(arguments, "plugin", [])):
            tell(f"station: {problem}", sys.stderr)
        return int(getattr(module, f"command_{command}")(arguments))
    except (UsageError, EstimatorError, DeviceError, PluginError) as error:
        return _refuse(error, module, arguments)
    except (MemoryError, ImportError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and not any(words in str(error) for words in _NO_ROOM):
            raise
        return _refuse(UsageError(sentence("run.short_of_memory")), module, arguments)
    except KeyboardInterrupt:
        print("station: stopped by Ctrl-C", file=sys.stderr)
        return EXIT_ABORTED


def _spell_out() -> None:
    """Make stdout and stderr replace characters that they cannot encode: a few by words such as "deg", others by "?".

    Streams that have been replaced by something else than a TextIOWrapper, as in tests, are left alone.
    """
    words = {"±": "+-", "…": "...", "°": "deg", "µ": "u", "→": "->", "–": "-"}

    def in_other_letters(error: UnicodeError) -> tuple[str, int]:
        assert isinstance(error, UnicodeEncodeError)
        return "".join(words.get(letter, "?") for letter in error.object[error.start : error.end]), error.end

    codecs.register_error("station", in_other_letters)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="station")


def _refuse(error: Exception, module: ModuleType | None, arguments: argparse.Namespace) -> int:
    """Print the error on stderr and, with --json, an empty result on stdout; return 4 for a device, else 2.

    A command whose result has its own keys makes the empty result with ``refused(reason, arguments)`` in its
    ``module``. All others, and those whose module could not be imported (None), give the common one.
    """
    tell(f"station: {harmless(str(error))}", sys.stderr)
    fault = isinstance(error, DeviceError)
    if getattr(arguments, "json", False):
        from station.render.printing import empty_object

        refused = getattr(module, "refused", None)
        empty = refused(str(error), arguments) if refused else empty_object(str(error), "FAULT" if fault else None)
        print(json.dumps(empty))
    return EXIT_FAULT if fault else EXIT_USAGE


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line; no library is imported for it."""
    parser = _Station(prog="station", description=_TYPED["description"], epilog=_TYPED["epilog"])
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    for name, described in COMMANDS.items():
        _add_command(commands, name, described)
    return parser


def _add(parser: argparse._ActionsContainer, options: Sequence[Any]) -> None:
    """Add options to a parser, each given in one of three forms.

    It is a list ``[spelled, help]`` or ``[spelled, help, table of keywords]`` for ``_take``, the name of a list of
    shared options, or a table whose ``either`` lists mutually exclusive options.
    """
    for option in options:
        if isinstance(option, str):
            _add(parser, _TYPED["shared"][option])
        elif isinstance(option, dict):
            _add(parser.add_mutually_exclusive_group(), option["either"])
        else:
            spelled, text, *more = option
            _take(parser, spelled, text, **(more[0] if more else {}))


def _add_command(commands: "argparse._SubParsersAction[_Parser]", name: str, options: dict[str, Any]) -> None:
    parser = commands.add_parser(name, help=options["line"], description=options["text"])
    _add(parser, options.get("options", ()))
    if "group" in options:
        _add(
            parser.add_argument_group(options["group"]["title"], options["group"]["text"]), options["group"]["options"]
        )


def _number(kind: type[float], fits: Callable[[float], bool], wrong: str) -> Callable[[str], float]:
    """Return a converter for argparse of text to a number of type ``kind``.

    It raises ArgumentTypeError with the text ``wrong`` for a number for which ``fits`` is false, and ValueError for a
    text that is no number.
    """

    def read(text: str) -> float:
        if not fits(value := kind(text)):
            raise argparse.ArgumentTypeError(wrong)
        return value

    read.__name__ = "whole number" if kind is int else "number"  # the name that argparse prints
    return read


_TYPES: dict[str, Callable[[str], float]] = {
    "positive": _number(float, lambda value: 0 < value < 1e4, "must be above 0 and below 10000"),
    "count": _number(int, lambda value: value >= 1, "must be 1 or more"),
    "seed": _number(int, lambda value: value >= 0, "must not be negative"),
    "int": int,
}


if __name__ == "__main__":
    sys.exit(main())
