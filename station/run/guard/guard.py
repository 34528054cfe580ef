"""The station's side of the guard: starts it, gives it the devices, checks that it lives, and dismisses it."""

import asyncio
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from station.opening import GuardedDevices
from station.run.guard.words import ARM, DISMISS, Order

_READY_LIMIT_S = 10.0
_EXIT_LIMIT_S = 0.5  # by the wall's clock
_MOST_STARTS = 5
_UNGUARDED = "if the station is killed now, only the watchdogs of the drives stop the table"


def guard_log_of(recording: Path) -> Path:
    """Return the path of the log that a guard writes after the death of a run."""
    return recording.with_name(f"{recording.name}.guard.log")


class Guard:
    """A process that makes devices safe if this one is killed; it is restarted if it is killed itself.

    A run continues without it; ``tell`` gets a message then.
    """

    def __init__(
        self, devices: GuardedDevices | None, recording: Path, time_scale: float, tell: Callable[[str], None]
    ) -> None:
        """Prepare without starting; ``devices`` is None if only twins in this process would have to be made safe.

        The log of the guard stands beside ``recording``; ``tell`` gets messages on failures.
        """
        self._devices, self._tell, self._time_scale = devices, tell, time_scale
        self._log = str(guard_log_of(recording).absolute())
        self._process: subprocess.Popen[bytes] | None = None
        self._heard = asyncio.Event()
        self._ready = self._armed = False
        self._starts = 0

    def start(self) -> None:
        """Start the process, which is ready a fraction of a second later; nothing without devices.

        An event loop must be running. A failure to start it is only reported; it counts as one of the five starts.
        """
        if self._devices is None:
            return
        self._starts += 1
        self._ready = False
        order = Order(
            devices=self._devices.packed,
            locks=self._devices.locks,
            pid=os.getpid(),
            who=f"the station (process {os.getpid()})",
            log=self._log,
            time_scale=self._time_scale,
        )
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "station.run.guard.process"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                pass_fds=self._devices.locks,
                start_new_session=True,
            )
        except OSError as error:
            self._tell(f"the guard process could not be started ({error})")
            self._heard.set()
            return
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        packed = pickle.dumps(order)
        self._send(len(packed).to_bytes(4, "big") + packed)
        asyncio.get_running_loop().add_reader(self._process.stdout.fileno(), self._read_output)

    async def arm(self) -> None:
        """Start guarding the devices; wait until a guard can act, or until it is known that none can."""
        self._armed = True
        await self._see_ready()

    async def watch(self) -> None:
        """See that the guard lives, as long as this is not cancelled; start another in the place of a dead one."""
        while True:
            await self._heard.wait()
            self._heard.clear()
            await self._see_ready()

    async def _see_ready(self) -> None:
        """Wait until a guard is ready, and arm it if that was asked for; does nothing without devices to guard.

        One that ends is restarted until it was started five times, and given up then. After 10 s without an answer it
        is armed nevertheless. Each failure is told; no error is raised.
        """
        limit_s = asyncio.get_running_loop().time() + _READY_LIMIT_S * max(self._time_scale, 1.0)
        while self._devices is not None and (self._process is None or not self._ready):
            if self._process is None:
                if self._starts == _MOST_STARTS:
                    self._devices = None
                    self._tell(f"the guard process ended again and is not restarted: {_UNGUARDED}")
                    return
                self._tell("the guard process has ended and is restarted")
                self.start()
            try:
                async with asyncio.timeout_at(limit_s):
                    await self._heard.wait()
                    self._heard.clear()
            except TimeoutError:
                self._tell(f"the guard is not ready after {_READY_LIMIT_S:g} s. Until it is ready: {_UNGUARDED}")
                break
        if self._armed:
            self._send(ARM)

    def dismiss(self) -> None:
        """Let the guard go: the devices are safe, or were never touched."""
        self._armed = False
        self._devices = None
        self._send(DISMISS)
        self._close()

    def _send(self, data: bytes) -> None:
        """Send a command to the guard; if it is gone, the end of its output tells so."""
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.write(data)

    def _read_output(self) -> None:
        """Handle output of the guard: anything says that it is ready; its end closes it."""
        assert self._process is not None
        assert self._process.stdout is not None
        self._heard.set()
        if self._process.stdout.read(64):
            self._ready = True
        else:
            self._close()

    def _close(self) -> None:
        """End the guard's process and close its pipes; does nothing if there is none.

        It is killed if it has not ended after half a second, and at once if it was not ready.
        """
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        assert process.stdout is not None
        asyncio.get_running_loop().remove_reader(process.stdout.fileno())
        if not self._ready:
            process.kill()  # it does not listen yet
        try:
            process.wait(_EXIT_LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdin.close()
        process.stdout.close()
