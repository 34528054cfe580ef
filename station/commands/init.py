"""station init: makes a bench file from answers about the hardware."""

import argparse
import os
import shlex
import sys
from itertools import zip_longest
from pathlib import Path

from drivers.imus.registry import IMUS
from drivers.tables.registry import TABLES, USUAL_TABLE
from station.atomic_write import write_whole
from station.bench.bench import Bench, load_bench
from station.bench.table import TWIN
from station.errors import EXIT_ABORTED, ScriptError, UsageError, sentence
from station.init.asking import Data
from station.init.bench_text import bench_text
from station.init.dialogue import Dialogue, EndedError
from station.init.hardware import can_interfaces, serial_ports
from station.init.imu import ask_imu
from station.init.links import Links
from station.init.other import ask_others, other_kinds
from station.init.rest import ask_rest
from station.init.table import ask_table
from station.render.template import rendered
from station.run.outcome import Outcome
from station.scripts.script import check, paper_script


def command_init(arguments: argparse.Namespace) -> int:
    """Ask about the bench, write the bench file, and print the next commands; return 0.

    Return 3 if the questions were not finished; then nothing is written. UsageError for wrong options or a place that
    cannot be written to.
    """
    path = Path(arguments.file)
    try:
        dialogue = Dialogue(asks=not arguments.defaults)
        _check_options(arguments)
        _check_place(path, dialogue, arguments.force)
        answers = _ask(dialogue, arguments, path)
        write_whole(path, bench_text(answers, other_kinds()), replace=True, verify=load_bench)
        _say_next(path, load_bench(path))
    except (KeyboardInterrupt, EndedError):
        print("\nstation: stopped before the last question, so nothing was written", file=sys.stderr)
        return EXIT_ABORTED
    return Outcome.PASS.exit_code


def _check_options(arguments: argparse.Namespace) -> None:
    for option, given, known in (("--table", [arguments.table or USUAL_TABLE], TABLES), ("--imu", arguments.imu, IMUS)):
        for name in given:
            if name not in known:
                raise UsageError(f"{option} {name}: give one of {', '.join(known)}")
    if len(arguments.imu_link) > max(len(arguments.imu), 1):
        raise UsageError("there are more --imu-link than --imu")


def _check_place(path: Path, dialogue: Dialogue, force: bool) -> None:
    """Check, before anything is asked, that the file can be written; UsageError if not.

    A file that exists is overwritten with ``force``, or if the person at ``dialogue`` agrees; else UsageError.
    """
    if path.is_dir():
        raise UsageError(f"{path} is a folder. Give the name of a file")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise UsageError(f"{folder} is not writable. Give a file in another folder")
    if path.exists() and not force:
        if not dialogue.asks:
            raise UsageError(f"{path} exists already. Give another name, or --force to overwrite it")
        if not dialogue.agrees(f"{path} exists already. Overwrite it?", False):
            raise UsageError(f"{path} is unchanged. Give another name")


def _ask(dialogue: Dialogue, arguments: argparse.Namespace, path: Path) -> Data:
    """Return the bench from the answers: name, table, devices under test, devices of other kinds, and the rest.

    Options state protocols and links beforehand; there is one device under test at least. If nobody is asked, there are
    no devices beyond these, and all else is as proposed.
    """
    dialogue.say(sentence("init.begin"))
    folder = path.absolute().parent
    links = Links(serial_ports(), can_interfaces()) if dialogue.asks else Links()
    name = dialogue.ask("\nname of the bench", path.stem, _check_name)
    table = ask_table(dialogue, links, folder, arguments.table or "", arguments.table_link or "")
    imus: list[Data] = []
    for protocol, link in zip_longest(arguments.imu or [""], arguments.imu_link, fillvalue=""):
        imus.append(ask_imu(dialogue, links, folder, protocol, link, [imu["name"] for imu in imus]))
    while dialogue.asks and dialogue.agrees("\nAnother device under test?", False):
        imus.append(ask_imu(dialogue, links, folder, "", "", [imu["name"] for imu in imus]))
    names = [imu["name"] for imu in imus]
    others: Data = {}
    for kind in other_kinds() if dialogue.asks else ():
        made = ask_others(dialogue, links, folder, kind, names)
        if made:
            others[kind.name] = made[0] if kind.single else made
    return ask_rest(dialogue, {"name": name, "table": table, "imu": imus, **others}, tuple(others))


def _check_name(text: str) -> None:
    if not text:
        raise UsageError("give it a name")


def _say_next(path: Path, bench: Bench) -> None:
    """Print what was written and the next commands, and whether the usual script fits the table."""
    links = {device.name: device.links[0] for device in bench.devices.values()}
    unfit = ""
    try:
        check(paper_script(), bench.table.limits)
    except ScriptError as error:
        unfit = str(error)
    twins = [device for device, link in links.items() if link == TWIN]
    values = {"path": path, "twins": twins, "named": shlex.quote(str(path)), "unfit": unfit}
    print(rendered("station.commands", "init_next.txt", values), end="")
