"""station run: a script on a bench, or motions by hand, into a recording with its calibration."""

import argparse
import asyncio
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from drivers.errors import DeviceError
from estimator.calibration.error_model import ErrorModel
from estimator.errors import MISSHAPEN, EstimatorError
from estimator.estimation.accelerometers.force_effects import laws_of_model
from estimator.untrusted import harmless
from station.atomic_write import check_new_recording, new_recording
from station.bench.bench import Bench
from station.commands.common import chosen_bench, clock, drive, run_object
from station.computer.facilities import peer_note
from station.errors import UsageError, sentence
from station.remote.after_run import tell_program
from station.remote.hosting import Host
from station.render.archive.moved import moved_since
from station.render.lines import tell
from station.render.printing import print_result, refuse
from station.render.terminal import line, print_all, stdout
from station.run.early_end import check_early_end
from station.run.event_loop.detached_output import lasting_streams
from station.run.event_loop.loops import run_to_end
from station.run.event_loop.signals import ignore_hang_up
from station.run.outcome import Outcome
from station.run.session import RunOptions
from station.scripts.script import Script, check, load_script, paper_script


def command_run(arguments: argparse.Namespace) -> int:
    """Run a script on a bench, or drive by hand; return the exit code.

    With --host, which --manual sets in ``arguments``, the run continues if its terminal is closed.
    """
    arguments.host |= arguments.manual
    if arguments.host:
        ignore_hang_up()
    with lasting_streams() if arguments.host else nullcontext():
        return _run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    """Run a script on a bench into a recording, or drive by hand; print the result and return the exit code.

    Wrong usage and devices that cannot be opened are printed, too. For a run with a serial number, not hosted and not
    as JSON, states that moved since the last one are printed. The program that the bench names is started after the
    run; its failure is only a note.
    """
    try:
        bench = chosen_bench(arguments)
        operator = bench.checked_operator(arguments.operator) if arguments.operator is not None else ""
        serial = bench.checked_serial(arguments.serial_number) if arguments.serial_number is not None else ""
        if arguments.manual and (arguments.script or arguments.end_early or arguments.model):
            raise UsageError(sentence("run.manual_alone"))
        script = Script("manual", ()) if arguments.manual else paper_script()
        if arguments.script:
            script = load_script(Path(arguments.script), bench.plugin_files, bench.table.gimbals[0])
        script = check(script, bench.table.limits)
        if arguments.end_early:
            check_early_end(bench)
        model = _model_of(arguments, bench)
        path = Path(arguments.output) if arguments.output else new_recording(Path("recordings"))
        check_new_recording(path)
        scale = arguments.scale or (1.0 if arguments.host else None)  # virtual time has no sockets
        host = Host(scale or 1.0) if arguments.host else None
        if host is not None and (note := peer_note()):
            tell(f"note: {note}", sys.stderr)
        options = RunOptions(
            reset_fault=arguments.reset_fault,
            end_early=arguments.end_early,
            model=model,
            operator=operator,
            device_serial=serial,
            serial_reason=arguments.serial_reason or "",
            outlives_terminal=host is not None,
            time_scale=scale or 1.0,
            manual=arguments.manual,
        )
        with clock(bench, scale) as runner:
            result = run_to_end(runner, drive(bench, script, path, options, arguments.json, host, arguments.bench))
    except (UsageError, EstimatorError) as error:
        return refuse(str(error), arguments.json)
    except DeviceError as error:
        return refuse(str(error), arguments.json, Outcome.FAULT)
    for note in result.notes:
        tell(f"note: {harmless(note)}", sys.stderr)
    if arguments.json:
        print(json.dumps(run_object(result)))
    else:
        if result.ended_early:
            print(f"ended early {result.ended_early}")
        found = result.verdict, result.calibration, result.recording
        print_result(*found, bench.units, details=arguments.details, sources=result.sources)
        if serial and host is None and result.calibration is not None:
            with suppress(*MISSHAPEN, KeyboardInterrupt):  # the run has ended, whatever becomes of this
                _print_moved(path)
    if bench.after_run:
        sys.stdout.flush()  # the result is told by then, however long the program takes
        facts = {"bench": bench.station, "script": script.name, "operator": operator, "serial_number": serial}
        _tell_after_run(bench.after_run, {**run_object(result), **facts}, path)
    return result.verdict.outcome.exit_code


def _tell_after_run(command: Sequence[str], result: Mapping[str, Any], recording: Path) -> None:
    """Give the result to the program that the bench names, and wait for it; its failure is only a note."""
    if sys.stderr.isatty():
        tell(f"after_run: {command[0]} receives the result", sys.stderr)
    problem = tell_program(command, result)
    if problem:
        tell(f"note: after_run: {problem}; the result is in {recording}", sys.stderr)


def _print_moved(recording: Path) -> None:
    """Print which states of the device moved since its last comparable run in the folder of a recording."""
    from station.screen.archive.archive import moved

    moves = asyncio.run(moved(recording))
    if moves:
        print_all(stdout(), [line(moved_since(moves))])


def _model_of(arguments: argparse.Namespace, bench: Bench) -> ErrorModel | None:
    """Return the error model of --model, checked against the bench before anything moves; None without it.

    ModelError if the bench's table or accelerometers cannot show an effect; UsageError with --end-early, or if a device
    has no temperature that an effect needs. Effects of accelerometers that the bench lacks are only a note.
    """
    if arguments.model is None:
        return None
    model = ErrorModel.read(Path(arguments.model))
    if arguments.end_early:
        raise UsageError(sentence("run.end_early_model"))
    model.made(bench.table.gimbals, frozenset({"gimbals", "specific force", "temperature"}))
    used = [imu for imu in bench.imus if imu.used]
    for imu in used:
        if model.needs_temperature and not imu.knows_temperature:
            raise UsageError(sentence("run.no_temperature", model=arguments.model, imu=imu.name))
        if imu.force_sheet is not None:
            laws_of_model(model.forces, {"temperature"} if imu.knows_temperature else ())
    if model.forces and all(imu.force_sheet is None for imu in used):
        tell(f"note: {sentence('run.no_accelerometers', model=arguments.model)}", sys.stderr)
    return model
