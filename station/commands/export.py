"""station export: the calibration in a recording, in the form that something else needs."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from drivers.plugins import PluginError, load_files
from estimator.errors import EstimatorError
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Series
from estimator.strict_toml import not_one_of
from station.atomic_write import write_whole
from station.errors import EXIT_USAGE, UsageError, sentence
from station.exports.exported import Exported, exported_of
from station.exports.formats import FORMATS, Format
from station.exports.written import Written
from station.render import printing
from station.render.catalogues import FormatView, print_formats
from station.render.lines import tell
from station.run.outcome import Outcome, Verdict

_STDOUT = "-"


def command_export(arguments: argparse.Namespace) -> int:
    """Write a calibration in one format, to a file or stdout; return 0, or with --all its exit code.

    With other options print the list of formats, or write a series of recordings or all formats. What the format does
    not hold goes to stderr. UsageError if the recording cannot be read or the file not be written.
    """
    if arguments.list:
        _print_list(arguments.json)
        return Outcome.PASS.exit_code
    if arguments.series is not None:
        return _export_series(arguments)
    if arguments.all is not None:
        return _export_all(arguments, Path(arguments.all))
    try:
        exported, written = _written(arguments)
        if arguments.output != _STDOUT:
            write_whole(Path(arguments.output), written.text, replace=arguments.force)
    except OSError as error:
        raise UsageError(f"{arguments.recording} cannot be read: {error.strerror or error}") from None
    if arguments.json:
        result = {"file": arguments.output, "format": arguments.format, "not_held": list(written.not_held)}
        print(json.dumps({**result, "notes": exported.cautions}))
    elif arguments.output == _STDOUT:
        sys.stdout.flush()
        text = written.text
        sys.stdout.buffer.write(
            text.encode() if isinstance(text, str) else text
        )  # regardless of the locale: these files are UTF-8
        sys.stdout.buffer.flush()
    else:
        _print_result(exported, details=arguments.details)
        print(f"{arguments.format}: {arguments.output}")
    for line in written.not_held:
        tell(f"not in {arguments.format}: {line}", sys.stderr)
    _print_cautions(exported, details=arguments.details)
    return Outcome.PASS.exit_code


def _export_series(arguments: argparse.Namespace) -> int:
    """Write the series of a device as CSV to --output or stdout, times in s, units in the headings; return 0.

    UsageError if the recording has none of this name, the file cannot be written, or options do not go together.
    RecordingError if the recording cannot be read.
    """
    if arguments.recording is None or arguments.format is not None:
        raise UsageError("--series takes a recording and no --format: `station export RUN.h5 --series NAME`")
    if arguments.json and arguments.output == _STDOUT:
        raise UsageError("--json says what was written where: give a file with --output")
    found = read_recording(Path(arguments.recording)).series
    if arguments.series not in found:
        known = not_one_of(arguments.series, found) if found else "no device of this recording appended any"
        raise UsageError(f"--series {arguments.series}: {known}")
    text = csv_of(found[arguments.series])
    if arguments.output == _STDOUT:
        print(text, end="")
    else:
        write_whole(Path(arguments.output), text, replace=arguments.force)
        result = {"file": arguments.output, "series": arguments.series}
        print(json.dumps(result) if arguments.json else f"series {arguments.series}: {arguments.output}")
    return Outcome.PASS.exit_code


def csv_of(series: Series) -> str:
    """Return a series as CSV, numbers with all of their digits; headings are ``t_s``, then "COLUMN (UNIT)" of each."""
    heading = ["t_s", *(f"{column} ({unit})" for column, unit in series.units.items())]
    rows = zip(series.t_ns.tolist(), *(values.tolist() for values in series.columns.values()), strict=True)
    lines = [",".join([f"{t_ns * 1e-9:.9f}", *map(repr, values)]) for t_ns, *values in rows]
    return "\n".join([",".join(heading), *lines]) + "\n"


def _print_result(exported: Exported, *, details: bool) -> None:
    """Print the verdict of the exported run, if it has one, and the states."""
    ended = exported.verdict
    if ended is not None:
        printing.print_verdict(ended, details=details)
    shown = replace(exported.calibration, gyros=exported.gyros)
    printing.print_calibration(shown, ended or Verdict(Outcome.ESTIMATED, ""), exported.units, details=details)


def _print_cautions(exported: Exported, *, details: bool) -> None:
    """Print on stderr the reasons against using the calibration; without ``details`` only the number of its notes."""
    notes = len(exported.calibration.notes)
    for line in exported.cautions if details else exported.failure:
        tell(f"note: {line}", sys.stderr)
    if notes and not details:
        tell(f"{notes} note{'s' if notes > 1 else ''} of the calibration: --details", sys.stderr)


def refused(reason: str, arguments: argparse.Namespace) -> dict[str, str | None]:
    """Return the object for --json if nothing was written."""
    return {"file": None, "format": arguments.format, "reason": reason}


def _export_all(arguments: argparse.Namespace, folder: Path) -> int:
    """Write every format that can hold the calibration as FOLDER/RECORDING-FORMAT.SUFFIX, and say why others cannot.

    The name has no FORMAT where the suffix is the same. A file that exists is such a reason, unless --force is given.
    Return 0 if at least one was written, else 2. UsageError without a recording, or with --format or --output.
    """
    if arguments.recording is None:
        raise UsageError("give a recording: `station export RUN.h5 --all FOLDER`")
    if arguments.format is not None or arguments.output != _STDOUT:
        raise UsageError("--all chooses the file names: leave out --format and --output")
    files: dict[str, str] = {}
    refused: dict[str, str] = {}
    forms = FORMATS.beside(load_files())
    exported = _exported(arguments)
    for name, form in forms.items():
        form_label = "" if form.suffix == f".{name}" else f"-{name}"
        path = folder / f"{Path(arguments.recording).stem}{form_label}{form.suffix}"
        try:
            written = _write_form(name, form, exported, arguments)
            write_whole(path, written.text, replace=arguments.force)
        except (UsageError, EstimatorError) as error:
            refused[name] = str(error)
        else:
            files[name] = str(path)
    if arguments.json:
        print(json.dumps({"files": files, "refused": refused, "notes": exported.cautions}))
    else:
        _print_result(exported, details=arguments.details)
        for name, file in files.items():
            print(f"{name}: {file}")
    for name, reason in refused.items():
        tell(f"not written: {name}: {reason}", sys.stderr)
    _print_cautions(exported, details=arguments.details)
    return Outcome.PASS.exit_code if files else EXIT_USAGE


def _written(arguments: argparse.Namespace) -> tuple[Exported, Written]:
    """Return what is exported and the file in the chosen format.

    UsageError for missing or wrong options, an unknown format, or one that cannot hold the calibration.
    """
    if arguments.recording is None or arguments.format is None:
        raise UsageError(
            "give a recording and --format, or --all FOLDER; `station export --list` lists what each format holds"
        )
    if arguments.json and arguments.output == _STDOUT:
        raise UsageError("--json reports what was written, so give a file with --output")
    forms = FORMATS.beside(load_files())
    if arguments.format not in forms:
        raise UsageError(f"--format {not_one_of(arguments.format, forms)}")
    exported = _exported(arguments)
    return exported, _write_form(arguments.format, forms[arguments.format], exported, arguments)


def _exported(arguments: argparse.Namespace) -> Exported:
    """Return what is exported: the calibration in the recording, or that of all recordings with --join."""
    joined = [Path(name) for name in arguments.join]
    return exported_of(Path(arguments.recording), arguments.device, arguments.instance, joined)


def _write_form(name: str, form: Format, exported: Exported, arguments: argparse.Namespace) -> Written:
    """Return the calibration in the format ``form``, called ``name``.

    UsageError, with what to do, for several devices in a format of one, if the format cannot hold it, or a plug-in
    fails. What else a built-in format raises passes, such as CompensationError.
    """
    if form.of_one_device and len(exported.devices) > 1 and not arguments.device:
        raise UsageError(sentence("export.several", recording=arguments.recording, devices=", ".join(exported.devices)))
    try:
        written = form.write(exported)
        if not isinstance(written, Written):
            raise TypeError(f"it returned {type(written).__name__}, not Written")
        return written
    except UsageError:
        raise
    except Exception as error:
        if name in FORMATS and not FORMATS.origin(name):
            raise  # a defect of our own
        raise UsageError(f"the form {name} failed: {type(error).__name__}: {error}") from None


def _print_list(as_json: bool) -> None:
    tried = FORMATS.beside(load_files()).tried().items()
    listed = [_format_view(name, form) for name, form in tried]
    if as_json:
        print(json.dumps({form.name: {"holds": form.holds, "lacks": form.lacks} for form in listed}))
    else:
        print_formats(listed)


def _format_view(name: str, form: Format | PluginError) -> FormatView:
    """Return what a format holds; of one that could not be loaded, why."""
    if isinstance(form, PluginError):
        return FormatView(name=name, holds=f"not used: {form}", lacks="")
    return FormatView(name=name, holds=form.holds, lacks=form.lacks)
