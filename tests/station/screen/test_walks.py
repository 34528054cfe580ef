"""A person's way from the first screen to the certificate: in a terminal (tmux), and in a browser (Chromium)."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from streams import TINY, bench_text
from support import command, ctrl_c_of_children

OPTIONS = ("--bench", "bench.toml", "--script", "tiny.toml", "--scale", "5")


@pytest.fixture
def bench(place: Path) -> Path:
    """A working folder with a bench without limits: here the way is looked at, not how well a busy host keeps time."""
    before, limits, after = re.split(r"(?<=\[limits\])(.*?)(?=\n\n)", bench_text(), maxsplit=1, flags=re.DOTALL)
    assert "nis_low" in limits
    (place / "bench.toml").write_text(before + after)
    (place / "tiny.toml").write_text(TINY)
    return place


def accepted(folder: Path) -> bool:
    """Return whether one recording of a folder is accepted, with its certificate beside it."""
    (recording,) = (folder / "recordings").glob("run-*.h5")
    with h5py.File(recording) as file:
        assert file.attrs["outcome"] == "ESTIMATED"  # the bench states no limits
        assert file.attrs["device_serial"] == "SN-0042"
        by = file.attrs["accepted_by"]
    certificate = recording.with_suffix(".html").read_text()
    return by == "A. Operator" and "SN-0042" in certificate


class Tmux:
    """A terminal of 100 x 32 in a tmux server of its own."""

    def __init__(self, folder: Path, words: list[str]) -> None:
        """Start a command in it; its exit code is shown at the end."""
        self._tmux = ["tmux", "-S", str(folder / "t"), "-f", "/dev/null"]
        line = f"{' '.join(words)}; echo left with $?; cat"
        subprocess.run([*self._tmux, "new-session", "-d", "-x", "100", "-y", "32", line], check=True)

    def press(self, *names: str) -> None:
        """Press keys by tmux's names; a text is typed."""
        subprocess.run([*self._tmux, "send-keys", *names], check=True)

    def shown(self) -> str:
        """Return what is on the screen."""
        done = subprocess.run([*self._tmux, "capture-pane", "-p"], check=True, capture_output=True, text=True)
        return done.stdout

    def wait(self, *words: str) -> None:
        """Wait until all of the words are on the screen."""
        until(lambda: all(word in self.shown() for word in words), lambda: f"{words} not on\n{self.shown()}")

    def close(self) -> None:
        """End the server."""
        subprocess.run([*self._tmux, "kill-server"], check=False)


def until(holds: Callable[[], object], say: Callable[[], str], limit_s: float = 60.0) -> None:
    """Wait for another process, which says nothing when it is ready."""
    deadline = time.monotonic() + limit_s
    while not holds():
        assert time.monotonic() < deadline, say()
        time.sleep(0.1)


@pytest.mark.skipif(shutil.which("tmux") is None, reason="tmux is not there")
def test_from_prepare_to_certificate_in_a_terminal(bench: Path) -> None:
    terminal = Tmux(Path(os.environ["XDG_RUNTIME_DIR"]), command("ui", *OPTIONS))
    try:
        terminal.wait("Before START", "operator: enter it")
        terminal.press("A. Operator", "Enter")
        terminal.wait("A. Operator")
        terminal.press("Tab") if "A. OperatorSN" in terminal.shown() else None
        terminal.press("SN-0042")
        terminal.wait("READY  the table will move")
        terminal.press("F7")
        terminal.wait("STOP  F9", "turning")
        terminal.wait("ESTIMATED", "States and their sigmas", "Consistency (NIS)")
        terminal.press("a")
        terminal.wait("Accept the calibration of SN-0042 as A. Operator?")
        terminal.press("Tab")
        terminal.press("Enter")
        terminal.wait("accepted by A. Operator", "certificate:")
        assert accepted(bench)
        terminal.press("C-q")
        terminal.wait("left with 0")
    finally:
        terminal.close()


def processes_of(word: str) -> list[int]:
    """Return the processes that have a word on their command line."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if word.encode() in path.read_bytes():
                found.append(int(path.parent.name))
        except OSError:
            continue
    return found


@pytest.mark.full
@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="processes are found in /proc")
@pytest.mark.skipif(not (shutil.which("chromium") or shutil.which("chromium-browser")), reason="Chromium is not there")
def test_from_prepare_to_certificate_in_a_browser(bench: Path) -> None:
    pytest.importorskip("textual_serve")
    folder = str(bench / "recordings")
    with ctrl_c_of_children():
        server = subprocess.Popen(
            command("ui", "--web", "0", "--folder", folder, *OPTIONS), stdout=subprocess.PIPE, text=True
        )
    with server:
        try:
            assert server.stdout is not None
            address = re.search(r"http://\S+", server.stdout.readline())
            assert address is not None
            asyncio.run(walk(address[0]))
            assert accepted(bench)
            others = lambda: [pid for pid in processes_of(folder) if pid != server.pid]  # noqa: E731
            until(lambda: not others(), lambda: f"left behind: {others()}", 20)
        finally:
            server.send_signal(signal.SIGINT)
    assert server.returncode == 0


async def walk(address: str) -> None:
    """Walk from the first screen to the certificate in a browser."""
    from browser import Browser

    async with Browser((900, 600)) as page:
        await page.open(address)
        await page.see("operator: enter it")
        await page.type("A. Operator")
        await page.press("Enter")
        await page.type("SN-0042")
        await page.see("READY", "the table will move")
        await page.press("F7")
        await page.see("STOP", "turning")
        await page.see("PASS", "none in this folder")
        await page.type("a")
        await page.see("Accept the calibration of SN-0042")
        await page.press("Tab")
        await page.press("Enter")
        await page.see("certificate:")
        assert all(asked.startswith(("http://127.0.0.1:", "data:")) for asked in page.asked), page.asked


@pytest.mark.full
@pytest.mark.skipif(not (shutil.which("chromium") or shutil.which("chromium-browser")), reason="Chromium is not there")
@pytest.mark.parametrize("size", [(390, 844), (844, 390)])
def test_a_telephone_shows_step_time_left_stop_and_the_verdict(bench: Path, size: tuple[int, int]) -> None:
    pytest.importorskip("textual_serve")
    words = command(
        "run", "--host", "--operator", "A. Operator", "--serial-number", "SN-0042", *OPTIONS, "--scale", "1"
    )
    with ctrl_c_of_children():
        run = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        server = subprocess.Popen(command("ui", "--web", "0"), stdout=subprocess.PIPE, text=True)
    with run, server:
        try:
            assert server.stdout is not None
            address = re.search(r"http://\S+", server.stdout.readline())
            assert address is not None
            asyncio.run(glance(address[0], size))
        finally:
            server.send_signal(signal.SIGINT)
            run.wait(60)


async def glance(address: str, size: tuple[int, int]) -> None:
    """Look at a run from a telephone until it has ended; nothing is pressed."""
    from browser import Browser

    async with Browser(size) as page:
        width, height = size
        await page.do(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=True
        )
        await page.open(address)
        await page.see("STOP", " left", "done")
        await page.see("ESTIMATED")  # the bench states no limits


SIZES = ((1280, 800), (1920, 1080), (1000, 700), (2560, 1440), (1280, 720), (1366, 768), (1024, 768), (3840, 2160))


@pytest.mark.full
@pytest.mark.skipif(not (shutil.which("chromium") or shutil.which("chromium-browser")), reason="Chromium is not there")
def test_stop_is_whole_in_view_in_a_browser_of_any_size(bench: Path) -> None:
    pytest.importorskip("textual_serve")
    words = command("ui", "--web", "0", "--folder", str(bench / "recordings"), *OPTIONS)
    with ctrl_c_of_children():
        server = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    with server:
        try:
            assert server.stdout is not None
            address = re.search(r"http://\S+", server.stdout.readline())
            assert address is not None
            asyncio.run(resize(address[0]))
        finally:
            server.send_signal(signal.SIGINT)


async def resize(address: str) -> None:
    """Change the size of the window, at first right after loading; the rows must fill it and not leave it."""
    from browser import Browser

    edges = "(b => `${Math.round(b.right)} ${Math.round(b.bottom)}`)"
    async with Browser((1280, 800)) as page:
        await page.open(address)
        await page.see("operator: enter it")
        for width, height in (*SIZES, *SIZES[:2]):
            await page.do(
                "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
            )
            async with asyncio.timeout(10):
                while True:
                    found = await page.evaluate(
                        edges + "(document.querySelector('.xterm-screen').getBoundingClientRect())"
                    )
                    right, bottom = map(int, found.split())
                    if width - 32 < right <= width and height - 32 < bottom <= height:
                        break
                    await asyncio.sleep(0.05)


@pytest.mark.skipif(sys.platform != "linux", reason="processes are found in /proc")
def test_a_screen_whose_server_was_killed_ends_by_itself(place: Path) -> None:
    folder = str(place / "recordings")
    driver = {"TEXTUAL_DRIVER": "textual.drivers.web_driver:WebDriver"}
    process = subprocess.Popen(
        command("ui", "--folder", folder),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, **driver},
    )
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    with process.stdin, process.stdout, process.stderr:
        process.stdout.read(2000)
        process.stdin.close()
        process.stdout.close()
        assert process.wait(20) == 0
