"""When a sample was taken: device counters, or regular sampling, aligned to the host's clock."""

from drivers.clocks.alignment import HostFit as HostFit
from drivers.clocks.counter_clock import CounterClock as CounterClock
from drivers.clocks.regular_clock import RegularClock as RegularClock
from drivers.types import Alignment as Alignment
