"""`hil watch --web` with viewers that do not read: memory stays, others get the newest, not too many come."""

from __future__ import annotations

import asyncio
import json
import socket
from itertools import pairwise
from pathlib import Path

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from hil.watch import web
from hil.watch.web import MAX_VIEWERS, Web, start

pytestmark = pytest.mark.alone

SIZE, MESSAGES = 50_000, 2_000


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


class Flood:
    """A feed that has something new, and large, each time it is asked."""

    def __init__(self) -> None:
        self.count = 0
        self.look = None

    def next(self) -> list[str]:
        self.count += 1
        return [json.dumps({"now": self.count, "x": "x" * SIZE})] if self.count <= MESSAGES else []

    def history(self) -> list[str]:
        return []


def server(monkeypatch: pytest.MonkeyPatch) -> Web:
    """A page whose feed floods."""
    monkeypatch.setattr(web, "PERIOD_S", 0.0005)
    one = Web(None, 0)
    one._feed = Flood()  # type: ignore[assignment]
    return one


async def deaf(one: Web) -> socket.socket:
    """A viewer that opens the stream and never reads."""
    path = "/" + one.address.split("/", 3)[3]
    key = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="
    lines = ("Upgrade: websocket", "Connection: Upgrade", key, "Sec-WebSocket-Version: 13", "", "")
    head = (f"GET {path}live HTTP/1.1", f"Host: 127.0.0.1:{one.port}")
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.setblocking(False)
    loop = asyncio.get_running_loop()
    await loop.sock_connect(sock, ("127.0.0.1", one.port))
    await loop.sock_sendall(sock, "\r\n".join((*head, *lines)).encode())
    return sock


async def flooded(one: Web) -> tuple[list[int], int, list[int]]:
    """Numbers that a reading viewer got, bytes that wait in the server, messages that each one missed."""
    async with await start(one) as listening:
        socks = [await deaf(one) for _ in range(3)]
        async with connect(one.address.replace("http", "ws") + "live", proxy=None) as reader:
            while len(one._viewers) < 4:
                await asyncio.sleep(0.01)
            feeding = asyncio.create_task(one.feed())
            got = [0]
            while got[-1] < MESSAGES:
                got.append(json.loads(await asyncio.wait_for(reader.recv(), 60))["now"])
            feeding.cancel()
            waiting = sum(
                c.transport.get_write_buffer_size() + sum(map(len, v._waiting.values()))
                for c, v in one._viewers.items()
            )
            missed = sorted(v.missed for v in one._viewers.values())
        for sock in socks:
            sock.close()
        for connection in listening.connections:
            connection.transport.abort()
    return got, waiting, missed


@pytest.mark.long
def test_viewers_that_never_read_cost_a_message_each(monkeypatch: pytest.MonkeyPatch) -> None:
    got, waiting, missed = asyncio.run(flooded(server(monkeypatch)))
    assert got[-1] == MESSAGES and all(a < b for a, b in pairwise(got))
    assert waiting < 3 * 4 * SIZE  # of 100 MB for each
    assert all(count > MESSAGES // 2 for count in missed[1:])


def test_no_more_than_so_many_viewers(monkeypatch: pytest.MonkeyPatch) -> None:
    async def crowd() -> int:
        one = Web(None, 0)
        async with await start(one) as listening:
            url = one.address.replace("http", "ws") + "live"
            open_ones = [await connect(url, proxy=None) for _ in range(MAX_VIEWERS)]
            with pytest.raises(InvalidStatus, match="503"):
                await connect(url, proxy=None)
            await open_ones.pop().close()
            while len(one._viewers) == MAX_VIEWERS:
                await asyncio.sleep(0.01)
            open_ones.append(await connect(url, proxy=None))
            for each in open_ones:
                await each.close()
            listening.close()
            return len(open_ones)

    assert asyncio.run(crowd()) == MAX_VIEWERS
