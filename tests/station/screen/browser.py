"""Headless Chromium over its remote debugging: a page, keys, what it asks the network for, a picture."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any

import aiohttp

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or ""
_SWITCHES = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-port=0",
)
_ESCAPES = re.compile(r"\x1b(\[[0-9;?<>=]*[a-zA-Z]|\][^\x07\x1b]*(\x07|\x1b\\)|[()][A-Z0-9])")
_BINARY = 2
_KEYS = {"F2": 113, "F3": 114, "F4": 115, "F7": 118, "F9": 120, "Enter": 13, "Tab": 9}


class Browser:
    """One page in a browser of its own, used as a context."""

    def __init__(self, size: tuple[int, int] = (1200, 800)) -> None:
        """``size`` of the window in pixels."""
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._size = size
        self._number = 0
        self._sent = b""
        self.asked: list[str] = []
        """Addresses that the page asked for."""

    async def __aenter__(self) -> Browser:
        width, height = self._size
        self._process = subprocess.Popen(
            [
                CHROMIUM,
                *_SWITCHES,
                f"--window-size={width},{height}",
                f"--user-data-dir={self._folder.name}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        told = Path(self._folder.name) / "DevToolsActivePort"
        async with asyncio.timeout(30):
            while not told.exists() or len(told.read_text().splitlines()) < 2:
                await asyncio.sleep(0.05)
        port = told.read_text().splitlines()[0]
        self._web = aiohttp.ClientSession()
        async with self._web.get(f"http://127.0.0.1:{port}/json/list") as answer:
            page = next(target for target in await answer.json() if target["type"] == "page")
        self._socket = await self._web.ws_connect(page["webSocketDebuggerUrl"], max_msg_size=0)
        await self.do("Network.enable")
        await self.do("Page.enable")
        await self.do("Emulation.setFocusEmulationEnabled", enabled=True)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._socket.close()
        await self._web.close()
        self._process.terminate()
        self._process.wait(10)
        self._folder.cleanup()

    async def do(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Have something done and return its result."""
        self._number += 1
        await self._socket.send_json({"id": self._number, "method": method, "params": parameters})
        async with asyncio.timeout(30):
            while True:
                said = json.loads((await self._socket.receive()).data)
                if said.get("method") == "Network.requestWillBeSent":
                    self.asked.append(said["params"]["request"]["url"])
                elif said.get("method") == "Network.webSocketFrameReceived":
                    frame = said["params"]["response"]
                    self._sent += base64.b64decode(frame["payloadData"]) if frame["opcode"] == _BINARY else b""
                if said.get("id") == self._number:
                    return dict(said.get("result", {}))

    async def see(self, *words: str, limit_s: float = 60.0) -> None:
        """Wait until all of the words have been sent to the page since the last wait, escape sequences left out.

        What was on the screen before is not sent again.
        """
        async with asyncio.timeout(limit_s):
            while not all(word in _ESCAPES.sub("", self._sent.decode(errors="replace")) for word in words):
                await self.evaluate("0")  # messages come with the answer
                await asyncio.sleep(0.05)
        self._sent = b""

    async def open(self, address: str) -> None:
        """Open a page."""
        await self.do("Page.navigate", url=address)

    async def evaluate(self, expression: str) -> Any:
        """Return the value of an expression of JavaScript."""
        found = await self.do("Runtime.evaluate", expression=expression, returnByValue=True)
        return found["result"].get("value")

    async def type(self, text: str) -> None:
        """Type a text, a key at a time."""
        for letter in text:
            await self.do("Input.dispatchKeyEvent", type="char", text=letter)

    async def press(self, key: str) -> None:
        """Press a key with a name."""
        code = {"key": key, "code": key, "windowsVirtualKeyCode": _KEYS[key]}
        text = {"text": "\r"} if key == "Enter" else {}
        await self.do("Input.dispatchKeyEvent", type="keyDown", **code, **text)
        await self.do("Input.dispatchKeyEvent", type="keyUp", **code)

    async def picture(self, path: Path) -> None:
        """Write a picture of the page (.png)."""
        found = await self.do("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(found["data"]))
