"""Writing files completely or not at all, and never over another file unless asked to."""

import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from station.errors import UsageError

_PICTURES = (".png", ".svg", ".pdf")


def check_new_file(path: Path, option: str) -> None:
    """See, before any long work, that a file can be created there; UsageError if not, or if it exists.

    ``option`` begins the message.
    """
    if path.exists():
        raise UsageError(f"{option} {path} exists already. Give another name")
    _check_folder(path, option)


def check_new_recording(path: Path) -> None:
    """Check, before any device is opened, that ``path`` is neither a file nor a folder; UsageError if it is.

    Its folder may be missing: it is created with the recording.
    """
    if path.is_dir():
        raise UsageError(f"--output {path} is a folder. Name a file in it, for instance {path / 'run.h5'}")
    if path.exists():
        raise UsageError(f"--output {path} exists already and is never overwritten. Give another name")


def check_picture(path: Path) -> None:
    """See, before any long work, that a picture can be saved there, by its suffix and folder; UsageError if not.

    An existing file is no error.
    """
    if path.suffix.lower() not in _PICTURES:
        raise UsageError(f"--plot {path}: the name must end in one of {', '.join(_PICTURES)}")
    _check_folder(path, "--plot")


def _check_folder(path: Path, option: str) -> None:
    """Check that the folder of ``path`` exists and takes new files, by a trial file that is removed at once.

    UsageError, which begins with ``option`` and ``path``, if not.
    """
    if not path.resolve().parent.is_dir():
        raise UsageError(f"{option} {path}: the folder {path.parent} does not exist")
    try:
        tempfile.TemporaryFile(dir=path.resolve().parent).close()
    except OSError as error:
        raise UsageError(f"{option} {path} cannot be written: {error.strerror or error}") from None


def free_path(path: Path, *, further_suffixes: Sequence[str] = ()) -> Path:
    """Return ``path`` if no such file exists, else "NAME-2", "NAME-3" and so on, with the lowest number that is free.

    The name must be free with each of ``further_suffixes`` (".pdf") in place of its suffix as well. Nothing is created.
    """
    number, found = 1, path
    while any(found.with_suffix(suffix).exists() for suffix in (path.suffix, *further_suffixes)):
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found


def new_recording(folder: Path) -> Path:
    """Return a free path for the recording of a run that begins now."""
    return free_path(folder / f"run-{datetime.now():%Y%m%d-%H%M%S}.h5")


def write_whole(
    path: Path, text: str | bytes, *, replace: bool = False, verify: Callable[[Path], object] | None = None
) -> None:
    """Write bytes, or a text as UTF-8, through a temporary file that gets its name only when complete.

    An existing file is overwritten only with ``replace``; a folder or a device never is. Missing folders are created.
    ``verify(part)`` may reject the temporary file with UsageError. UsageError, with the reason, if the file cannot be
    written. An earlier file is unchanged, and the temporary one removed, after any error.
    """
    if path.exists() and (not replace or not path.is_file()):
        reason = "exists already and is not overwritten" if path.is_file() else "is not a file"
        raise UsageError(f"{path} {reason}: give another name")
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with part.open("xb") as file:
            file.write(text.encode() if isinstance(text, str) else text)
            file.flush()
            os.fsync(file.fileno())
        if verify is not None:
            verify(part)
        part.replace(path)
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            part.unlink()
