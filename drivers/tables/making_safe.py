"""The way to rest: the end of every run, and the guard's action after a run that could not do it."""

import asyncio
from collections.abc import Callable

from drivers.kind import SafeState, tried
from drivers.protocols import Turntable

_STEP_LIMIT_S = 15.0


async def make_safe(
    table: Turntable, /, *, time_scale: float, unconfirmed: Callable[[str], None], untrue_readings: bool = False
) -> SafeState:
    """Stop a table, abort its motions if it is not seen to stop, and switch its power off; device errors are not
    raised, other exceptions are.

    ``unconfirmed(trouble)`` is called if the controlled stop was not confirmed, before the abort. With
    ``untrue_readings`` nothing that the table reports of the stop is believed: its power stays on for the longest
    braking time, and no abort is sent. Power is switched off in any case, even if the table may then coast; only that
    is limited in time, to 15 s times ``time_scale`` (how fast the loop's clock runs). The result has what went wrong,
    empty if nothing did; ``seen`` is whether the stop or the abort was confirmed by readings that are believed.
    """
    trouble = await tried(table.stop(), None)
    aborted = ""
    if untrue_readings:
        # Confirmations of the stop are worthless, and an axis whose power is cut in motion may coast.
        limits = table.limits.values()
        await asyncio.sleep(max(axis.rate_rps / axis.acceleration_rps2 for axis in limits))
        trouble = "the table was told to stop, but its readings cannot show that it is at rest: check it"
        unconfirmed(trouble)
    elif trouble:
        unconfirmed(trouble)
        aborted = await tried(table.abort(), None)  # as hard as the controller can
        trouble = f"it did not come to rest by a controlled stop ({trouble})"
        if aborted:
            trouble = f"the table was not seen to come to rest ({aborted}): use the emergency stop"
    # Also a table that heeds nothing else: it may then coast.
    powered = await tried(table.disable(), _STEP_LIMIT_S * time_scale)
    if powered:
        state = trouble or "the table is at rest"
        trouble = f"{state}; its power may be on ({powered})"
    return SafeState(trouble=trouble, seen=not aborted and not untrue_readings)
