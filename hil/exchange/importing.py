"""``hil import``: a recording of a bus as a log that ``hil replay`` and ``hil report`` take.

The recorded frames go through the client that a run reads the bus with, and the controller of the config
runs over what it makes of them. Its commands are compared with the recorded ones byte by byte. Are they the
same, the recording is of this controller, and the log is that of its run. Are they not, it is a log of a
shadow run: somebody else closed the loop, and what this controller would have done is open loop.

What is not on the wire: the deadlines (SYNC's stamps stand in, on a grid of the period), the phases within
a tick but for SYNC, feedback and command, what the log's own writer or the guardian told the loop, and every
output but the command (computed anew). How many periods were skipped before a tick, what the operator asked
and what had been read by the time of the command is not there either, but the commands prove it, and a wrong
guess is taken back once a later one shows it (:mod:`hil.exchange.search`). Where no command depends on it the
guess by the stamps stands: at periods skipped while the drive is being enabled or stopped, at their place
within a stretch of held commands, and at the tick that took a status frame. In a listener's recording one
that came between measurement and command may have been read with either of two ticks; the first of each
kind enables the drive, which shows. The controller's own side recorded frames as it read them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.exchange.export import replacing
from hil.exchange.periods import HELD_PERIODS, MERGE_PERIODS, Heard, Steady, periods
from hil.exchange.readers.recorded import ERROR, EXTENDED, ID_MASK, REMOTE
from hil.exchange.recording import Recording
from hil.exchange.rerun import Run
from hil.exchange.search import NotOursError, Search
from hil.log.errors import LogError
from hil.log.mcapfile import RunFile
from hil.log.records import FRAME_RECORD
from hil.log.schema import FRAME
from hil.runtime.header import header_of
from hil.runtime.loop import transition_event
from hil.runtime.setup import Overrides, Setup, load_setup
from hil.signals import TICK, DriveState, Reason, RxFlag

BLOCK: Final = 2048
PAUSE_NS: Final = 1_000_000_000
OURS: Final = "the commands are this controller's, to the bit"
THEIRS: Final = "open loop: another controller's commands, this one only computes"


@dataclass(frozen=True, slots=True)
class Imported:
    """What was made of a recording."""

    written: str
    ticks: int
    skipped: int
    frames: int
    commands: str
    ended: str
    set_right: int
    damage: str | None
    notes: list[str]

    def as_dict(self) -> dict[str, Any]:
        """As a plain dict."""
        return asdict(self)


class Output:
    """The log in the making; holds a block of ticks and of frames."""

    def __init__(self, file: RunFile) -> None:
        self._file = file
        self._rows: list[bytes] = []
        self._frames: list[bytes] = []
        self._state = int(DriveState.SWITCH_ON_DISABLED)
        self.last_ns = self.ticks = self.fresh = self.skipped = 0

    def passing(self, frames: Iterable[Heard]) -> Iterator[Heard]:
        """The frames, each kept on its way."""
        for frame in frames:
            t_ns, can_id, received, _, data = frame
            self.last_ns = t_ns
            self._frames.append(FRAME_RECORD.pack(t_ns, can_id, received, len(data), data))
            if len(self._frames) == BLOCK:
                self.flush()
            yield frame

    def tick(self, ticks: Any) -> None:
        """Keep a tick, and an event when the supervisor's state changes."""
        tick = ticks[0]
        self.ticks += 1
        self.fresh += bool(int(tick["rx_flags"]) & RxFlag.FRESH)
        self.skipped += int(tick["skipped"])
        if int(tick["state"]) != self._state:
            self._state = int(tick["state"])
            what = transition_event(self._state, int(tick["reason"]))
            self._file.add_event(int(tick["t_ns"]), int(tick["k"]), *what)
        self._rows.append(ticks.tobytes())
        if len(self._rows) == BLOCK:
            self.flush()

    def flush(self) -> None:
        """Hand the blocks to the file."""
        self._file.add_ticks(np.frombuffer(b"".join(self._rows), TICK))
        self._file.add_frames(np.frombuffer(b"".join(self._frames), FRAME))
        self._rows, self._frames = [], []


def import_recording(
    source: Path,
    out: Path,
    config: Path,
    settings: tuple[str, ...] = (),
    *,
    channel: str | None = None,
    force: bool = False,
    partial: bool = False,
) -> Imported:
    """Write the recording ``source`` as the log ``out``. Raises HilError for what can't be imported.

    ``channel``, ``partial``: as :class:`hil.exchange.recording.Recording`.
    """
    if out.suffix.lower() != ".mcap":
        raise LogError(f"{out}: a log ends in .mcap")
    setup = load_setup(config, Overrides(settings=settings))
    if setup.binding.map.poll:
        raise LogError(
            f"{config}: drive.signals.poll: a recording with a drive that is asked by its command can't be "
            "imported; the run's own log replays"
        )
    recording = Recording(source, channel, partial)
    period_ns = setup.config.loop.period_ns
    if recording.step_ns > period_ns:
        raise LogError(
            f"{source}: its stamps go in steps of {recording.step_ns * 1e-6:g} ms, longer than the period of "
            f"{period_ns * 1e-6:g} ms: single ticks can't be told apart; record with finer stamps"
        )
    with replacing(out, force=force) as part:
        try:
            return _carry(setup, recording, part, out)
        except NotOursError as why:
            part.unlink(missing_ok=True)
            if setup.config.controller.kind == "fac":
                raise LogError(
                    f"{source}: {why}; and controller.kind fac can't judge another's commands"
                ) from why
            shadow = load_setup(config, Overrides(settings=(*settings, "loop.shadow=true")))
            return _carry(shadow, recording, part, out, f" ({why}{_pause(recording)})")


def _pause(recording: Recording) -> str:
    """The longest time without a frame, where it may be why the commands do not fit."""
    longest_ns, at_ns = recording.longest
    if longest_ns < PAUSE_NS:
        return ""
    return f"; its stamps jump by {longest_ns * 1e-9:.3f} s at {at_ns * 1e-9:.6f} s"


def _carry(setup: Setup, recording: Recording, part: Path, out: Path, why: str = "") -> Imported:
    """One pass over the recording; ``why``: what this controller was found not to have sent."""
    run, loop = Run(setup), setup.config.loop
    merge = MERGE_PERIODS if run.shadow else HELD_PERIODS
    commands = (THEIRS if run.shadow else OURS) + why
    with RunFile(part, _header(setup, recording, commands)) as file:
        output = Output(file)
        passing = output.passing(recording.heard())
        steady = Steady(periods(passing, run.roles, loop.timeout_ns, loop.period_ns, merge))
        for ticks in Search(run).ticks(steady.periods()):
            output.tick(ticks)
        _check_jump(recording, steady, run)
        for _ in passing:
            pass  # what comes after the run is kept as frames
        _check(recording, run, output)
        output.flush()
        ended = Reason(int(run.ticks["reason"][0])).name.lower() if run.over else "the recording ends here"
        _finish(file, output, recording, commands, ended)
    return Imported(
        str(out),
        output.ticks,
        output.skipped,
        recording.count,
        commands,
        ended,
        recording.set_right,
        recording.damage,
        recording.notes,
    )


def _finish(file: RunFile, output: Output, recording: Recording, commands: str, ended: str) -> None:
    """What the log says of where it comes from."""
    at = output.last_ns, max(output.ticks - 1, 0)
    file.add_event(*at, "import", f"{recording.path.name}: {commands}")
    for kind, texts in (("damage", filter(None, [recording.damage])), ("note", recording.notes)):
        for text in texts:
            file.add_event(*at, kind, text)
    totals = {"ticks": output.ticks, "skipped": output.skipped, "commands": commands}
    file.finish({"ended": ended, **totals})


def _check_jump(recording: Recording, steady: Steady, run: Run) -> None:
    """A run does not go on after a minute without a tick: the recorder's clock was set. Raises LogError."""
    if steady.jump is None or run.over:
        return
    before_ns, after_ns = steady.jump
    raise LogError(
        f"{recording.path}: time jumps by {(after_ns - before_ns) * 1e-9:.3f} s in the middle of a run, "
        f"from {before_ns * 1e-9:.6f} s to {after_ns * 1e-9:.6f} s after its first frame; cut it there"
    )


def named(can_id: int) -> str:
    """An identifier with its kind: ``181``, or ``181x (29 bits)``; of an error frame its class."""
    text = f"{can_id & ID_MASK:X}" + ("x (29 bits)" if can_id & EXTENDED else "")
    kind = " (error frame)" if can_id & ERROR else " (remote frame)" if can_id & REMOTE else ""
    return text + kind


def _check(recording: Recording, run: Run, output: Output) -> None:
    """A recording without a tick or a measurement is of another bus. Raises LogError."""
    if output.fresh:
        return
    seen = ", ".join(map(named, sorted(recording.identifiers)[:20]))
    measured = ", ".join(map(named, sorted(run.roles.measuring)))
    sync = "" if run.roles.sync is None else f", SYNC {named(run.roles.sync)}"
    damage = f"; {recording.damage}" if recording.damage else ""
    raise LogError(
        f"{recording.path}: no valid feedback among {recording.count} frames; wanted identifiers: "
        f"feedback {measured}{sync}; seen: {seen}{damage}"
    )


def _header(setup: Setup, recording: Recording, commands: str) -> dict[str, Any]:
    """The header of a run's log, with what it is made from."""
    header = header_of(setup, "import", "recording")
    started = datetime.fromtimestamp(0, UTC) + timedelta(microseconds=recording.start_ns // 1000)
    header["metadata"] |= {
        "started": started.isoformat(),
        "recording": recording.path.name,
        "commands": commands,
    }
    return header
