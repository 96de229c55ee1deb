"""The live page beside a real run in a real browser: plots move, it sets, the stop button stops."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from hil.log.reader import open_log
from hil.runtime.setup import Overrides
from hil.signals import DriveState
from hil.sim.demo import emulator_process
from tests.browser.chromium import Browser
from tests.process.test_run import call, flags, hil, only_log, voltages_after_stop
from tests.process.test_watch import wait_for_run

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
SET = "document.querySelector('#w').value = {}, document.querySelector('#set').click()"
LAST = "Number(document.body.dataset.last)"


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@contextmanager
def server(*words: str) -> Iterator[str]:
    """`hil watch --web`; yields its address."""
    command = [sys.executable, "-m", "hil.cli", "watch", "--web", *words]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        found = re.search(r"http://127\.0\.0\.1:\d+/[\w-]{40,}/", line := process.stderr.readline())
        assert found, line
        yield found[0]
    finally:
        process.terminate()
        process.communicate(timeout=30)


def status(url: str, **headers: str) -> int:
    """The answer's status."""
    request = urllib.request.Request(url, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=30) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        error.close()
        return error.code


def port_of(url: str) -> str:
    """The port in an address."""
    return url.split(":")[2].partition("/")[0]


async def say(url: str, message: str, origin: str | None = None) -> str:
    """What the server notes to a message over a socket of its own."""
    async with connect(url.replace("http", "ws") + "live", origin=origin, proxy=None) as live:  # type: ignore[arg-type]
        await live.send(message)
        while True:
            answer = json.loads(await asyncio.wait_for(live.recv(), 30))
            if "note" in answer:
                return str(answer["note"])


def test_strangers_are_refused() -> None:
    with server("--port", "0") as url:
        root, token = url[:-44], url[-44:-1]
        assert status(url) == 200 and status(url + "uplot.js") == 200
        assert status(url + "../pyproject.toml") == status(url + "x") == 404
        wrong = token[:-1] + ("a" if token[-1] != "a" else "b")
        for way in (
            "",
            "live",
            "watch.js",
            wrong + "/",
            wrong + "/live",
            token[:-1] + "/",
            token + "x/",
            token,
        ):
            assert status(root + way) == 403, way
        assert status(f"{root}%C3%A9/") == 403
        assert status(url, Host="evil.example") == 403  # a name that was bound to this address
        assert status(url, Host=f"evil.example:{port_of(url)}") == 403
        for address, origin in ((url, "http://evil.example"), (url, "null"), (f"{root}{wrong}/", None)):
            with pytest.raises(InvalidStatus, match="403"):
                asyncio.run(say(address, "{}", origin=origin))
        for message in ('{"stop": "guess"}', '{"stop": null}', '{"stop": "é"}', '{"stop": "\\ud800"}'):
            assert asyncio.run(say(url, message)).startswith("refused")
        for message in ('{"set": {"w": 1}, "token": "guess"}', '{"set": {}, "token": null}'):
            assert asyncio.run(say(url, message)).startswith("refused")
        for message in (
            '{"set": {"w": 1}}',
            '{"set": 3, "token": ""}',
            '{"set": {"w": "fast"}, "token": ""}',
        ):
            assert asyncio.run(say(url, message)) == "not understood"
        assert (
            asyncio.run(say(url, json.dumps({"set": {"w": 1}, "token": token}))) == "there is no run to set"
        )
        for message in ("", "[]", "{", "3", '"stop"', "{}"):
            assert asyncio.run(say(url, message)) == "not understood"
        with urllib.request.urlopen(url, timeout=30) as page:
            assert "default-src 'none'" in page.headers["Content-Security-Policy"]
            assert page.headers["Referrer-Policy"] == "no-referrer" and token not in page.read().decode()
        assert asyncio.run(say(url, json.dumps({"stop": token}))) == "there is no run to stop"
        taken = call("watch", "--web", "--port", port_of(url))
        assert taken.returncode == 2 and "choose another: --port" in taken.stderr


def test_each_start_has_a_token_of_its_own_and_leaves_none(tmp_path: Path) -> None:
    with server("--port", "0") as first, server("--port", "0") as second:
        assert first[-44:] != second[-44:]
        assert status(f"http://127.0.0.1:{port_of(first)}/{second[-44:]}") == 403
    with server("--port", port_of(first)) as third:
        assert third[-44:] != first[-44:] and status(first) == 403
    assert not [path for path in tmp_path.rglob("*") if "token" in path.name]


@pytest.mark.parametrize(
    "twice", ["Host: 127.0.0.1:{port}", "Host: evil.example", "Origin: http://127.0.0.1:{port}"]
)
def test_headers_that_come_twice_are_refused(twice: str) -> None:
    with server("--port", "0") as url:
        port = port_of(url)
        live = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        head = f"GET {url[-45:]}live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{live}"
        head += f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nOrigin: http://127.0.0.1:{port}\r\n"
        with socket.create_connection(("127.0.0.1", int(port)), timeout=30) as stranger:
            stranger.sendall(f"{head}{twice.format(port=port)}\r\n\r\n".encode())
            assert stranger.recv(100).startswith(b"HTTP/1.1 403 ")


def test_plots_move_for_two_viewers_and_the_button_stops_the_run(
    browser: Browser, configs: Path, settings: Settings, tmp_path: Path, channel: str
) -> None:
    own, path = settings("loop.duration_s=90.0"), configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), server(channel, "--port", "0") as url:
        pages = (browser.page(), browser.page())
        for page in pages:
            page.open(url)
            page.wait_for("document.querySelector('#state').textContent === 'waiting for a run'")
        with hil("run", str(path), *flags(own)) as process:
            wait_for_run(process, channel)
            for page in pages:  # they found the new run by themselves
                seen = page.wait_for(LAST)
                page.wait_for(f"{LAST} > {seen}")
                assert page.evaluate("document.querySelectorAll('.plot canvas').length") == 5
                state = page.evaluate(
                    "[...['className', 'textContent']].map(k => document.querySelector('#state')[k])"
                )
                assert state == ["good", "operation enabled"]
            pages[1].evaluate(
                "document.querySelector('#w').value = 42, document.querySelector('#set').click()"
            )
            note = "document.querySelector('#note').textContent"
            pages[1].wait_for(f"{note} === 'set: w = 42 rad/s'")
            pages[1].evaluate(
                "document.querySelector('#w').value = 420, document.querySelector('#set').click()"
            )
            pages[1].wait_for(f"{note}.includes('out of range: -135 to 135')")
            pages[0].click("#stop")
            process.communicate(timeout=60)
            assert process.returncode == 0
        for page in pages:
            page.wait_for("document.querySelector('#state').textContent === 'ended: stop_requested'")
            assert page.evaluate("document.querySelector('#stop').disabled")
            assert page.problems == []
    log = open_log(only_log(tmp_path))
    assert (voltages_after_stop(log.path) == 0).all()
    assert log.ticks["state"][-1] == DriveState.SWITCH_ON_DISABLED
    asked = [event["text"] for event in log.events if event["kind"] == "stop-asked"]
    assert len(asked) == 1 and "stop button" in asked[0]
    taken = [event["text"] for event in log.events if event["kind"] == "set-point"]
    assert len(taken) == 1 and taken[0].startswith("w = 42 rad/s: taken, asked by hil watch --web")


def test_a_page_whose_server_has_gone_asks_nobody(browser: Browser) -> None:
    """Whoever takes the port next hears nothing of the page, so its token is in nobody's hands."""
    page, state = browser.page(), "document.querySelector('#state').textContent"
    with server("--port", "0") as url:
        page.open(url)
        page.wait_for(f"{state} === 'waiting for a run'")
    with socket.create_server(("127.0.0.1", int(port_of(url)))) as thief:
        page.wait_for(f"{state}.startsWith('the connection has ended')")
        thief.settimeout(2.5)  # the page used to ask twice a second
        with pytest.raises(TimeoutError):
            thief.accept()
