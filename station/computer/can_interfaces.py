"""SocketCAN interfaces: down, without a bit rate, switched off by errors."""

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from station.computer.finding import Finding

_COMMAND = ("ip", "-details", "-json", "link", "show")
_LIMIT_S = 5.0
_VIRTUAL = ("vcan", "vxcan")


def ask_kernel(interface: str) -> dict[str, Any] | None:
    """Return the description of a network interface by `ip`; {} if there is none of that name, or no JSON comes.

    None if `ip` is missing or takes more than 5 s.
    """
    try:
        done = subprocess.run([*_COMMAND, "dev", interface], capture_output=True, text=True, timeout=_LIMIT_S)
    except (OSError, subprocess.TimeoutExpired):
        return None
    with suppress(ValueError, IndexError, KeyError):
        return dict(json.loads(done.stdout)[0])
    return {}


def look_at_can_interface(
    interface: str, ask: Callable[[str], dict[str, Any] | None] = ask_kernel
) -> Iterator[Finding]:
    """Yield what prevents or disturbs the use of a SocketCAN interface, such as can0; nothing if it is fine.

    That is one finding, the first that applies: no name of an interface, `ip` missing or too slow, no such interface or
    not CAN, down, BUS-OFF, or errors on the bus. All but the second and the last are ``wrong``. ``ask`` returns its
    description as `ip` does, see ``ask_kernel``.
    """
    if not re.fullmatch(r"[\w.-]{1,15}", interface):
        yield Finding(interface, "is not the name of a network interface", "ip -brief link", wrong=True)
        return
    found = ask(interface)
    if found is None:
        yield Finding(interface, "cannot be checked: the program ip is missing", "sudo apt install iproute2")
        return
    if not found:
        text = "does not exist. Is the adapter plugged in and its driver loaded?"
        yield Finding(interface, text, "ip -brief link show type can", wrong=True)
        return
    details = found.get("linkinfo", {})
    kind = details.get("info_kind")
    if kind not in ("can", *_VIRTUAL):
        yield Finding(interface, "is not a CAN interface", "ip -brief link show type can", wrong=True)
        return
    settings = details.get("info_data", {})
    bit_rate = settings.get("bittiming", {}).get("bitrate")
    up = f"sudo ip link set {interface} up"
    if kind == "can":
        up += f" type can bitrate {bit_rate or 500000} restart-ms 100"
    if "UP" not in found.get("flags", []):
        rate = (
            ""
            if bit_rate or kind != "can"
            else " and has no bit rate (500000 is an example: use the bit rate of the bus)"
        )
        yield Finding(interface, f"is down{rate}", up, wrong=True)
    elif settings.get("state") == "BUS-OFF":
        text = "was switched off by bus errors (BUS-OFF). Check bit rate, cable and termination"
        yield Finding(interface, text, f"sudo ip link set {interface} down; {up}", wrong=True)
    elif settings.get("state") in ("ERROR-PASSIVE", "ERROR-WARNING"):
        text = f"sees errors on the bus ({settings['state']}): check bit rate, cable and termination"
        yield Finding(interface, text, f"ip -details -statistics link show {interface}")
