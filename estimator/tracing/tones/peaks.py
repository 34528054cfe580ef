"""Where a function of one number is largest."""

from collections.abc import Callable

_SHARE = 1e-4  # of the bracket: how closely the place is found


def highest(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function with one maximum between two numbers is largest (Brent's method, scipy)."""
    from scipy.optimize import minimize_scalar

    found = minimize_scalar(
        lambda value: -function(value), bounds=(low, high), method="bounded", options={"xatol": _SHARE * (high - low)}
    )
    return float(found.x)
