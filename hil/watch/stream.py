"""A run over Foxglove's WebSocket protocol, for Foxglove, Lichtblick, PlotJuggler; extra `foxglove`.

Topics, schemas and messages are those of the MCAP files, so one layout serves both; times are the log's.
Only this machine reaches it, and nothing that a client sends reaches the run. The protocol has no password,
so any program and any web page of this machine can read: ``hil watch`` asks for ``--open``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from hil.log.records import FRAME_RECORD
from hil.log.ring import RingError, attach
from hil.log.schema import (
    FRAME,
    FRAME_HEAD,
    TOPICS,
    file_descriptor_set,
    frame_messages,
    node_topic,
    pack_event,
)
from hil.runtime.registry import WatchError, choose
from hil.signals import TickArray
from hil.watch.look import Look, outcome

PERIOD_S: Final = 0.05
BACKLOG: Final = 4096
"""Messages that may wait for a slow client; the oldest are dropped."""
SENT: Final = ("/tick", "/can/rx", "/can/tx", "/event")
MISSING = "foxglove-sdk is not installed: pip install 'hil-drive[foxglove]'"


def sdk() -> Any:
    """The SDK. Raises WatchError when it is not installed."""
    try:
        import foxglove
    except ImportError as error:
        raise WatchError(MISSING) from error
    return foxglove


def channels(foxglove: Any, context: Any, nodes: Sequence[str] = ()) -> dict[str, Any]:
    """One channel a topic, with the schema that is embedded in the log files; ``nodes``: after the first."""
    data = file_descriptor_set().SerializeToString()
    out = {}
    for topic in (*SENT, *map(node_topic, nodes)):
        schema = foxglove.Schema(name=TOPICS.get(topic, TOPICS["/tick"]), encoding="protobuf", data=data)
        out[topic] = foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=context)
    return out


class Stream:
    """Rings in, channels out."""

    def __init__(self, look: Look, to: dict[str, Any]) -> None:
        self._look, self._to = look, to
        try:
            self._frames = attach(look.entry.pid, "frames", FRAME_RECORD.size)
        except RingError as error:
            raise WatchError(str(error)) from error
        self._frames_seen = self._frames.published
        self._more = {node_topic(node): Look(look.entry, node) for node in look.entry.nodes[1:]}

    def once(self) -> None:
        """Pass on what is new."""
        self._pass_ticks("/tick", self._look.new_ticks())
        for topic, look in self._more.items():
            self._pass_ticks(topic, look.new_ticks())
        for t_ns, k, kind, text in self._look.new_events():
            self._to["/event"].log(pack_event(t_ns, k, kind, text), log_time=t_ns)
        raw, self._frames_seen = self._frames.since(self._frames_seen)
        frames = np.frombuffer(raw, FRAME)
        for frame, message in zip(frames, frame_messages(frames), strict=True):
            topic = "/can/rx" if frame["received"] else "/can/tx"
            data = message.tobytes()[: FRAME_HEAD + int(frame["size"])]
            self._to[topic].log(data, log_time=int(frame["t_ns"]))

    def _pass_ticks(self, topic: str, ticks: TickArray) -> None:
        for tick in ticks:
            self._to[topic].log(tick.tobytes(), log_time=int(tick["t_ns"]))

    def close(self) -> None:
        """Let go of the rings."""
        for look in self._more.values():
            look.close()
        self._frames.close()


async def _serve(look: Look, port: int, say: Callable[[str], None]) -> None:
    foxglove = sdk()
    context = foxglove.Context()
    to = channels(foxglove, context, look.entry.nodes[1:])
    try:
        server = foxglove.start_server(
            name="hil watch", host="127.0.0.1", port=port, context=context, message_backlog_size=BACKLOG
        )
    except (OSError, RuntimeError) as error:
        raise WatchError(f"port {port} can't be used ({error}); choose another: --port N") from error
    try:
        stream = Stream(look, to)
        say(f"hil: ws://127.0.0.1:{server.port} speaks Foxglove's protocol (Ctrl-C ends it, not the run)")
        while look.alive:
            stream.once()
            await asyncio.sleep(PERIOD_S)
        stream.once()
        stream.close()
        say(f"hil: the run has ended: {outcome(look.entry.log)}")
    finally:
        server.stop()


def run(wanted: str | None, port: int, say: Callable[[str], None]) -> None:
    """Serve until the run ends or we are interrupted."""
    sdk()
    look = Look(choose(wanted))
    try:
        asyncio.run(_serve(look, port, say))
    finally:
        look.close()
