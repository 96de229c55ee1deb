"""A page on 127.0.0.1 that shows a run live and can stop it. A process of its own beside the run.

Only this machine reaches it, and of its users only who knows the address: that begins with a random token,
a new one each start, so that an old page has nothing to give to whoever takes the port next. Requests
that name another host (DNS rebinding) and sockets that another page opened are refused. A viewer that reads
slowly misses messages: for each there is only the newest waiting, never a queue.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import os
import secrets
from collections.abc import Callable
from http import HTTPStatus
from importlib.resources import files
from typing import Any, Final

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from hil.runtime.registry import WatchError
from hil.watch.feed import Feed

PERIOD_S: Final = 0.1
TOKEN_BYTES: Final = 32
MAX_VIEWERS: Final = 50
MAX_MESSAGE: Final = 1024
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; connect-src 'self'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
ASSETS: Final = {
    "": ("hil.watch", "assets/watch.html", "text/html"),
    "watch.js": ("hil.watch", "assets/watch.js", "text/javascript"),
    "watch.css": ("hil.watch", "assets/watch.css", "text/css"),
    "uplot.js": ("hil.report", "assets/uPlot.iife.min.js", "text/javascript"),
    "uplot.css": ("hil.report", "assets/uPlot.min.css", "text/css"),
}
STRANGER: Final = b"open the whole address that hil watch --web has printed\n"


def asset(package: str, name: str) -> bytes:
    """A file of the package."""
    return files(package).joinpath(name).read_bytes()


class Web:
    """The server's state: the feed, the token, who looks."""

    def __init__(self, wanted: str | None, port: int, node: str = "") -> None:
        self._feed = Feed(wanted, node)
        self._token = secrets.token_urlsafe(TOKEN_BYTES)
        self.port = port
        self._viewers: dict[ServerConnection, Viewer] = {}

    def _hosts(self) -> tuple[str, ...]:
        return (f"127.0.0.1:{self.port}", f"localhost:{self.port}")

    @property
    def address(self) -> str:
        """Address of the page; who has it can stop the run."""
        return f"http://127.0.0.1:{self.port}/{self._token}/"

    def _is_token(self, text: str) -> bool:
        """Compare in a time that says nothing of where they differ."""
        return hmac.compare_digest(text.encode(errors="replace"), self._token.encode())

    def respond(self, _: ServerConnection, request: Request) -> Response | None:
        """Answer a request; None lets a WebSocket begin."""
        if _only(request, "Host") not in self._hosts():
            return _response(HTTPStatus.FORBIDDEN, b"another host name\n")
        token, slash, name = request.path.partition("?")[0].removeprefix("/").partition("/")
        if not self._is_token(token) or not slash:
            return _response(HTTPStatus.FORBIDDEN, STRANGER)
        if name == "live":
            return self._refusal(request)
        if name in ASSETS:
            package, file, kind = ASSETS[name]
            return _response(HTTPStatus.OK, asset(package, file), kind)
        return _response(HTTPStatus.NOT_FOUND, b"no such page\n")

    def _refusal(self, request: Request) -> Response | None:
        """Why a viewer may not come."""
        origin = _only(request, "Origin")
        if origin not in {None, *(f"http://{host}" for host in self._hosts())}:
            return _response(HTTPStatus.FORBIDDEN, b"another page\n")
        full = len(self._viewers) >= MAX_VIEWERS
        return _response(HTTPStatus.SERVICE_UNAVAILABLE, b"too many viewers\n") if full else None

    async def viewer(self, connection: ServerConnection) -> None:
        """One viewer from its coming to its going."""
        viewer = self._viewers[connection] = Viewer(self._feed.history())
        sender = asyncio.create_task(viewer.send_all(connection))
        try:
            async for message in connection:
                if answer := self._asked(message, connection):
                    await connection.send(json.dumps({"note": answer}))
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            del self._viewers[connection]

    def _asked(self, message: str | bytes, connection: ServerConnection) -> str:
        """Carry out what a viewer asked, ``{"stop": token}`` or ``{"set": {"w": 60}, "token": token}``."""
        try:
            asked = json.loads(message)
            token = str(asked["token"] if "set" in asked else asked["stop"])
            values = {str(name): float(value) for name, value in dict(asked.get("set", {})).items()}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
            return "not understood"
        if not self._is_token(token):
            return "refused: not the token of this page"
        look = self._feed.look
        if look is None:
            return "there is no run to set" if "set" in asked else "there is no run to stop"
        host, port = connection.remote_address[:2]
        who = f"hil watch --web, from {host} port {port}, user id {os.getuid()}"
        return look.set(values, who) if "set" in asked else look.stop(f"stop button of {who}")

    async def feed(self) -> None:
        """Hand new messages to every viewer, for ever."""
        while True:
            for message in self._feed.next():
                for viewer in self._viewers.values():
                    viewer.offer(message)
            await asyncio.sleep(PERIOD_S)


class Viewer:
    """What waits for one viewer: the opening, then only the newest message of each kind."""

    def __init__(self, opening: list[str]) -> None:
        self._waiting: dict[str, str] = {}
        self._opening = opening
        self._came = asyncio.Event()
        self._came.set()
        self.missed = 0

    def offer(self, message: str) -> None:
        """A new message; one of the same kind that still waits is lost."""
        kind = message[:8]
        self.missed += kind in self._waiting
        self._waiting[kind] = message
        self._came.set()

    async def send_all(self, connection: ServerConnection) -> None:
        """Send what waits, as fast as the viewer reads."""
        try:
            for message in self._opening:
                await connection.send(message)
            while True:
                await self._came.wait()
                self._came.clear()
                waiting, self._waiting = self._waiting, {}
                for message in waiting.values():
                    await connection.send(message)
        except ConnectionClosed:
            return


def _only(request: Request, name: str) -> str | None:
    """The value of a header, None where there is none; of several, which no browser sends, none alone."""
    values = request.headers.get_all(name)
    return ", ".join(values) if values else None


def _response(status: HTTPStatus, body: bytes, kind: str = "text/plain") -> Response:
    headers = Headers()
    headers["Content-Type"] = f"{kind}; charset=utf-8"
    headers["Content-Length"] = str(len(body))
    headers["Content-Security-Policy"] = POLICY
    headers["X-Content-Type-Options"] = "nosniff"
    headers["Referrer-Policy"] = "no-referrer"
    headers["Cache-Control"] = "no-store"
    headers["Connection"] = "close"
    return Response(status.value, status.phrase, headers, body)


async def start(web: Web) -> Server:
    """Listen on loopback; port 0 takes a free one. Raises WatchError when the port is taken."""
    options: dict[str, Any] = {"max_size": MAX_MESSAGE, "compression": None, "write_limit": 1 << 15}
    try:
        server = await serve(
            web.viewer, "127.0.0.1", web.port, process_request=web.respond, server_header=None, **options
        )
    except OSError as error:
        raise WatchError(
            f"port {web.port} can't be used ({error.strerror}); choose another: --port N"
        ) from error
    web.port = next(iter(server.sockets)).getsockname()[1]
    return server


async def _serve(wanted: str | None, port: int, say: Callable[[str], None], node: str) -> None:
    web = Web(wanted, port, node)
    async with await start(web):
        say(f"hil: {web.address} (who has it can stop the run; Ctrl-C ends the page, not the run)")
        await web.feed()


def run(wanted: str | None, port: int, say: Callable[[str], None], node: str = "") -> None:
    """Serve until interrupted; ``node``: as for :class:`hil.watch.look.Look`."""
    asyncio.run(_serve(wanted, port, say, node))
