"""When a sample was taken: device counters, or regular sampling, aligned to the host's clock."""

from drivers.clocks.alignment import HostFit
from drivers.clocks.counter_clock import CounterClock
from drivers.clocks.regular_clock import RegularClock
from drivers.types import Alignment

__all__ = ["Alignment", "CounterClock", "HostFit", "RegularClock"]
