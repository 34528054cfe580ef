"""Effects of one's own: made known to this process, out of files that were given and of installed packages."""

from collections.abc import Sequence

from drivers.plugins import PluginError, installed, load, load_files, origin_of, records_of, told
from estimator.effects import GROUP
from estimator.effects.catalogue import record_of, register
from estimator.effects.effect import EffectError, Record


def use_effects() -> list[str]:
    """Make effects known; return a line for each package whose effects cannot be used.

    Raises PluginError or EffectError for a file that cannot be used: somebody has asked for it.
    """
    for module in load_files(()):
        register(*records_of(module, Record), origin=origin_of(module))
    problems = []
    for entry in (entry for entries in installed(GROUP).values() for entry in entries):
        try:
            loaded, origin = load(entry), origin_of(entry)
            for record in loaded if isinstance(loaded, Sequence) else [loaded]:
                known = record_of(getattr(record, "name", ""))
                if known is not None and known.origin not in ("", origin):
                    raise EffectError(f"there is an effect {known.name} of {known.origin} already")
                register(record, origin=origin)
        except PluginError as error:
            problems.append(str(error))
        except EffectError as error:
            problems.append(f"{told(entry)}: {error}")
    return problems
