"""The screen in a browser of this machine: textual-serve on the loopback, for who has the address with its key."""

import asyncio
import logging
import secrets
import shlex
import socket
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from station.errors import UsageError
from station.screen.sessions.programs import command_line

if TYPE_CHECKING:
    pass

_HOST = "127.0.0.1"
_END_S = 2.0
_HEADERS = {
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
_POLICY = (
    "default-src 'none'; script-src 'self' 'nonce-{nonce}'; style-src 'self' 'unsafe-inline'; font-src 'self' data:; "
    "img-src 'self' data:; connect-src 'self' ws://{host}:{port}; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
"""What the page may load: its own files, and its one script by a number that is used once. xterm.js writes styles."""


def _guard(key: str, port: int) -> Any:
    """Return a middleware that refuses other hosts and origins (403), and addresses with another key (404).

    Static files need no key. Allowed are this computer's own names with ``port``, and no origin at all: pages of other
    sites reach the loopback by names of theirs, and can open websockets.
    """
    from aiohttp import web

    own = [f"{name}:{port}" for name in (_HOST, "localhost")]

    @web.middleware
    async def guard(request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]) -> Any:
        if request.host not in own or request.headers.get("Origin", f"http://{own[0]}")[7:] not in own:
            raise web.HTTPForbidden
        if not secrets.compare_digest(request.match_info.get("key", key).encode(), key.encode()):
            raise web.HTTPNotFound
        return await handler(request)

    return guard


def serve(port: int, words: Sequence[str]) -> int:
    """Serve the screen on the loopback until Ctrl-C, at an address with a secret key, which is printed; return 0.

    ``words`` are options of `station ui`; port 0 is any free one. Every page has its own process, which ends with the
    page; sessions continue. UsageError if the port is taken or a package is missing. Warnings are no longer logged.
    """
    try:
        from aiohttp import web
        from textual_serve.server import Server
    except ModuleNotFoundError:
        raise UsageError("--web needs textual-serve: pip install 'turntable-station[web]'") from None

    try:
        listening = socket.create_server((_HOST, port))
    except OSError as error:
        raise UsageError(f"port {port} is not available ({error.strerror}). Choose another with --web") from None
    port = listening.getsockname()[1]
    # Keys pressed here can turn the table: pages of other sites and other users do not know the key.
    # No cookie holds it: a browser shows cookies to the servers of all ports.
    key = secrets.token_urlsafe(16)
    path = f"/{key}"
    html = Path(__file__).with_name("page").joinpath("index.html").read_text(encoding="utf-8")
    html = html.replace("ADDRESS", f"{_HOST}:{port}{path}")
    server = Server(shlex.join(command_line(["ui", *words])), host=_HOST, port=port)

    async def show(request: web.Request) -> web.Response:
        nonce = secrets.token_urlsafe(16)
        policy = _POLICY.format(nonce=nonce, host=_HOST, port=port)
        headers = {**_HEADERS, "Content-Security-Policy": policy}
        return web.Response(text=html.replace("NONCE", nonce), content_type="text/html", headers=headers)

    async def announce(app: web.Application) -> None:
        print(f"the screen is at http://{_HOST}:{port}{path}/   (Ctrl-C closes it; a session continues)", flush=True)

    open_pages: set[asyncio.Task[object]] = set()

    async def draw(request: web.Request) -> web.StreamResponse:
        """Serve a page over its WebSocket, listed in ``open_pages`` as long as it is open."""
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

    app = web.Application(middlewares=[_guard(key, port)])
    app.add_routes([web.get("/{key}/", show), web.get("/{key}/ws", draw), web.static("/static", server.statics_path)])
    app.on_startup.append(announce)
    app.on_shutdown.append(end_pages)
    logging.disable(logging.WARNING)
    web.run_app(app, sock=listening, print=None, shutdown_timeout=_END_S)
    return 0
