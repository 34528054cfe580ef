"""Servers of the twins end without a complaint, and end at all, whatever their clients are doing."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Coroutine
from typing import Any

import can
import pytest

from sims.wires.socketcand_server import SocketcandServer
from sims.wires.wires import Write, on_tcp

FRAME = can.Message(arbitration_id=0x123, data=bytes(8), is_extended_id=False)


class Talker:
    """A device that hears nothing."""

    def __init__(self, write: Write) -> None:
        self.write = write

    def received(self, data: bytes) -> None: ...


def client_of(bound: tuple[str, int], first: bytes = b"") -> socket.socket:
    """Connect to a server, with little room for what is not read."""
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    client.connect(bound)
    client.sendall(first)
    return client


async def turn(times: int) -> None:
    """Let the loop go round so often."""
    for _ in range(times):
        await asyncio.sleep(0)


async def device_on_tcp(turns: int) -> list[socket.socket]:
    async with on_tcp(Talker, "127.0.0.1") as bound:
        client = client_of(bound)
        await turn(turns)
    return [client]


async def bus_on_tcp(turns: int) -> list[socket.socket]:
    server = SocketcandServer("can0")
    client = client_of(await server.start("127.0.0.1"), b"< open can0 >< rawmode >")
    await turn(turns)
    await server.close()
    return [client]


async def device_with_a_deaf_client() -> list[socket.socket]:
    """A client that reads nothing of megabytes, whose place another one has taken."""
    talkers: list[Talker] = []

    def make(write: Write) -> Talker:
        talkers.append(Talker(write))
        return talkers[0]

    async with on_tcp(make, "127.0.0.1") as bound:
        deaf = client_of(bound)
        await turn(20)
        for _ in range(200):
            talkers[0].write(bytes(30_000))
            await turn(1)
        other = client_of(bound)
        await turn(20)
    return [deaf, other]


async def bus_with_a_deaf_client() -> list[socket.socket]:
    """A client that reads nothing of megabytes, and has been hung up on."""
    server = SocketcandServer("can0")
    deaf = client_of(await server.start("127.0.0.1"), b"< open can0 >< rawmode >")
    await turn(20)
    for _ in range(200):
        for _ in range(500):
            server.send(FRAME)
        await turn(1)
    server.hang_up()
    await turn(20)
    await server.close()
    return [deaf]


def complaints(main: Coroutine[Any, Any, list[socket.socket]]) -> list[str]:
    """Return what the loop complains of while this runs, and as it ends; TimeoutError if it does not end."""

    async def limited() -> list[socket.socket]:
        async with asyncio.timeout(5):
            clients = await main
        assert asyncio.all_tasks() == {asyncio.current_task()}  # nobody is served any more
        return clients

    said: list[str] = []
    with asyncio.Runner() as runner:
        runner.get_loop().set_exception_handler(lambda _, context: said.append(str(context)))
        for client in runner.run(limited()):
            client.close()
    return said


@pytest.mark.parametrize("turns", [0, 4, 20], ids=["has not come yet", "has just come", "is there"])
@pytest.mark.parametrize("server", [device_on_tcp, bus_on_tcp])
def test_a_server_ends_without_complaint_when_a_client(
    server: Callable[[int], Coroutine[Any, Any, list[socket.socket]]], turns: int
) -> None:
    assert complaints(server(turns)) == []


@pytest.mark.parametrize("server", [device_with_a_deaf_client, bus_with_a_deaf_client])
def test_a_server_ends_though_a_client_takes_nothing(
    server: Callable[[], Coroutine[Any, Any, list[socket.socket]]],
) -> None:
    assert complaints(server()) == []
