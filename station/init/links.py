"""Where devices are: what this machine offers, and whether an answer is a link at all."""

from dataclasses import dataclass, field

from station.bench.imu import ON_CAN
from station.bench.table import TWIN
from station.init.dialogue import Dialogue
from station.init.hardware import SerialFound


@dataclass(slots=True)
class Links:
    """Links that this machine offers; a serial port that is taken is not proposed again."""

    serial: list[SerialFound] = field(default_factory=list)
    can: list[str] = field(default_factory=list)
    taken: set[str] = field(default_factory=set)

    def proposed(self, protocol: str) -> str:
        """Return the link to propose: something that was plugged in, else the twin."""
        if protocol in ON_CAN:
            return self.can[0] if self.can else TWIN
        free = [port.link for port in self.serial if port.plugged_in and port.link not in self.taken]
        return free[0] if free else TWIN

    def ask(self, dialogue: Dialogue, protocol: str, device: str, proposed: str = "") -> str:
        """Return the link of a device; where nobody is asked and none is proposed, the twin."""
        found = self.can if protocol in ON_CAN else [f"{p.link} {p.description}".rstrip() for p in self.serial]
        if found:
            dialogue.say("  found here: " + "; ".join(found))
        proposed = proposed or (self.proposed(protocol) if dialogue.asks else TWIN)
        link = dialogue.ask(
            f"link of it; {TWIN} for a simulated one", proposed, lambda text: check_link(protocol, text, device)
        )
        self.taken.add(link.partition("?")[0])
        return link


def check_link(protocol: str, link: str, device: str) -> None:
    """See that a text is a link that a protocol can use; BenchError if not."""
    from station.opening.devices import BAUD, TCP_PORT  # with pymodbus, half a second: when the first link is there
    from station.opening.links import byte_link, can_address, modbus_address

    if link == TWIN:
        return
    if protocol == "modbus":
        modbus_address(link, device)
    elif protocol in ON_CAN:
        can_address(link, device)
    else:
        byte_link(link, device, baud=BAUD[protocol], time_scale=1.0, port=TCP_PORT.get(protocol))
