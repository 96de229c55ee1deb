"""hil commands as forked processes, for the crash tests."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from hil import cli

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "demo.toml"
PATIENCE_S = 90.0


def forked(output: Path, *words: str) -> int:
    """A hil command as a forked process in a session of its own; its standard output goes to a file."""
    pid = os.fork()
    if pid:
        return pid
    code = 70
    try:
        os.setsid()
        target = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(target, 1)
        os.dup2(os.open(output.with_suffix(".err"), os.O_WRONLY | os.O_CREAT, 0o600), 2)
        code = cli.main(list(words))
        sys.stdout.flush()
    finally:
        os._exit(code)


def ended(pid: int, within_s: float = PATIENCE_S) -> int | None:
    """Exit code of a child, None when it has not ended in time."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    return None


def alive(pid: int) -> bool:
    """A process that has ended has no command line, even while nobody has waited for it."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes() != b""
    except OSError:
        return False
