"""What comes in kinds, by name: built in, by the entry points of installed packages, or out of Python files."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property, partial
from hashlib import sha256
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

T = TypeVar("T")


class PluginError(Exception):
    """Something from outside cannot be used; one line with its name, the place and the reason."""


def load(group: str) -> dict[str, Callable[[], Any]]:
    """Return what installed packages announce in a group, by name; called, each imports it, or raises PluginError."""
    what = "entry point {0.name} of {0.group} ({0.value})"
    return {entry.name: partial(_guarded, what.format(entry), "", entry.load) for entry in entry_points(group=group)}


def load_file(path: Path) -> ModuleType:
    """Import a Python file, anew each time; PluginError if that fails."""
    name = f"station_plugin_{path.stem}_{sha256(str(path.absolute()).encode()).hexdigest()[:8]}"

    def run() -> ModuleType:
        spec = spec_from_file_location(name, path)
        if spec is None or spec.loader is None:
            raise ImportError("it is no Python file")
        module = sys.modules[name] = module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return _guarded(f"plug-in {path}", str(path), run)


def records_of(module: ModuleType, kind: type[T]) -> list[T]:
    """Return the records of a kind that stand in a module under names of their own."""
    return [value for value in vars(module).values() if isinstance(value, kind)]


class Registry(Mapping[str, T]):
    """Records of one kind by their ``name``. A module is imported when its record is asked for, not before."""

    def __init__(self, kind: type[T], group: str, modules: Mapping[str, str], beside: Iterable[T] = ()) -> None:
        """``modules`` hold the built-in ones, each as SPEC; ``group`` is that of entry points, ``beside`` are more."""
        self._kind, self._group, self._modules = kind, group, modules
        self._beside = {str(getattr(record, "name", "")): record for record in beside}

    def beside(self, modules: Iterable[ModuleType]) -> Registry[T]:
        """Return the registry with the records in these modules, too; PluginError for a name that is taken."""
        found = [record for module in modules for record in records_of(module, self._kind)]
        names = [*self._modules, *self._beside, *(str(getattr(record, "name", "")) for record in found)]
        if taken := {name for name in names if names.count(name) > 1}:
            raise PluginError(f"two devices are called {', '.join(sorted(taken))}: give yours a name of its own")
        return Registry(self._kind, self._group, self._modules, [*self._beside.values(), *found])

    def __getitem__(self, name: str) -> T:
        """Return a record; KeyError if there is none of this name, PluginError if it cannot be imported."""
        if name in self._modules:
            record = import_module(self._modules[name]).SPEC
        else:
            record = self._beside[name] if name in self._beside else self._installed[name]()
        if not isinstance(record, self._kind):
            raise PluginError(f"{name}: {type(record).__name__} is no {self._kind.__name__}")
        return record

    def __iter__(self) -> Iterator[str]:
        """Go over the names, the built-in ones first."""
        return iter(dict.fromkeys((*self._modules, *self._beside, *self._installed)))

    def __len__(self) -> int:
        """Return how many there are."""
        return len(list(iter(self)))

    @cached_property
    def _installed(self) -> dict[str, Callable[[], Any]]:
        return load(self._group)


def _guarded(what: str, file: str, run: Callable[[], T]) -> T:
    try:
        return run()
    except (Exception, SystemExit) as error:  # whatever stands in it
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        reason = (str(error).splitlines() or [""])[0]
        raise PluginError(f"{what}{f', line {line}' if line else ''}: {type(error).__name__}: {reason}") from None
