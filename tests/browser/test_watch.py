"""The live page beside a real run in a real browser: plots move, the stop button stops, it comes back."""

from __future__ import annotations

import asyncio
import json
import re
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

from hil.app import Overrides
from hil.demo import emulator_process
from hil.log.reader import open_log
from hil.signals import DriveState
from tests.browser.chromium import Browser
from tests.process.test_run import call, flags, hil, only_log, voltages_after_stop
from tests.process.test_watch import wait_for_run

pytestmark = pytest.mark.process
Settings = Callable[..., tuple[str, ...]]
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
        found = re.search(r"http://127\.0\.0\.1:\d+/", line := process.stderr.readline())
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


async def say(url: str, message: str, origin: str | None = None) -> str:
    """What the server notes to a message over a socket of its own."""
    async with connect(url.replace("http", "ws") + "live", origin=origin, proxy=None) as socket:  # type: ignore[arg-type]
        await socket.send(message)
        while True:
            answer = json.loads(await asyncio.wait_for(socket.recv(), 30))
            if "note" in answer:
                return str(answer["note"])


def test_strangers_are_refused() -> None:
    with server("--port", "0") as url:
        assert status(url) == 200 and status(url + "uplot.js") == 200
        assert status(url + "../pyproject.toml") == 404
        assert status(url, Host="evil.example") == 403  # a name that was bound to this address
        assert status(url, Host=f"evil.example:{url.rsplit(':')[-1].strip('/')}") == 403
        with pytest.raises(InvalidStatus, match="403"):
            asyncio.run(say(url, "{}", origin="http://evil.example"))
        for message in ('{"stop": "guess"}', '{"stop": null}', '{"stop": "é"}'):
            assert asyncio.run(say(url, message)).startswith("refused")
        for message in ("", "[]", "{", "3", '"stop"', "{}"):
            assert asyncio.run(say(url, message)) == "not understood"
        with urllib.request.urlopen(url, timeout=30) as page:
            assert "default-src 'none'" in page.headers["Content-Security-Policy"]
            token = re.search(r'hil-token" content="([\w-]{40,})"', page.read().decode())
        assert token and asyncio.run(say(url, json.dumps({"stop": token[1]}))) == "there is no run to stop"
        taken = call("watch", "--web", "--port", url.rsplit(":")[-1].strip("/"))
        assert taken.returncode == 2 and "choose another: --port" in taken.stderr


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
                assert page.evaluate("document.querySelector('#state').className") == "good"
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


def test_the_page_comes_back_after_the_server(browser: Browser) -> None:
    page = browser.page()
    with server("--port", "0") as url:
        page.open(url)
        page.wait_for("document.querySelector('#state').textContent === 'waiting for a run'")
        token = page.evaluate("document.querySelector('meta[name=hil-token]').content")
    page.wait_for("document.querySelector('#state').textContent.startsWith('no connection')")
    with server("--port", url.rsplit(":")[-1].strip("/")):
        page.wait_for("document.querySelector('#state')?.textContent === 'waiting for a run'")
        assert page.evaluate("document.querySelector('meta[name=hil-token]').content") != token
