"""Where a function of one number is largest."""

from collections.abc import Callable

_SHARE = 1e-4  # of the bracket: how closely the place is found


def highest(function: Callable[[float], float], low: float, high: float, close: float = 0.0) -> float:
    """Return where a function with one maximum between ``low`` and ``high`` is largest (Brent's method, scipy).

    The accuracy is the larger of ``close`` and a ten-thousandth of the bracket.
    """
    from scipy.optimize import minimize_scalar

    within = max(close, _SHARE * (high - low))
    found = minimize_scalar(
        lambda value: -function(value), bounds=(low, high), method="bounded", options={"xatol": within}
    )
    return float(found.x)
