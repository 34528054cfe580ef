"""When a sample was taken: device counters, or regular sampling, aligned to the host's clock."""

from drivers.counter_clock import CounterClock
from drivers.host_fit import Alignment, HostFit
from drivers.regular_clock import RegularClock

__all__ = ["Alignment", "CounterClock", "HostFit", "RegularClock"]
