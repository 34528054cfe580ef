"""Links of devices: what this machine offers, and whether an answer is a link at all."""

from dataclasses import dataclass, field

from drivers.specs import DeviceSpec
from station.bench.table import TWIN
from station.init.dialogue import Dialogue
from station.init.hardware import SerialFound


@dataclass(slots=True)
class Links:
    """The links that this machine offers; a serial port in use is not proposed again."""

    serial: list[SerialFound] = field(default_factory=list)
    can: list[str] = field(default_factory=list)
    taken: set[str] = field(default_factory=set)

    def proposed(self, spec: DeviceSpec) -> str:
        """Return the link to propose: something that was plugged in, else the twin."""
        if spec.on_can:
            return self.can[0] if self.can else TWIN
        free = [port.link for port in self.serial if port.plugged_in and port.link not in self.taken]
        return free[0] if free else TWIN

    def ask(self, dialogue: Dialogue, spec: DeviceSpec, device: str, proposed: str = "") -> str:
        """Return the link of a device of record ``spec``, after showing the links found; it is not proposed again.

        Proposed is ``proposed``, else a link that is found and free. If nobody is asked it is ``proposed``, else the
        twin. ``device`` is the name of the device, for messages. A link that the device cannot use is asked for again;
        UsageError if nobody is asked.
        """
        found = self.can if spec.on_can else [f"{p.link} {p.description}".rstrip() for p in self.serial]
        if found:
            dialogue.say("  found here: " + "; ".join(found))
        proposed = proposed or (self.proposed(spec) if dialogue.asks else TWIN)
        link = dialogue.ask(
            f"link; {TWIN} for a simulated device", proposed, lambda text: check_link(spec, text, device)
        )
        self.taken.add(link.partition("?")[0])
        return link


def check_link(spec: DeviceSpec, link: str, device: str) -> None:
    """See that a text is a link that a protocol can use; BenchError if not."""
    from station.opening.links import driver_link  # with pymodbus, half a second: when the first link is there

    if link != TWIN:
        driver_link(spec, link, device)
