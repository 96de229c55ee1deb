"""What every job in the bench machine starts with: hil commands as forked processes, kernels loaded once."""

from __future__ import annotations

import os
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from hil import cli
from hil.config.tables import RunConfig, load_toml
from hil.sim.emulate import make_node

SCRATCH = Path(os.environ.get("TMPDIR", "/dev/shm"))
CONFIG = "configs/vcan0.toml"
SHIPPED = ("current", "cia402", "moteus", "odrive")
FD = ("bus.fd=true", 'drive.dbc="drives/hil_pmsm_fd.dbc"')
KERNEL = ('bus.sync="kernel"',)


class Forked:
    """A job as a process of its own, forked after the imports, which take long in the machine."""

    def __init__(self, output: Path, job: Callable[[], int]) -> None:
        self.output: Path = output
        self._code: int | None = None
        self.pid = os.fork()
        if self.pid == 0:
            self._become(job)

    @classmethod
    def hil(cls, output: Path, *words: str) -> Forked:
        """A hil command."""
        return cls(output, lambda: cli.main(list(words)))

    def _become(self, job: Callable[[], int]) -> None:
        code = 70
        try:
            target = os.open(self.output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            os.dup2(target, 1)
            code = job()
            sys.stdout.flush()
        except SystemExit as error:
            code = int(error.code or 0)
        except BaseException:  # noqa: BLE001 - nobody above would print it
            traceback.print_exc()
        finally:
            os._exit(code)

    def poll(self) -> int | None:
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def wait(self) -> int:
        while (code := self.poll()) is None:
            time.sleep(0.01)
        return code

    def until(self, word: str) -> None:
        """Wait until it has printed the word or ended."""
        while word not in self.said() and self.poll() is None:
            time.sleep(0.01)

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def said(self) -> str:
        return self.output.read_text() if self.output.exists() else ""


def warm_up() -> None:
    """Import what a run needs and load its compiled kernels once, before any process is forked."""

    from hil.runtime.session import compile_kernels
    from hil.runtime.setup import Overrides, load_setup

    setup = load_setup(Path(CONFIG), Overrides())
    node = make_node(Path(CONFIG), load_toml(Path(CONFIG), RunConfig, ['bus.interface="hil-local"']), [])
    node[0].warm_up()
    node[1].close()
    compile_kernels(setup)
    compile_kernels(load_setup(Path(CONFIG), Overrides(settings=('bus.sync="kernel"',))))
    read_in()


def compile_the_rest() -> None:
    """On the host: kernels that single jobs need, so that the machine finds them compiled."""
    from hil.bench.pieces import guard_ns
    from hil.runtime import fusednodes
    from hil.runtime.nodesetup import load_node_setups
    from hil.runtime.session import compile_kernels
    from hil.runtime.setup import Overrides, load_setup

    guard_ns(load_setup(Path(CONFIG), Overrides()).machine, 1)
    own_bus = ['bus.interface="hil-local"']
    fusednodes.load()
    nodes = load_node_setups(Path("configs/dyno.toml"), Overrides())
    for setup in (nodes or {}).values():
        compile_kernels(setup)
    for name in SHIPPED:
        path = Path(f"configs/{name}.toml")
        compile_kernels(load_setup(path, Overrides()))
        node, link, _ = make_node(path, load_toml(path, RunConfig, own_bus), [])
        node.warm_up()
        link.close()


def read_in() -> None:
    """Read every mapped file once: a page that is missing later is fetched from the host, by the host's time.

    While a process waits for it the virtual time of all others goes on, which looks like a stall of the loop.
    """
    for line in Path("/proc/self/maps").read_text().splitlines():
        words = line.split(maxsplit=5)
        if len(words) == 6 and (path := Path(words[5])).is_file() and path.stat().st_ino == int(words[4]):
            path.read_bytes()  # those of the image are in memory, and are not the host's of that name


if __name__ == "__main__":
    warm_up()
    compile_the_rest()
