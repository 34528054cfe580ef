"""What QCoDeS' driver of a DMC-4133 does with a controller at HOST:PORT; prints what it saw as JSON."""

from __future__ import annotations

import json
import sys
import time

from qcodes.instrument_drivers.Galil.dmc_41x3 import GalilDMC4133Controller

controller = GalilDMC4133Controller("dmc", sys.argv[1])
seen: dict[str, object] = {"idn": controller.get_idn()}
motor = controller.motor_a
seen["delivered"] = motor.on_off_status()
motor.servo_here()
seen["servo"] = motor.on_off_status()
wanted = {"speed": 20_000, "acceleration": 102_400, "deceleration": 204_800, "relative_position": 10_000}
wanted |= {"forward_sw_limit": 100_000, "reverse_sw_limit": -100_000}
for name, value in wanted.items():
    motor.parameters[name].set(value)
seen["kept"] = {name: motor.parameters[name].get() for name in wanted} == wanted
motor.off_when_error_occurs.set("enable for position, amp error or abort")
seen["off on error"] = motor.off_when_error_occurs.get()
controller.define_position_as_origin()
controller.position_format_decimals.set(0)
motor.begin()
seen["moves"] = motor.is_in_motion()
controller.wait_till_motion_complete()
seen["at"] = controller.ask("TP A")
seen["target"] = controller.absolute_position.get()
seen["deceleration"] = int(float(controller.ask("MG _DCA")))
try:
    controller.motor_b.begin()
except Exception:
    seen["refused"] = controller.tell_error()
motor.relative_position.set(-60_000)
motor.begin()
time.sleep(0.3)
controller.stop()
time.sleep(0.5)
seen["stopped"] = motor.is_in_motion()
motor.relative_position.set(60_000)
motor.begin()
time.sleep(0.3)
controller.abort()
seen["aborted"] = [motor.is_in_motion(), motor.on_off_status()]  # off: off-on-error is set
motor.servo_here()
controller.motors_off()
seen["off"] = motor.on_off_status()
controller.close()
print(json.dumps(seen))
