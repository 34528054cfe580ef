"""Runs in the guest: commands that the host asks for over a serial line, each in a process of its own.

Lines from the host are ``start NAME`` and ``stop NAME``; NAME.json in the shared folder is a list: the words of a
command of ``station``, or one text for the shell. The answer is ``NAME CODE`` when it has ended. Processes for
``station`` are forked from this one, which has imported its modules: here that takes most of a minute.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import traceback
from pathlib import Path

SHARED = Path("/mnt")
LINE = "/dev/ttyS1"


def station(words: list[str]) -> int:
    """Run the command line of the station."""
    from station.cli import main

    try:
        return main(words)
    except SystemExit as ended:
        return int(ended.code or 0)


def begin(name: str) -> int:
    """Start a command; return its process."""
    words = json.loads((SHARED / f"{name}.json").read_text())
    if (process := os.fork()) != 0:
        return process
    code = 70
    try:
        out = os.open(SHARED / f"{name}.out", os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.dup2(out, 1)
        os.dup2(out, 2)
        os.setsid()
        if isinstance(words, str):
            os.execv("/bin/bash", ["bash", "-c", words])
        sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
        code = station(words)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def main() -> None:
    """Answer until the machine is switched off."""
    sys.modules["aiohttp"] = None  # type: ignore[assignment]  # pymodbus would import it for a web page; it takes 10 s
    line = os.open(LINE, os.O_RDWR | os.O_NOCTTY)
    running: dict[int, str] = {}
    rest = b""

    def say(text: str) -> None:
        os.write(line, f"{text}\n".encode())

    def stop(name: str) -> None:
        for process, other in running.items():
            if other == name:
                os.kill(process, signal.SIGINT)

    say("ready 0")
    while True:
        if select.select([line], [], [], 0.05)[0]:
            *requests, rest = (rest + os.read(line, 4096)).split(b"\n")
            for request in requests:
                verb, _, name = request.decode().strip().partition(" ")
                if verb == "start":
                    running[begin(name)] = name
                elif verb == "stop":
                    stop(name)
                elif verb == "import":
                    for module in json.loads((SHARED / f"{name}.json").read_text()):
                        __import__(module)
                    say(f"{name} 0")
        process = -1
        while running and process != 0:
            process, status = os.waitpid(-1, os.WNOHANG)
            if process in running:
                say(f"{running.pop(process)} {os.waitstatus_to_exitcode(status)}")


if __name__ == "__main__":
    main()
