"""The engine: batches of a job over the workers of Dask distributed, and nothing of our own in between.

A lost worker's batches run again elsewhere. What a batch gives depends on job and numbers alone, so neither
the number of workers nor their losses show in a result. A batch whose workers die again and again is cut in
two, until the case that kills them is alone: it becomes a row.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import tempfile
import types
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final, Protocol

from hil.campaign.identity import Identity, differences, identity
from hil.errors import HilError
from hil.runtime.clock import RealClock

Row = dict[str, Any]
Span = tuple[int, int]
IN_FLIGHT: Final = 4
"""Batches a worker has waiting, so that it never waits for one; no more, so that memory stays bounded."""
SMALLEST: Final = 8
"""Into so many pieces a batch is cut at the end of a campaign."""
LOSSES: Final = 3
"""Workers that may die with a batch before it is cut in two."""
MEMORY: Final = "1GB"
"""A worker above it is ended and begun again; it needs a quarter."""
FORKS: Final = sys.platform == "linux"
"""Whether workers are forked off a process that has imported what they need; else each is begun anew."""
PRELOAD: Final = ["distributed.nanny", "distributed.worker", "hil.campaign.case"]
THREADS: Final = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
HASH_SEED: Final = "6640"
"""Of text, that Dask gives its workers, too."""
CONFIG: Final = {
    "distributed.scheduler.allowed-failures": LOSSES,
    "distributed.admin.tick.limit": "1h",
    "distributed.admin.tick.interval": "5s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.worker.profile.enabled": False,
    "distributed.worker.multiprocessing-method": "forkserver" if FORKS else "spawn",
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.monitor-interval": "500ms",
    "distributed.nanny.pre-spawn-environ": dict.fromkeys(THREADS, 1),
}
MISSING: Final = "campaigns need dask.distributed: pip install 'hil-drive[campaign]'"


class Job(Protocol):
    """What is run: goes to the workers by pickle."""

    @property
    def unit(self) -> str:
        """What is counted."""

    def run(self, start: int, stop: int) -> list[Row]:
        """Rows of the items from ``start`` up to ``stop``."""


@dataclass(frozen=True, slots=True)
class Workers:
    """Where it runs: so many local processes (0: in this one), or an existing scheduler."""

    count: int
    scheduler: str | None = None


def batches(spans: Iterator[Span], size: int, left: int = 0, workers: int = 0) -> Iterator[Span]:
    """Spans cut into pieces of at most ``size``.

    Of ``left`` items in all the last go out in smaller pieces, so that ``workers`` end at about one time.
    """
    for start, stop in spans:
        at = start
        while at < stop:
            fair = left // (2 * workers) if workers else size
            end = min(stop, at + min(size, max(fair, size // SMALLEST, 1)))
            left -= end - at
            yield at, end
            at = end


def run_batch(job: Job, wanted: Identity, start: int, stop: int) -> list[Row]:
    """On a worker: the rows of a batch. Raises HilError on a worker of another version."""
    if found := differences(wanted, identity()):
        raise HilError(f"a worker has {found}; install the same on all")
    return job.run(start, stop)


def lost(start: int) -> Row:
    """The row of a case that ends whatever worker takes it."""
    why = f"{LOSSES + 1} workers ended over it, for want of memory or by a crash"
    return {"case": start, "ended": "lost", "passed": False, "why": why}


def run(job: Job, pieces: Iterator[Span], workers: Workers, take: Callable[[list[Row]], None]) -> None:
    """Run every batch; ``take`` gets its rows, in the order in which they are done. Raises HilError."""
    if not workers.count and workers.scheduler is None:
        for start, stop in pieces:
            take(job.run(start, stop))
        return
    with connected(workers) as client:
        _same_everywhere(client)
        _through(client, job, pieces, take)


def begin_forks() -> None:
    """Begin the process that local workers are forked from: it imports while this one goes on.

    Signals of the terminal are for this process, which ends the workers: those have them blocked.
    """
    if not FORKS:
        return
    from multiprocessing import forkserver, resource_tracker

    forkserver.set_forkserver_preload(PRELOAD)
    before = dict(os.environ)
    os.environ.update(dict.fromkeys(THREADS, "1"), PYTHONHASHSEED=HASH_SEED)
    resource_tracker.ensure_running()  # it unblocks the signals, so first
    signals = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, signals)
        os.environ.clear()
        os.environ.update(before)


@contextlib.contextmanager
def connected(workers: Workers) -> Iterator[Any]:
    """A client of the scheduler that is named, or of a local cluster for as long as the block runs."""
    try:
        import dask
        import distributed
    except ImportError as error:
        raise HilError(MISSING) from error
    library: Any = distributed
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(CONFIG))
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter(
            "ignore"
        )  # distributed's own, of versions and ports: we compare versions ourselves
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        if workers.scheduler:
            yield stack.enter_context(_reached(library.Client, workers.scheduler))
            return
        begin_forks()
        stack.enter_context(_without_main())
        folder = stack.enter_context(
            tempfile.TemporaryDirectory(prefix="hil-campaign-", ignore_cleanup_errors=True)
        )
        cluster = library.LocalCluster(
            n_workers=workers.count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            memory_limit=MEMORY,
            local_directory=folder,
            silence_logs=logging.CRITICAL,
        )
        stack.enter_context(cluster)
        yield stack.enter_context(library.Client(cluster))


@contextlib.contextmanager
def _without_main() -> Iterator[None]:
    """Workers import nothing of the program that asks: a script without ``if __name__`` would run in each."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _reached(client: Any, address: str) -> Any:
    try:
        return client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise HilError(
            f"--scheduler {address}: no answer; is it `dask scheduler`'s address, tcp://HOST:PORT?"
        ) from error


def _same_everywhere(client: Any) -> None:
    """Refuse workers of another version before anything runs. Raises HilError."""
    own = identity()
    try:
        found = client.run(identity)
    except Exception as error:
        raise HilError(f"the workers can't run this hil-drive: {error}; install the same on all") from error
    for address, other in found.items():
        if text := differences(own, other):
            raise HilError(f"worker {address} has {text}; install the same on all")


def _through(client: Any, job: Job, pieces: Iterator[Span], take: Callable[[list[Row]], None]) -> None:
    """Keep every worker busy until all batches are done."""
    import distributed

    library: Any = distributed

    own, open_spans = identity(), {}

    def submit(span: Span) -> Any:
        future = client.submit(run_batch, job, own, *span, pure=False)
        open_spans[future.key] = span
        return future

    room = IN_FLIGHT * max(1, len(client.scheduler_info(n_workers=-1)["workers"]))
    first = [submit(span) for _, span in zip(range(room), pieces, strict=False)]
    waiting = library.as_completed(first)
    del first
    for future in waiting:
        start, stop = open_spans.pop(future.key)
        try:
            rows = future.result()
        except library.KilledWorker:
            if stop - start > 1:
                middle = (start + stop) // 2
                for span in ((start, middle), (middle, stop)):
                    waiting.add(submit(span))
                continue
            rows = [lost(start)]
        future.release()
        take(rows)
        for _, span in zip(range(1), pieces, strict=False):
            waiting.add(submit(span))


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Rate:
    """How many are done a second, and how long the rest takes [s]."""

    def __init__(self, total: int, done: int) -> None:
        self._clock = RealClock()
        self.total, self.done, self._first = total, done, done
        self._begin_ns = self._clock.now_ns()

    def add(self, count: int) -> None:
        """So many more are done."""
        self.done += count

    @property
    def seconds(self) -> float:
        """Since it began."""
        return (self._clock.now_ns() - self._begin_ns) * 1e-9

    @property
    def per_s(self) -> float:
        """Done in this session, a second."""
        return (self.done - self._first) / max(self.seconds, 1e-9)

    def line(self, unit: str) -> str:
        """For people."""
        left = (self.total - self.done) / self.per_s if self.per_s > 0 else float("inf")
        end = f"{left:.0f} s left" if left < 1e7 else "begins"
        return f"{self.done} of {self.total} {unit}, {self.per_s:.0f}/s, {end}"
