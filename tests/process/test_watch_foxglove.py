"""`hil watch --foxglove` as its clients see it: protocol, schemas, messages."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from hil.log.schema import TOPICS, file_descriptor_set
from hil.runtime.setup import Overrides
from hil.signals import TICK, DriveState, ticks_from
from hil.sim.demo import emulator_process
from tests.node import has_packages, node
from tests.process.test_run import call, flags, hil
from tests.process.test_watch import wait_for_run

Settings = Callable[..., tuple[str, ...]]
PROTOCOLS = [Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1")]

SCRIPT = """
const {FoxgloveClient} = require("@foxglove/ws-protocol"), WebSocket = require("ws");
const socket = new WebSocket(process.argv[1], ["foxglove.sdk.v1"]);
const client = new FoxgloveClient({ws: socket}), channels = {}, ticks = [];
let subscription;
const out = found => process.stdout.write(JSON.stringify(found), () => process.exit());
client.on("error", error => out({error: String(error)}));
client.on("serverInfo", info => { channels.info = info.name; });
client.on("advertise", all => all.forEach(one => {
  channels[one.topic] = [one.schemaName, one.encoding, one.schema];
  if (one.topic === "/tick") subscription = client.subscribe(one.id);
}));
client.on("message", ({subscriptionId, timestamp, data}) => {
  if (subscriptionId !== subscription || ticks.length === 500) return;
  const bytes = Buffer.from(data.buffer, data.byteOffset, data.byteLength);
  ticks.push([String(timestamp), bytes.toString("base64")]);
  if (ticks.length === 500) out({channels, ticks});
});
"""


async def talk(url: str) -> tuple[dict[str, Any], dict[str, Any], dict[str, list[bytes]]]:
    """Greeting, channels by topic, and some messages of ticks and frames."""
    async with asyncio.timeout(60), connect(url, subprotocols=PROTOCOLS, proxy=None) as socket:
        info: dict[str, Any] = {}
        channels: dict[str, Any] = {}
        while not info or len(channels) < 4:
            message = json.loads(await socket.recv())
            if message["op"] == "serverInfo":
                info = message
            if message["op"] == "advertise":
                channels |= {channel["topic"]: channel for channel in message["channels"]}
        wanted = ("/tick", "/can/rx", "/can/tx")
        asked = [{"id": n, "channelId": channels[topic]["id"]} for n, topic in enumerate(wanted)]
        await socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        got: dict[str, list[bytes]] = {topic: [] for topic in wanted}
        while min(map(len, got.values())) < 200:
            raw = await socket.recv()
            if isinstance(raw, bytes) and raw[0] == 1:
                (number,) = struct.unpack_from("<I", raw, 1)
                got[wanted[number]].append(raw[13:])
        return info, channels, got


def check_what_foxgloves_client_got(found: dict[str, Any]) -> None:
    """The JavaScript client of Foxglove: channels, schemas, times, ticks to the byte."""
    schema = base64.b64encode(file_descriptor_set().SerializeToString()).decode()
    assert "error" not in found, found
    channels = found["channels"]
    assert channels.pop("info") == "hil watch" and set(channels) == {"/tick", "/can/rx", "/can/tx", "/event"}
    assert all(channels[topic] == [TOPICS[topic], "protobuf", schema] for topic in channels)
    raw = [base64.b64decode(data) for _, data in found["ticks"]]
    assert all(len(one) == TICK.itemsize for one in raw)
    ticks = ticks_from(b"".join(raw))
    assert [int(t) for t, _ in found["ticks"]] == ticks["t_ns"].tolist()
    assert (ticks["k"][1:] > ticks["k"][:-1]).all()


@pytest.mark.long
@pytest.mark.process
def test_a_client_gets_the_schemas_and_ticks_of_the_log_files(
    configs: Path, settings: Settings, tmp_path: Path, channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("foxglove", reason="needs the extra foxglove")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    own, path = settings("loop.duration_s=60.0"), configs / "demo.toml"
    with emulator_process(path, Overrides(settings=own)), hil("run", str(path), *flags(own)) as process:
        wait_for_run(process, channel)
        with hil("watch", "--foxglove", "--open", "--port", "0", channel) as server:
            assert server.stderr is not None
            found = re.search(r"ws://127\.0\.0\.1:\d+", line := server.stderr.readline())
            assert found, line
            info, channels, got = asyncio.run(talk(found[0]))
            if has_packages("@foxglove/ws-protocol", "ws"):
                check_what_foxgloves_client_got(json.loads(node(SCRIPT, found[0]).stdout))
            process.terminate()
            process.wait(60)
            assert "the run has ended: stop_requested" in server.stderr.read()
            assert server.wait(30) == 0
    assert info["name"] == "hil watch"
    assert {topic: c["schemaName"] for topic, c in channels.items()}.items() <= TOPICS.items()
    for c in channels.values():
        assert c["encoding"] == "protobuf"
        assert FileDescriptorSet.FromString(base64.b64decode(c["schema"])) == file_descriptor_set()
    ticks = ticks_from(b"".join(got["/tick"]))
    assert all(len(raw) == TICK.itemsize for raw in got["/tick"])
    assert (ticks["k"][1:] > ticks["k"][:-1]).all() and (ticks["state"] == DriveState.OPERATION_ENABLED).all()
    ids = {
        topic: {struct.unpack_from("<I", raw, 10)[0] for raw in got[topic]}
        for topic in got
        if topic != "/tick"
    }
    assert 0x181 in ids["/can/rx"] and 0x201 in ids["/can/tx"]


def test_without_the_extra_it_is_one_clear_line() -> None:
    script = (
        "import sys; sys.modules['foxglove'] = None; from hil.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "watch", "--foxglove", "--open"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "hil: foxglove-sdk is not installed: pip install 'hil-drive[foxglove]'\n"


def test_a_port_without_a_password_is_opened_by_a_flag_alone() -> None:
    done = call("watch", "--foxglove")
    assert done.returncode == 2 and "say --open beside it" in done.stderr
    assert len(done.stderr.splitlines()) == 1
