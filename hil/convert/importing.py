"""``hil import``: a recording of a bus as a log that ``hil replay`` and ``hil report`` take.

The recorded frames go through the client that a run reads the bus with, and the controller of the config
runs over what it makes of them. Its commands are compared with the recorded ones byte by byte. Are they the
same, the recording is of this controller, and the log is that of its run. Are they not, it is a log of a
shadow run: somebody else closed the loop, and what this controller would have done is open loop.

What is not on the wire: the deadlines (SYNC's stamps stand in, on a grid of the period), the phases within
a tick but for SYNC, feedback and command, what the log's own writer or the guardian told the loop, and every
output but the command (computed anew). How many periods were skipped before a tick, what the operator asked
and what had been read by the time of the command is not there either, but the commands prove it, and a wrong
guess is taken back once a later one shows it (:mod:`hil.convert.search`). Where no command depends on it the
guess by the stamps stands: at periods skipped while the drive is being enabled or stopped, at their place
within a stretch of held commands, and in a listener's recording at the tick that took a status frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from hil.app import Overrides, Setup, header_of, load_setup
from hil.convert.export import replacing
from hil.convert.periods import HELD_PERIODS, MERGE_PERIODS, Heard, periods
from hil.convert.recording import Recording
from hil.convert.recordings import ID_MASK
from hil.convert.rerun import Run
from hil.convert.search import NotOursError, Search
from hil.log.errors import LogError
from hil.log.mcapfile import RunFile
from hil.log.records import FRAME_RECORD
from hil.log.schema import FRAME
from hil.loop import transition_event
from hil.signals import TICK, DriveState, Reason, RxFlag

BLOCK: Final = 2048
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
) -> Imported:
    """Write the recording ``source`` as the log ``out``. Raises HilError for what can't be imported."""
    if not source.is_file():
        raise LogError(f"{source}: no such file")
    if out.suffix.lower() != ".mcap":
        raise LogError(f"{out}: a log ends in .mcap")
    setup = load_setup(config, Overrides(settings=settings))
    with replacing(out, force=force) as part:
        try:
            return _carry(setup, Recording(source, channel), part, out)
        except NotOursError as why:
            part.unlink(missing_ok=True)
            if setup.config.controller.kind == "fac":
                raise LogError(
                    f"{source}: {why}; and controller.kind fac can't judge another's commands"
                ) from why
            shadow = load_setup(config, Overrides(settings=(*settings, "loop.shadow=true")))
            return _carry(shadow, Recording(source, channel), part, out, f" ({why})")


def _carry(setup: Setup, recording: Recording, part: Path, out: Path, why: str = "") -> Imported:
    """One pass over the recording; ``why``: what this controller was found not to have sent."""
    run, frames = Run(setup), recording.frames()
    merge = MERGE_PERIODS if run.shadow else HELD_PERIODS
    first = next(frames, None)
    if first is None:
        raise LogError(f"{recording.path}: {recording.damage or 'has no frames'}{_other_channels(recording)}")
    commands = (THEIRS if run.shadow else OURS) + why
    with RunFile(part, _header(setup, recording, commands)) as file:
        output = Output(file)
        loop = setup.config.loop
        passing = output.passing(itertools.chain([first], frames))
        found = periods(passing, run.roles, loop.timeout_ns, loop.period_ns, merge)
        for ticks in Search(run).ticks(found):
            output.tick(ticks)
        for _ in passing:
            pass  # what comes after the run is kept as frames
        count = output.ticks
        _check(recording, run, output)
        output.flush()
        ended = Reason(int(run.ticks["reason"][0])).name.lower() if run.over else "the recording ends here"
        file.add_event(output.last_ns, max(count - 1, 0), "import", f"{recording.path.name}: {commands}")
        if recording.damage:
            file.add_event(output.last_ns, max(count - 1, 0), "damage", recording.damage)
        file.finish({"ended": ended, "ticks": count, "skipped": output.skipped, "commands": commands})
    skipped, right = output.skipped, recording.set_right
    return Imported(str(out), count, skipped, recording.count, commands, ended, right, recording.damage)


def _other_channels(recording: Recording) -> str:
    return f"; channels there are {recording.channels}" if recording.channel is not None else ""


def _check(recording: Recording, run: Run, output: Output) -> None:
    """A recording without a tick or a measurement is of another bus. Raises LogError."""
    if output.fresh:
        return
    seen = ", ".join(f"{can_id & ID_MASK:X}" for can_id in sorted(recording.identifiers)[:20])
    measured = ", ".join(f"{can_id & ID_MASK:X}" for can_id in sorted(run.roles.measuring))
    sync = "" if run.roles.sync is None else f", SYNC {run.roles.sync & ID_MASK:X}"
    damage = f"; {recording.damage}" if recording.damage else ""
    raise LogError(
        f"{recording.path}: no valid feedback among {recording.count} frames; wanted identifiers: "
        f"feedback {measured}{sync}; seen: {seen}{damage}"
    )


def _header(setup: Setup, recording: Recording, commands: str) -> dict[str, Any]:
    """The header of a run's log, with what it is made from."""
    header = header_of(setup, "import", "recording")
    started = datetime.fromtimestamp(recording.start_us * 1e-6, UTC).isoformat()
    header["metadata"] |= {"started": started, "recording": recording.path.name, "commands": commands}
    return header
