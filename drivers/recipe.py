"""How to make the driver of a device anew in another process."""

import pickle
import sys
from pathlib import Path
from typing import Any

from drivers.kind import DeviceKind
from drivers.kinds import KINDS
from drivers.plugins import load_file
from drivers.specs import DeviceSpec


def packed_device(kind: DeviceKind, spec: DeviceSpec, setup: Any, link: Any) -> bytes:
    """Return a pickle from which ``unpacked_device`` rebuilds a driver in another process of this program and user.

    ``setup`` and ``link`` are the arguments of ``spec.make``; ``link`` must not have been opened. Plug-ins that define
    the kind or the record are named by path. An error of ``pickle`` if an option of a plug-in cannot be copied.
    """
    plugins = sorted({file for record in (kind, spec) if (file := _plugin_of(record))})
    # Two layers: the values may be of classes that are known once the plug-ins have been imported.
    return pickle.dumps((plugins, pickle.dumps((kind.name, spec.name, setup, link))))


def unpacked_device(data: bytes) -> tuple[DeviceKind, Any]:
    """Return the kind and the driver, not open yet, of a ``packed_device``, after importing its plug-ins.

    PluginError if a plug-in cannot be imported, KeyError if this process knows no such kind or protocol. ``data`` must
    come from this program: it is unpickled.
    """
    plugins, rest = pickle.loads(data)
    modules = [load_file(Path(file)) for file in plugins]
    kind_name, protocol, setup, link = pickle.loads(rest)
    kind = KINDS.beside(modules)[kind_name]
    spec = kind.protocols.beside(modules, kind.name)[protocol]
    return kind, spec.make(setup, link)


def _plugin_of(record: Any) -> str:
    """Return the Python file that defines a record in this process; empty if it is built in or installed."""
    for name, module in list(sys.modules.items()):
        if name.startswith("station_plugin_") and any(value is record for value in vars(module).values()):
            return str(Path(str(module.__file__)).absolute())
    return ""
