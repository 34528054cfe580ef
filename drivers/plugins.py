"""Registries of records by name: built in, from entry points of installed packages, or from Python files."""

import os
import stat
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from hashlib import sha256
from importlib import import_module
from importlib.metadata import EntryPoints, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TypeVar

T = TypeVar("T")

GIVEN = "STATION_PLUGINS"
"""The environment variable that hands Python files to all processes of a command: whole paths, separated as in PATH."""

_SOURCE = "__station_source__"  # attribute of a module from a file: its bytes when it was imported
_MOST_STEPS = 1000  # of folders and links on the way to a file


class PluginError(ValueError):
    """A plug-in cannot be used; the message is one line with its name, the place and the reason."""


def load_files(paths: Iterable[Path] = ()) -> list[ModuleType]:
    """Import the files named in the environment variable ``GIVEN`` and in ``paths``, each once, and return the modules.

    Those of ``GIVEN`` come first: the operator named them, and they must be full paths. ``paths`` come from a bench
    file or stand beside it: unless ``GIVEN`` has them too, neither they nor any folder or link on the way may be
    writable by anybody but the operator and the administrator. PluginError if one of this does not hold, before any
    file is imported, or if an import fails.
    """
    given = [Path(file) for file in os.environ.get(GIVEN, "").split(os.pathsep) if file]
    if here := [str(path) for path in given if not path.is_absolute()]:  # the working folder decides nothing
        raise PluginError(f"{GIVEN} has {', '.join(here)}. Give the full path")
    named = dict.fromkeys(path.resolve() for path in given)
    beside = [path for path in paths if path.resolve() not in named]
    for path in beside:
        if reason := _changed_by_others(path):
            raise PluginError(
                f"plug-in {path} is not loaded: {reason}, and its code would run with your rights. Copy it to "
                "a folder that only you can write to; or, if you trust it and everyone who can change it, name it: "
                f"--plugin {path}"
            )
    return [load_file(path) for path in (*named, *dict.fromkeys(path.resolve() for path in beside))]


def load_file(path: Path) -> ModuleType:
    """Import a Python file; return the module loaded before if its text is unchanged, else execute it anew.

    A bench and its script may name the same file: both must get the same objects. PluginError if it is missing, not a
    regular file, not a Python file, or raises any exception.
    """
    text: bytes | None = None
    with suppress(OSError):  # missing and unreadable files are reported below
        if not stat.S_ISREG(path.stat().st_mode):
            raise PluginError(f"plug-in {path}: it is a pipe, a folder or a device, not a Python file")
        text = path.read_bytes()
    name = f"station_plugin_{path.stem}_{sha256(str(path.absolute()).encode()).hexdigest()[:8]}"

    known = sys.modules.get(name)
    if known is not None and text is not None and getattr(known, _SOURCE, None) == text:
        return known

    def run() -> ModuleType:
        """Execute the file as module ``name`` and return it, with its text noted, by which a change is seen later.

        The module is in ``sys.modules`` from before that, in place of an earlier one, and stays there without its text
        if it fails. ImportError if it is not a Python file.
        """
        spec = spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise ImportError("it is not a Python file")
        module = sys.modules[name] = module_from_spec(spec)
        spec.loader.exec_module(module)
        setattr(module, _SOURCE, text)
        return module

    return _guarded(f"plug-in {path}", str(path.absolute()), run)


def _changed_by_others(path: Path) -> str:
    """Return in words how a user other than this one and root could replace the file at ``path``; empty if none could.

    Checks every folder and link on the way, since whoever may write to a folder can rename its contents. Folders with
    the sticky bit, such as /tmp, are accepted if their owner is, and so is a group with no member but the user. Empty
    for a missing file and on systems other than POSIX.
    """
    if os.name != "posix":
        return ""
    try:
        seen = [(place, place.lstat()) for place in _on_the_way(path)]
    except OSError:
        return ""  # a missing file is reported when it is loaded
    for place, state in reversed(seen):
        place_text = "it" if place == path.absolute() else str(place)
        if state.st_uid not in (0, os.geteuid()):
            return f"{place_text} belongs to {_user(state.st_uid)}"
        if stat.S_ISLNK(state.st_mode) or (stat.S_ISDIR(state.st_mode) and state.st_mode & stat.S_ISVTX):
            continue
        if state.st_mode & stat.S_IWOTH:
            return f"every user of this computer may write to {place_text}"
        if state.st_mode & stat.S_IWGRP and not _private(state.st_gid, state.st_uid):
            return f"a group of users may write to {place_text}"
    return ""


def _on_the_way(path: Path) -> Iterator[Path]:
    """Yield every folder and symbolic link that leads to a file, from the root on, then the file.

    OSError if one is missing, or if links loop or are too many.
    """
    left = [*reversed(path.absolute().parts)]
    here = Path(left.pop())
    yield here
    for _ in range(_MOST_STEPS):
        if not left:
            return
        place = here / left.pop()
        if place.name == "..":
            here = here.parent
            continue
        yield place
        if not place.is_symlink():
            here = place
            continue
        target = place.readlink()
        left += reversed(target.parts)
        if target.is_absolute():
            here = Path(left.pop())
    raise OSError(f"{path} is a loop of symbolic links")


def _user(uid: int) -> str:
    import pwd

    try:
        return f"the user {pwd.getpwuid(uid).pw_name}"
    except KeyError:
        return f"the user with the number {uid}"


def _private(gid: int, uid: int) -> bool:
    """Return whether a group is a user's own: same name, primary group, no other member; False if either is unknown."""
    import grp
    import pwd

    try:
        user = pwd.getpwuid(uid)
        group = grp.getgrgid(gid)
    except KeyError:
        return False
    alone = user.pw_gid == gid and set(group.gr_mem) <= {user.pw_name}
    return alone and group.gr_name == user.pw_name


def origin_of(module: ModuleType) -> str:
    """Return the words by which recordings and models name a plug-in file: its name and hash."""
    path = Path(str(module.__file__))
    return f"the plug-in {path.name} (sha256 {sha256(path.read_bytes()).hexdigest()[:12]})"


def records_of(module: ModuleType, kind: type[T]) -> list[T]:
    """Return the records of a kind that stand in a module under names of their own."""
    return [value for value in vars(module).values() if isinstance(value, kind)]


class Registry(Mapping[str, T]):
    """Records of one type by their ``name``; the module of a record is imported when the record is first looked up."""

    def __init__(self, kind: type[T], group: str, built_in: Mapping[str, str | T]) -> None:
        """``built_in`` are records, or modules with them as SPEC; plug-ins have entry points in ``group``."""
        self._kind, self._group, self._own = kind, group, built_in

    def beside(self, modules: Iterable[ModuleType], kind: str = "") -> "Registry[T]":
        """Return this registry with the records defined in ``modules`` added; PluginError if one has the name of
        another.

        If ``kind`` is given, records with another ``kind`` are left out, those without any are not. This registry stays
        as it is. That an installed one has the name shows only when it is looked up.
        """
        own = dict(self._own)
        for record in (record for module in modules for record in records_of(module, self._kind)):
            if kind and getattr(record, "kind", kind) != kind:
                continue
            if own.setdefault(name := str(getattr(record, "name", "")), record) is not record:
                raise self._taken(name)
        return Registry(self._kind, self._group, own)

    def __getitem__(self, name: str) -> T:
        """Return the record ``name``, importing it; KeyError if there is none.

        PluginError if two have this name, or an installed one fails to load, is of the wrong type or has another name.
        An exception in importing a built-in one passes through.
        """
        entries = list(self._installed.select(name=name))
        if len(entries) + (name in self._own) > 1:
            raise self._taken(name)
        if not entries:
            own = self._own[name]
            return import_module(own).SPEC if isinstance(own, str) else own
        origin = f"entry point {name} of {self._group} ({entries[0].value})"
        record = _guarded(origin, "", entries[0].load)
        if not isinstance(record, self._kind):
            raise PluginError(f"{origin}: {type(record).__name__} is no {self._kind.__name__}")
        if (called := getattr(record, "name", "")) != name:
            raise PluginError(f"{origin}: it is called {called}. Register it by that name")
        return record

    def tried(self) -> dict[str, T | PluginError]:
        """Return each record by name, or the PluginError of one that cannot be used.

        An exception in importing a built-in one passes through.
        """
        found: dict[str, T | PluginError] = {}
        for name in self:
            try:
                found[name] = self[name]
            except PluginError as error:
                found[name] = error
        return found

    def origin(self, name: str) -> str:
        """Return the package that brings a record, "" if none does."""
        packages = (entry.dist for entry in self._installed.select(name=name) if entry.dist)
        return next((f"the package {package.name} {package.version}" for package in packages), "")

    def __iter__(self) -> Iterator[str]:
        """Go over the names, the built-in ones first."""
        return iter(dict.fromkeys((*self._own, *(entry.name for entry in self._installed))))

    def __len__(self) -> int:
        """Return the number of records."""
        return len(list(iter(self)))

    @property
    def _installed(self) -> EntryPoints:
        return _announced(self._group, tuple(sys.path))

    def _taken(self, name: str) -> PluginError:
        return PluginError(f"two {self._group.rpartition('.')[2]} are called {name}: choose another name for yours")


@lru_cache(16)  # it opens a file of every package that is installed
def _announced(group: str, _path: tuple[str, ...]) -> EntryPoints:
    return entry_points(group=group)


def _guarded(plugin: str, file: str, run: Callable[[], T]) -> T:
    """Return ``run()``; any exception of it, SystemExit too, becomes a PluginError.

    Its message has ``plugin`` (the plug-in in words), the last line of ``file`` that is in the traceback, the type of
    the exception and the first line of its message.
    """
    try:
        return run()
    except (Exception, SystemExit) as error:  # anything may be in the file
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        reason = (str(error).splitlines() or [""])[0]
        raise PluginError(f"{plugin}{f', line {line}' if line else ''}: {type(error).__name__}: {reason}") from None
