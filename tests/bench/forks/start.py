"""Starts ``python -m station.cli ...`` as a fork of a process that has imported the station (``server.py``).

python -I -S start.py SOCKET -m station.cli ...      as if ``python -m station.cli ...`` had been typed

To who started it, this process is the command: its output, its exit code, the signals that it takes, what it dies of.
SIGKILL kills the command as well; SIGSTOP does not stop it. Anything but the station, or the station in an environment
in which Python itself would behave otherwise, is started for real.

It imports modules in C alone: to import what wraps them in Python would take longer than the fork does.
"""

from __future__ import annotations

import _signal as signal
import _socket as socket
import array
import marshal
import os
import sys

STATION = ["-m", "station.cli"]
HOSTS_TOO = "STATION_TESTS_FORKS_HOSTS"
"""The variable that is set where nobody looks for a session by the number of the process that was started."""
PASSED_ON = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGUSR1, signal.SIGUSR2}


def main(address: str, words: list[str]) -> int:
    """Have the server run a command; return its exit code."""
    safe_path = words[:1] == ["-P"]
    typed = words[1:] if safe_path else words
    called_by_number = "--host" in typed and HOSTS_TOO not in os.environ  # a session, by that of its process
    if typed[:2] != STATION or called_by_number:
        start_for_real(words)
    signal.pthread_sigmask(signal.SIG_BLOCK, PASSED_ON)  # until there is a process to pass them on to
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    with open(server.fileno(), "rb", closefd=False) as answers:
        try:
            server.connect(address)
            send(server, {**surroundings(), "arguments": typed[2:], "safe_path": safe_path})
            begun = answers.readline().strip()
        except OSError:
            begun = b""
        if not begun:
            start_for_real(words)
        pass_signals_on(int(begun))
        ended = answers.readline()
    return as_exit_code(int(ended)) if ended else 1


def surroundings() -> dict[str, object]:
    """Return what a process inherits beside its open files."""
    return {
        "folder": os.getcwd(),
        "environment": dict(os.environ),
        "ignored_signals": [int(number) for number in PASSED_ON if signal.getsignal(number) == signal.SIG_IGN],
    }


def send(server: socket.socket, order: dict[str, object]) -> None:
    """Send an order, its length before it, with stdin, stdout and stderr."""
    packed = marshal.dumps(order)
    streams = array.array("i", [0, 1, 2])
    server.sendmsg([len(packed).to_bytes(4, "big")], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, streams)])
    server.sendall(packed)


def pass_signals_on(command: int) -> None:
    """Send the command from now on the signals that come here."""

    def pass_on(number: int, _frame: object) -> None:
        try:
            os.kill(command, number)
        except ProcessLookupError:  # it has just ended
            return

    for number in PASSED_ON:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, pass_on)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, PASSED_ON)


def as_exit_code(code: int) -> int:
    """Return an exit code; die of the signal that a negative one stands for."""
    if code >= 0:
        return code
    if -code != signal.SIGKILL:
        signal.signal(-code, signal.SIG_DFL)
    os.kill(os.getpid(), -code)
    return code


def start_for_real(words: list[str]) -> None:
    """Become the Python that this one is, with other arguments; do not return."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, PASSED_ON)
    os.execv(sys.executable, [sys.executable, *words])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
