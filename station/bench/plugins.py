"""Effects of one's own: made known to this process, those of installed packages and of files that were given."""

import os

from drivers.plugins import GIVEN, PluginError, Registry, load_files, origin_of, records_of
from estimator.effects import GROUP


def use_effects() -> list[str]:
    """Make effects known, those of files in the place of others; return a line for each of a package that is damaged.

    Raises PluginError or EffectError for a file that cannot be used: somebody has asked for it.
    """
    if not os.environ.get(GIVEN) and not Registry(object, GROUP, {}):
        return []
    from estimator.effects.catalogue import register  # only now, since it costs numpy
    from estimator.effects.effect import EffectError, Record

    problems, packages = [], Registry(Record, GROUP, {})
    for name in packages:
        try:
            register(packages[name], origin=packages.origin(name))
        except (PluginError, EffectError) as error:
            problems.append(str(error))
    for module in load_files():
        register(*records_of(module, Record), origin=origin_of(module))
    return problems
