"""station completion: completion of commands, options and file names in a shell."""

import argparse
import sys

from station.errors import EXIT_USAGE
from station.run.outcome import Outcome

_FILES = ("FILE", "RECORDING", "RUN", "BENCH", "SCRIPT", "MAPPING", "DATA")
_FOLDERS = ("FOLDER",)


def command_completion(arguments: argparse.Namespace) -> int:
    """Print the completion script of a shell; return 0, or 2 if shtab does not know the shell."""
    import shtab

    parser: argparse.ArgumentParser = arguments.parser
    _name_files(parser, shtab.FILE, shtab.DIRECTORY)
    try:
        print(shtab.complete(parser, arguments.shell))
    except NotImplementedError:
        print(f"station: this version of shtab does not know {arguments.shell}: install 1.13 or newer", file=sys.stderr)
        return EXIT_USAGE
    return Outcome.PASS.exit_code


def _name_files(parser: argparse.ArgumentParser, file: object, folder: object) -> None:
    """Mark the arguments that are files or folders, by their metavar, in this parser and its subcommands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _name_files(command, file, folder)
        elif action.metavar in (*_FILES, *_FOLDERS):
            action.complete = folder if action.metavar in _FOLDERS else file  # type: ignore[attr-defined]
