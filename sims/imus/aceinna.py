"""Twin of an Aceinna OpenIMU300RI or MTLT305D: its data messages on SAE J1939, and its answers to requests."""

import asyncio

import can
import numpy as np

from drivers.imus.aceinna import codec as aceinna
from drivers.imus.can.imu import load_dbc
from drivers.imus.signals import parameter_group
from drivers.types import Floats
from sims.physics.geometry import tilt_deg
from sims.wires.frames import FrameSink, ImuTwinSetup


class AceinnaDevice:
    """Sends SSI2, ACCS and ARI for each sample, every n-th 10 ms; answers set and get requests.

    Orientation and filter settings are stored, but have no effect on its outputs.
    """

    def __init__(
        self,
        setup: ImuTwinSetup,
        bus: FrameSink,
        *,
        axis_order: aceinna.AxisOrder | None = None,
        version: bytes = bytes([19, 1, 51, 2, 1]),
        name: aceinna.Name | None = None,
    ) -> None:
        """Start with the rate of the three gyros and all packets on.

        ``axis_order`` defaults to that of the option ``model``; ``version`` and ``name`` are its answers when asked for
        them.
        """
        model, address = setup.options["model"], setup.options["address"]
        self._setup, self._bus, self._address, self.faults = setup, bus, address, setup.faults
        self._columns = list(aceinna.COLUMNS[axis_order or aceinna.AXIS_ORDERS[model]])
        self._messages = {one.name.lower(): one for one in load_dbc("j1939 twin", aceinna.DBC).messages}
        self.saved = 0
        """How often it was told to save its configuration."""
        self._held = {
            aceinna.SOFTWARE_VERSION: version,
            aceinna.ADDRESS_CLAIM: (
                name or aceinna.Name(identity=305_001 + setup.number, manufacturer=823, function=131)
            ).encode(),
            aceinna.RATE_DIVIDER: bytes([address, round(aceinna.INTERNAL_RATE_HZ / setup.rate_hz)]),
            aceinna.PACKET_TYPES: bytes([address, sum(aceinna.PACKETS.values()), 0]),
            aceinna.FILTERS: bytes([address, 25, 5]),
            aceinna.ORIENTATION: bytes([address, 0, 0]),
        }

    def received(self, msg: can.Message) -> None:
        """Handle a frame from the bus: requests, save and reset commands, settings, and claims of its own address.

        All other frames are ignored, as are remote, error and 11-bit frames. Save and reset are acknowledged and change
        nothing; ``saved`` counts the former. A claim by a higher NAME is answered by its own; one by a lower NAME is
        not, but the address is kept.
        """
        if not msg.is_extended_id or msg.is_remote_frame or msg.is_error_frame:
            return
        group, data = parameter_group(msg.arbitration_id), bytes(msg.data)
        destination = msg.arbitration_id >> 8 & 0xFF
        if group == aceinna.REQUEST and destination in (self._address, aceinna.EVERYBODY) and len(data) == 3:
            self._answer(data, destination, msg.arbitration_id & 0xFF)
        elif group in (aceinna.RESET_ALGORITHM, aceinna.SAVE) and data[:2] == bytes([0, self._address]):
            self.saved += group == aceinna.SAVE
            self._send(group, bytes([1, self._address, 1]))
        elif group == aceinna.ADDRESS_CLAIM:
            # A higher NAME must leave the address (SAE J1939-81); to a lower one it is not left here either.
            if msg.arbitration_id & 0xFF == self._address and data[::-1] > self._held[group][::-1]:
                self._send(group, self._held[group])
        elif data[:1] == bytes([self._address]):
            self._set(group, data[1:])

    async def serve(self) -> None:
        """Send samples until cancelled, one every so many 10 ms as the rate divider says; nothing while that is 0.

        Faults leave samples out, send them twice, change rates or the clock.
        """
        loop = asyncio.get_running_loop()
        at = loop.time()
        while True:
            divider = self._held[aceinna.RATE_DIVIDER][1]
            at += (divider or 1) / (aceinna.INTERNAL_RATE_HZ * (1 + 1e-6 * self.faults.clock_ppm))
            await asyncio.sleep(max(at - loop.time(), 0.0))
            if not divider:
                continue  # switched off
            rates = self.faults.rates(self._setup.gyros.sample(np.array([at]))[0])
            force = self._setup.force_mps2(np.array([at]))[0]
            for _ in range(self.faults.times_to_send()):
                self._send_sample(np.degrees(rates), force)

    def _send_sample(self, rates_dps: Floats, force_mps2: Floats) -> None:
        """Send the packets that are switched on, clipped to their ranges, in the order of a real device's trace.

        ``rates_dps`` (3,) and ``force_mps2`` (3,) are about and along x, y, z of the device; the tilt follows from the
        latter.
        """
        roll, pitch, _ = tilt_deg(force_mps2[None] / max(float(np.linalg.norm(force_mps2)), 1e-9))[0]
        values = {"ssi2": np.array([pitch, roll]), "accs": force_mps2[self._columns], "ari": rates_dps[self._columns]}
        for name, fields in values.items():
            if self._held[aceinna.PACKET_TYPES][1] & aceinna.PACKETS[name]:
                message = self._messages[name]
                ranged = zip(message.signals, fields, strict=True)
                limited = {signal.name: np.clip(value, signal.minimum, signal.maximum) for signal, value in ranged}
                self._send(parameter_group(message.frame_id), message.encode(limited))

    def _answer(self, wanted: bytes, destination: int, host: int) -> None:
        """Answer a request, written by the standard (low byte first) or in Aceinna's way, or refuse it.

        ``wanted`` are its three bytes; ``host`` is the address of the sender. No answer if the twin is silent. A
        request to everybody is never refused (SAE J1939-21, 5.4.4), nor is one for the data messages, which are sent
        without a request.
        """
        groups = int.from_bytes(wanted, "little"), int.from_bytes(wanted)
        if self.faults.silent:
            return
        for group in groups:
            if group in self._held:
                self._send(group, self._held[group])
                return
        if destination == self._address and not set(groups) & {aceinna.SSI2, aceinna.ACCS, aceinna.ARI}:
            self._send(aceinna.ACKNOWLEDGEMENT, bytes([1, 0xFF, 0xFF, 0xFF, host]) + wanted)

    def _set(self, group: int, values: bytes) -> None:
        """Store ``values``, without the address before them, as the setting of a parameter group.

        A group that is no setting, and values that are not valid, are ignored.
        """
        if group == aceinna.RATE_DIVIDER:
            good = len(values) == 1 and values[0] in aceinna.DIVIDERS
        elif group == aceinna.PACKET_TYPES:
            good = len(values) == 2 and values[0] <= sum(aceinna.PACKETS.values())
        elif group == aceinna.FILTERS:
            good = len(values) == 2 and set(values) <= set(aceinna.FILTERS_HZ)
            values = values[::-1]  # on request, the accelerometer's comes first
        elif group == aceinna.ORIENTATION:
            good = len(values) == 2 and int.from_bytes(values, "little") in aceinna.ORIENTATIONS
        else:
            return
        if good:
            self._held[group] = bytes([self._address]) + values

    def _send(self, group: int, data: bytes) -> None:
        frame = aceinna.message(group, data, self._address)
        self._bus.send(can.Message(arbitration_id=frame.identifier, is_extended_id=True, data=data))
