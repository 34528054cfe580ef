"""How to make the driver of a table anew in another process."""

import pickle
import sys
from pathlib import Path
from typing import Any

from drivers.plugins import load_file
from drivers.protocols import Turntable
from drivers.specs import TableSetup, TableSpec
from drivers.tables.registry import TABLES


def packed_table(spec: TableSpec, setup: TableSetup, link: Any) -> bytes:
    """Return what makes a driver (``spec.make(setup, link)``) in another process of this program and user.

    ``link`` must not have been opened. An error of ``pickle`` if an option of a plug-in cannot be copied.
    """
    plugin = _plugin_of(spec)
    # Two layers: the values may be of classes that are known once the plug-in has been imported.
    return pickle.dumps((plugin, pickle.dumps((spec.name, setup, link))))


def unpacked_table(data: bytes) -> Turntable:
    """Return the driver, not open yet, with all that it needs imported; PluginError if its plug-in cannot be."""
    plugin, rest = pickle.loads(data)
    known = TABLES.beside([load_file(Path(plugin))]) if plugin else TABLES
    protocol, setup, link = pickle.loads(rest)
    spec: TableSpec = known[protocol]
    return spec.make(setup, link)


def _plugin_of(spec: TableSpec) -> str:
    """Return the Python file that brought a record to this process; empty if it is built in or installed."""
    for name, module in list(sys.modules.items()):
        if name.startswith("station_plugin_") and any(value is spec for value in vars(module).values()):
            return str(Path(str(module.__file__)).absolute())
    return ""
