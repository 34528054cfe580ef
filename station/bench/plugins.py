"""Effects of one's own: made known to this process, those of installed packages and of files that were given."""

import os
from collections.abc import Iterable
from pathlib import Path

from drivers.plugins import GIVEN, PluginError, Registry, load_files, origin_of, records_of

_GROUP = "turntable_station.effects"


def use_effects(files: Iterable[str] = ()) -> list[str]:
    """Register the effects of packages and plug-in files, replacing those of the same name; return warnings.

    ``files`` are added to the environment variable that this process and its children read plug-ins from. A package
    that fails gives a warning, a file that fails PluginError or EffectError, as somebody has asked for it. Without
    packages and files nothing is done, and numpy not imported.
    """
    given = [os.environ.get(GIVEN, ""), *(str(Path(name).absolute()) for name in files)]
    os.environ[GIVEN] = os.pathsep.join(filter(None, dict.fromkeys(given)))
    if not os.environ[GIVEN] and not Registry(object, _GROUP, {}):
        return []
    from estimator.effects.catalogue import register  # only now, since it costs numpy
    from estimator.effects.effect import EffectError, Record

    problems, packages = [], Registry(Record, _GROUP, {})
    for name in packages:
        try:
            register(packages[name], origin=packages.origin(name))
        except (PluginError, EffectError) as error:
            problems.append(str(error))
    for module in load_files():
        register(*records_of(module, Record), origin=origin_of(module))
    return problems
