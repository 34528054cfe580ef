"""What `station ui` says where it cannot be shown, and what it takes over from its options."""

from __future__ import annotations

import argparse
import asyncio
import os
import pty
import re
import signal
import socket
import subprocess
import urllib.request
from pathlib import Path

import pytest
from support import command, station

from station.cli import main
from station.commands.ui import choices_of
from station.screen.choices import Choices
from station.screen.memory import Remembered, load_remembered, save_remembered
from station.screen.web import _guard


def in_terminal(arguments: list[str], **variables: str) -> tuple[int, str]:
    """Run a command that ends by itself in a pseudo-terminal; return its exit code and what it wrote."""
    master, slave = pty.openpty()
    with subprocess.Popen(
        arguments, stdin=slave, stdout=slave, stderr=slave, env={**os.environ, **variables}
    ) as process:
        os.close(slave)
        said = b""
        try:
            while data := os.read(master, 4096):
                said += data
        except OSError:  # the terminal's other end is closed
            pass
    os.close(master)
    return process.returncode, said.decode()


def test_without_a_terminal_it_says_so(place: Path) -> None:
    done = station("ui")
    assert done.returncode == 2
    assert "needs a terminal" in done.stderr
    assert "station run" in done.stderr


@pytest.mark.parametrize(
    ("variables", "says"),
    [
        ({"TERM": "dumb"}, "TERM is 'dumb'"),
        ({"TERM": ""}, "cannot show the screen"),
        ({"TERM": "xterm", "PYTHONIOENCODING": "latin-1"}, "LANG=C.UTF-8"),
    ],
)
def test_a_terminal_that_cannot_show_it_is_told_what_to_do(place: Path, variables: dict[str, str], says: str) -> None:
    code, said = in_terminal(command("ui"), **variables)
    assert code == 2
    assert says in " ".join(said.split())
    assert "Traceback" not in said


def test_a_port_that_is_taken_is_told(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["ui", "--web", str(taken.getsockname()[1])]) == 2
    assert "Choose another with --web" in capsys.readouterr().err


async def asked_of(port: int) -> dict[str, int]:
    """Return the statuses of requests to a page with the key "secret", by what is wrong with them."""
    from aiohttp import ClientSession, web

    app = web.Application(middlewares=[_guard("secret", port)])
    app.add_routes([web.get("/{key}/", hello)])
    runner = web.AppRunner(app)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", port).start()
    page, own = f"http://127.0.0.1:{port}", {"Origin": f"http://127.0.0.1:{port}"}
    asked: dict[str, tuple[str, dict[str, str]]] = {
        "nothing": ("/secret/", {}),
        "nothing, by a websocket": ("/secret/", own),
        "key": ("/other/", own),
        "no key": ("/", own),
        "name": ("/secret/", {"Host": f"evil.example:{port}"}),
        "origin": ("/secret/", {"Origin": "http://evil.example"}),
        "opaque origin": ("/secret/", {"Origin": "null"}),
        "other port": ("/secret/", {"Origin": "http://127.0.0.1:1"}),
    }
    try:
        async with ClientSession() as session:
            found = {}
            for wrong, (path, headers) in asked.items():
                async with session.get(page + path, headers=headers) as answer:
                    found[wrong] = answer.status
            return found
    finally:
        await runner.cleanup()


async def hello(_request: object) -> object:
    from aiohttp import web

    return web.Response(text="the screen")


def test_the_screen_in_a_browser_answers_to_its_key_name_and_origin_only() -> None:
    pytest.importorskip("aiohttp")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    found = asyncio.run(asked_of(port))
    assert found.pop("nothing") == found.pop("nothing, by a websocket") == 200
    assert set(found.values()) <= {403, 404}


def test_a_run_with_a_screen_keeps_the_options_of_the_run() -> None:
    given = {
        "bench": "b.toml",
        "device": ["array"],
        "link": ["table=twin:"],
        "scale": 3.0,
        "reset_fault": True,
        "seed": 4,
    }
    choices = choices_of(argparse.Namespace(ui=True, **given))
    assert choices == Choices(
        bench="b.toml",
        scale=3.0,
        link_options=("--link", "table=twin:"),
        device_options=("--device", "array"),
        run_options=("--reset-fault", "--seed", "4"),
    )
    run = choices.run_arguments(Path("r.h5"), choices.scale)
    assert run[:3] == ["run", "--host", "--json"]
    assert {"--reset-fault", "--device", "--link"} <= set(run)
    assert "--link" not in choices.plan_arguments()


def test_what_was_entered_is_remembered(place: Path) -> None:
    assert load_remembered() == Remembered()
    kept = Remembered("A. Operator", "/lab/bench.toml", "", 1_795_262_400.0)
    save_remembered(kept)
    assert load_remembered() == kept
    (place / "state/turntable-station/screen.json").write_text("[]")
    assert load_remembered() == Remembered()


def test_the_page_may_load_nothing_but_its_own(place: Path) -> None:
    pytest.importorskip("textual_serve")
    with subprocess.Popen(command("ui", "--web", "0"), stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            address = re.search(r"http://\S+", server.stdout.readline())
            assert address is not None
            with urllib.request.urlopen(address[0], timeout=10) as page:
                policy, text = page.headers["Content-Security-Policy"], page.read().decode()
        finally:
            server.send_signal(signal.SIGINT)
    allowed = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    nonce = re.search(r"'nonce-([\w-]{16,})'", allowed["script-src"])
    assert nonce is not None
    assert allowed["default-src"] == allowed["base-uri"] == "'none'"
    assert "unsafe" not in allowed["script-src"]
    assert all(f'nonce="{nonce[1]}"' in tag or 'src="/static/' in tag for tag in re.findall(r"<script[^>]*>", text))
