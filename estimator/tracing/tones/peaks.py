"""Where a function of one number is largest."""

from collections.abc import Callable

_SHARE = 1e-4  # of the bracket: how closely the place is found


def highest(function: Callable[[float], float], low: float, high: float, close: float = 0.0) -> float:
    """Return where a function with one maximum between two numbers is largest (Brent's method, scipy).

    It is found as closely as ``close``, or to a ten-thousandth of the bracket if that is more.
    """
    from scipy.optimize import minimize_scalar

    within = max(close, _SHARE * (high - low))
    found = minimize_scalar(
        lambda value: -function(value), bounds=(low, high), method="bounded", options={"xatol": within}
    )
    return float(found.x)
