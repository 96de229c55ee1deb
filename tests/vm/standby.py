"""The Python of the bench machine: imports the packages, stands by, and once woken becomes the job.

Its state while it stands by is the image. Until then no file of the host is open, so that the state can be
saved; the tree's own code is read after that, so that an image holds nothing of it.
"""

import ctypes
import importlib
import json
import os
import runpy
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

HOST, JOB = "/host", Path("/mnt/job.json")
NINEP = "trans=virtio,version=9p2000.L,msize=524288,cache=loose"
READ_ONLY = 1
MOUNTS = (  # source, folder of the host, type, flags, options
    ("host", "", "9p", READ_ONLY, NINEP),
    ("proc", "/proc", "proc", 0, ""),
    ("sys", "/sys", "sysfs", 0, ""),
    ("dev", "/dev", "devtmpfs", 0, ""),
    ("shm", "/dev/shm", "tmpfs", 0, "mode=1777"),
    ("pts", "/dev/pts", "devpts", 0, ""),
    ("out", "/mnt", "9p", 0, NINEP),
)


def stand_by() -> None:
    """Import what the list says; return once the host wakes us with a line."""
    listed = json.loads(Path("/standby/imports.json").read_text())
    sys.modules.update(dict.fromkeys(listed["absent"]))
    for name in listed["modules"]:
        importlib.import_module(name)
    with Path("/dev/ttyS0").open() as serial:
        print("standing by", flush=True)
        serial.readline()


def enter_host() -> None:
    """The host's root, with the machine's own devices, becomes the root. Raises OSError."""
    libc = ctypes.CDLL(None, use_errno=True)
    for source, folder, kind, flags, options in MOUNTS:
        if folder in ("/dev/shm", "/dev/pts"):
            Path(HOST + folder).mkdir(exist_ok=True)
        words = (source.encode(), (HOST + folder).encode(), kind.encode(), flags, options.encode())
        if libc.mount(*words) != 0:
            raise OSError(ctypes.get_errno(), f"mounting {source}", folder)
    os.chroot(HOST)
    sys.path_importer_cache.clear()


def redirect() -> None:
    """Nothing to read; what is printed goes to files on the machine's tmpfs."""
    for target, name in enumerate(("/dev/null", "/dev/shm/job.stdout", "/dev/shm/job.stderr")):
        source = os.open(name, os.O_RDWR | os.O_CREAT, 0o600)
        os.dup2(source, target)
        os.close(source)


def become(command: Sequence[str]) -> None:
    """`python FILE` and `python -m MODULE` go on in this process, all else takes its place."""
    program, *words = command
    if program != "python" or not words or (words[0].startswith("-") and words[0] != "-m"):
        os.execvp(program, list(command))
    sys.path[1:1] = os.environ["PYTHONPATH"].split(":")
    if words[0] == "-m":
        sys.path[0], sys.argv = str(Path.cwd()), words[1:]
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    else:
        sys.path[0], sys.argv = str(Path(words[0]).resolve().parent), words
        runpy.run_path(words[0], run_name="__main__")


def main() -> None:
    stand_by()
    enter_host()
    redirect()
    job = json.loads(JOB.read_text())
    time.clock_settime(time.CLOCK_REALTIME, job["now_s"])
    os.environ.clear()
    os.environ.update(job["environment"])
    os.chdir(job["folder"])
    subprocess.run(["/bin/bash", "-c", job["setup"]], check=False)
    become(job["command"])


if __name__ == "__main__":
    main()
