"""Our files in @mcap/core, the reader that Foxglove and Lichtblick are built on: every tick, to the bit.

Needs node and the packages @mcap/core and fzstd: make node. Skipped without.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from tests.logfiles import HEADER, some_frames, some_ticks, write_log
from tests.node import MISSING, has_packages, node

SCRIPT = """
const {McapIndexedReader} = require("@mcap/core"), fzstd = require("fzstd");
const fs = require("fs"), crypto = require("crypto");
const fd = fs.openSync(process.argv[1], "r");
const readable = {
  size: async () => BigInt(fs.fstatSync(fd).size),
  read: async (offset, length) => {
    const out = new Uint8Array(Number(length));
    fs.readSync(fd, out, 0, out.length, Number(offset));
    return out;
  },
};
const zstd = (data, size) => fzstd.decompress(data, new Uint8Array(Number(size)));
(async () => {
  const reader = await McapIndexedReader.Initialize({readable, decompressHandlers: {zstd}});
  const found = {counts: {}, schemas: [], attachments: [], metadata: []};
  const hash = crypto.createHash("sha256");
  for await (const message of reader.readMessages()) {
    const topic = reader.channelsById.get(message.channelId).topic;
    found.counts[topic] = (found.counts[topic] || 0) + 1;
    if (topic === "/tick") hash.update(message.data);
  }
  for (const schema of reader.schemasById.values()) found.schemas.push(schema.name);
  for await (const one of reader.readAttachments()) found.attachments.push(one.name);
  for await (const one of reader.readMetadata()) found.metadata.push(one.name);
  found.ticks = hash.digest("hex");
  console.log(JSON.stringify(found));
})();
"""


@pytest.fixture(scope="module")
def needs_node() -> None:
    if not has_packages("@mcap/core", "fzstd"):
        pytest.skip(MISSING)


@pytest.mark.usefixtures("needs_node")
def test_mcap_core_reads_every_tick_to_the_bit(tmp_path: Path) -> None:
    ticks, frames = some_ticks(300), some_frames(900)
    write_log(tmp_path / "run.mcap", ticks, frames)
    done = node(SCRIPT, str(tmp_path / "run.mcap"))
    assert done.returncode == 0 and not done.stderr, done.stderr
    found = json.loads(done.stdout)
    received = int((frames["received"] != 0).sum())
    wanted = {"/tick": 300, "/can/rx": received, "/can/tx": 900 - received, "/event": 6, "/stats": 6}
    assert found["counts"] == wanted
    assert found["ticks"] == hashlib.sha256(ticks.tobytes()).hexdigest()
    assert sorted(found["schemas"]) == ["hil.CanFrame", "hil.Event", "hil.Stats", "hil.Tick"]
    assert set(found["attachments"]) == set(HEADER["attachments"])
    assert set(found["metadata"]) == {"run", "units", "meanings", "result"}
