"""The screen in a browser of this machine: textual-serve on the loopback, for who has the address with its key."""

import asyncio
import logging
import secrets
import shlex
import socket
from collections.abc import Sequence
from pathlib import Path

from station.errors import UsageError
from station.screen.sessions.programs import command_line

_HOST = "127.0.0.1"
_END_S = 2.0


def serve(port: int, words: Sequence[str]) -> int:
    """Serve the screen until Ctrl-C; ``words`` are the options of `station ui`, port 0 is any free one.

    Every page is a process of its own, which ends with its page; sessions go on. UsageError if the port is taken.
    """
    try:
        from aiohttp import web
        from textual_serve.server import Server
    except ModuleNotFoundError:
        raise UsageError("--web needs textual-serve: pip install 'turntable-station[web]'") from None

    try:
        listening = socket.create_server((_HOST, port))
    except OSError as error:
        raise UsageError(f"port {port} cannot be had ({error.strerror}): give another to --web") from None
    port = listening.getsockname()[1]
    # Whoever can press keys here can turn the table: pages of other sites and other users do not know the path.
    path = f"/{secrets.token_urlsafe(16)}"
    html = Path(__file__).with_name("page").joinpath("index.html").read_text(encoding="utf-8")
    html = html.replace("ADDRESS", f"{_HOST}:{port}{path}")
    server = Server(shlex.join(command_line(["ui", *words])), host=_HOST, port=port)

    async def show(request: web.Request) -> web.Response:
        return web.Response(text=html, content_type="text/html", headers={"Referrer-Policy": "no-referrer"})

    async def announce(app: web.Application) -> None:
        print(f"the screen is at http://{_HOST}:{port}{path}/   (Ctrl-C ends it; a session goes on)", flush=True)

    open_pages: set[asyncio.Task[object]] = set()

    async def draw(request: web.Request) -> web.StreamResponse:
        page = asyncio.current_task()
        assert page is not None
        open_pages.add(page)
        try:
            return await server.handle_websocket(request)
        finally:
            open_pages.discard(page)

    async def end_pages(app: web.Application) -> None:
        for page in open_pages:
            page.cancel()  # each then ends the process behind it
        if open_pages:
            await asyncio.wait(open_pages, timeout=_END_S)

    app = web.Application()
    app.add_routes([web.get(f"{path}/", show), web.get(f"{path}/ws", draw), web.static("/static", server.statics_path)])
    app.on_startup.append(announce)
    app.on_shutdown.append(end_pages)
    logging.disable(logging.WARNING)
    web.run_app(app, sock=listening, print=None, shutdown_timeout=_END_S)
    return 0
