"""The bench machine: a Debian kernel with CAN under software emulation, running this very tree.

`python -m tests.vm.machine -- COMMAND...` wakes it from its image, runs COMMAND in the tree with the same
virtual environment and brings back its exit code and output. The machine runs in virtual time (one
instruction, one nanosecond), so that timing is repeatable; can0 and can1 are two emulated Kvaser cards on one
wire.
"""

from __future__ import annotations

import argparse
import compileall
import contextlib
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from tests.vm.image import ImageError, key, made, restored

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
QEMU = "qemu-system-x86_64"
TOOLS = {
    QEMU: "qemu-system-x86",
    "busybox": "busybox-static",
    "cpio": "cpio",
    "zstd": "zstd",
    "modprobe": "kmod",
    "depmod": "kmod",
    "dpkg": "dpkg",
    "apt-get": "apt",
}
MODULES = ("virtio_pci", "9pnet_virtio", "9p", "kvaser_pci", "can_raw", "can_bcm", "vcan", "sch_tbf")
SIGN = "hil.bench_machine=1"
FAST = "mitigations=off init_on_alloc=0 hardened_usercopy=off"
STEADY = "preempt=full transparent_hugepage=madvise"
TIMEOUT_S = 300.0
PACKAGES = ("hil", "drivers", "firmware_model")
WAKE = b"\n" * 8  # a character that comes before the state is there is lost


class MachineError(RuntimeError):
    """The machine can't be made or did not come back; the message says what to do."""


@dataclass(frozen=True)
class Result:
    """What a job in the machine was; ``out`` is the folder that it could write to (/mnt there)."""

    returncode: int
    stdout: str
    stderr: str
    out: Path


def cache_folder() -> Path:
    """Where the kernel and the images are kept."""
    given = os.environ.get("HIL_MACHINE_CACHE")
    return Path(given) if given else Path.home() / ".cache" / "hil-bench-machine"


def missing_packages() -> list[str]:
    """Debian packages that have to be installed first."""
    path = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"
    return sorted({package for tool, package in TOOLS.items() if shutil.which(tool, path=path) is None})


def _run(*command: str, cwd: Path | None = None) -> str:
    try:
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300, check=True)
    except subprocess.CalledProcessError as error:
        line = (error.stderr.strip().splitlines() or ["no message"])[-1]
        raise MachineError(f"{' '.join(command[:3])} failed: {line}") from error
    return done.stdout


def prepare() -> tuple[Path, Path]:
    """Return (kernel, image), made if they are not in the cache. Raises MachineError."""
    missing = missing_packages()
    if missing:
        raise MachineError(f"the bench machine needs Debian packages: apt-get install {' '.join(missing)}")
    cache = cache_folder()
    cache.mkdir(parents=True, exist_ok=True)
    tree = _kernel_tree(cache)
    kernel = next((tree / "boot").glob("vmlinuz-*"))
    warm_kernels()
    name = key(_run(QEMU, "--version"), *_qemu(kernel, Path("out")), *MODULES)
    try:
        image = made(cache, name, lambda base: _fill(base, tree, kernel), lambda out: _qemu(kernel, out))
    except (ImageError, OSError, subprocess.SubprocessError) as error:
        raise MachineError(f"no image of the machine: {error}") from error
    return kernel, image


def _kernel_tree(cache: Path) -> Path:
    """Unpacked kernel package; downloaded once."""
    tree = cache / "kernel"
    if (tree / "complete").is_file():
        return tree
    depends = _run("apt-cache", "depends", "linux-image-amd64")
    package = next(
        (w for w in depends.split() if w.startswith("linux-image-") and w != "linux-image-amd64"), None
    )
    if package is None:
        raise MachineError("no kernel package known: run apt-get update")
    shutil.rmtree(tree, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=cache) as folder:
        Path(folder).chmod(0o755)  # apt reads it as another user
        _run("apt-get", "download", package, cwd=Path(folder))
        _run("dpkg", "-x", str(next(Path(folder).glob("*.deb"))), str(tree))
    release = next((tree / "lib" / "modules").iterdir()).name
    _run("/usr/sbin/depmod", "-b", str(tree), release)
    (tree / "complete").touch()
    return tree


def _fill(folder: Path, tree: Path, kernel: Path) -> None:
    """busybox, the modules in loading order, and init.sh."""
    (folder / "modules").mkdir()
    shutil.copy(shutil.which("busybox") or "/bin/busybox", folder / "busybox")
    shutil.copy(HERE / "init.sh", folder / "init")
    (folder / "init").chmod(0o755)
    release = kernel.name.removeprefix("vmlinuz-")
    order: list[str] = []
    for module in MODULES:
        shown = _run("/usr/sbin/modprobe", "-d", str(tree), "-S", release, "--show-depends", module)
        for line in shown.splitlines():
            if line.startswith("insmod "):
                path = Path(line.split()[1])
                if path.name not in order:
                    order.append(path.name)
                    shutil.copy(path, folder / "modules" / path.name)
    (folder / "modules" / "order").write_text("\n".join(order) + "\n")


def _qemu(kernel: Path, out: Path) -> list[str]:
    """The machine. Without erms and fsrm the kernel copies words: as bytes it is an instruction each."""
    return [
        QEMU, "-nodefaults", "-no-user-config", "-display", "none", "-no-reboot",
        "-m", "2048", "-smp", "1", "-cpu", "max,-erms,-fsrm", "-accel", "tcg", "-icount", "shift=0,sleep=off",
        "-kernel", str(kernel), "-append", f"console=ttyS0 quiet panic=-1 {FAST} {STEADY} {SIGN}",
        "-virtfs", "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap",
        "-virtfs", f"local,path={out},mount_tag=out,security_model=none",
        "-object", "can-bus,id=c0", "-device", "kvaser_pci,canbus=c0", "-device", "kvaser_pci,canbus=c0",
    ]  # fmt: skip


def _job(command: Sequence[str], kernels: Path) -> str:
    """What Python in the machine does once it is woken: interfaces up, kernels on its tmpfs, the command."""
    folders = [
        str(Path(sys.executable).parent),
        *(f"{p}/{s}" for p in ("/usr/local", "/usr", "") for s in ("sbin", "bin")),
    ]
    environment = {
        "PATH": ":".join(folders),
        "PYTHONPATH": str(ROOT),
        "HOME": "/dev/shm",
        "TMPDIR": "/dev/shm",
        "OUT": "/mnt",
        "LANG": "C.UTF-8",
        "NUMBA_CACHE_DIR": "/dev/shm/numba",
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    setup = f"""\
mkdir /dev/shm/numba && cp -rs {shlex.quote(str(kernels))}/. /dev/shm/numba
echo -1 > /proc/sys/kernel/sched_rt_runtime_us
ip link set lo up
ip link add vcan0 type vcan && ip link set vcan0 mtu 72 && ip link set vcan0 up
for card in can0 can1; do
  [ -d /sys/class/net/$card ] || continue
  ip link set $card type can bitrate 1000000 restart-ms 0
  ip link set $card txqueuelen 10
  ip link set $card up
done
"""
    job = {"now_s": time.time(), "folder": str(ROOT), "setup": setup, "command": list(command)}
    return json.dumps(job | {"environment": environment}, indent=1)


def kernels() -> Path:
    """Folder of the kernels compiled for this tree."""
    from drivers.kernelcache import cache_folder as folder_of

    return folder_of()


def take_kernels(into: Path) -> None:
    """Copy the kernels, an index before the files that it names: others may replace any meanwhile."""
    folder = kernels()
    for path in sorted(folder.rglob("*.nb?"), key=lambda path: path.suffix != ".nbi"):
        target = into / path.relative_to(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # replaced as it was found: it belongs to a later index
            shutil.copy2(path, target)


def compile_sources() -> None:
    """Leave byte code beside the sources: the machine can not write it, and would compile in each run."""
    for package in (*PACKAGES, "tests/vm"):
        compileall.compile_dir(ROOT / package, quiet=2)


def warm_kernels() -> None:
    """Compile on the host what the machine will run, once for a tree: compiling there takes minutes."""
    folder = kernels()
    digest = hashlib.sha256(repr((sys.version, version("numba"))).encode())
    sources = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    for path in [HERE / "guest" / "process.py", *sorted((ROOT / "configs").rglob("*.*")), *sources]:
        digest.update(path.read_bytes())
    stamp = folder / f"warm-{digest.hexdigest()[:16]}"
    if stamp.exists():
        return
    with tempfile.TemporaryDirectory() as logs:
        short = ("--set", "loop.duration_s=0.2", "--set", f'log.folder="{logs}"')
        demo = ("hil.cli", "demo", str(ROOT / "configs" / "demo.toml"), "--lockstep", "--json", *short)
        for module in (demo, ("tests.vm.guest.process",)):
            command = [sys.executable, "-m", *module]
            environment = os.environ | {"NUMBA_CACHE_DIR": str(folder)}
            done = subprocess.run(
                command,
                cwd=ROOT,
                env=environment,
                capture_output=True,
                text=True,
                timeout=600,
                check=False,
            )
            if done.returncode != 0:
                raise MachineError(f"{module[0]} does not run on the host: {done.stderr.strip()}")
    for old in folder.glob("warm-*"):
        old.unlink()
    stamp.touch()


def run_in_machine(
    command: Sequence[str], *, timeout_s: float = TIMEOUT_S, out: Path | None = None
) -> Result:
    """Wake the machine, run a command in the tree, power off. Raises MachineError when it does not come back.

    `python FILE` and `python -m MODULE` begin with the packages imported.
    """
    kernel, image = prepare()
    compile_sources()
    folder = out or Path(tempfile.mkdtemp(prefix="hil-machine-"))
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("stdout", "stderr", "code"):
        (folder / name).unlink(missing_ok=True)
    serial = folder / "serial.log"
    wake = [*_qemu(kernel, folder), "-serial", "stdio", "-incoming", restored(image)]
    try:
        with serial.open("wb") as log, tempfile.TemporaryDirectory(prefix="hil-kernels-") as taken:
            take_kernels(Path(taken))
            (folder / "job.json").write_text(_job(command, Path(taken)))
            subprocess.run(
                wake, input=WAKE, stdout=log, stderr=subprocess.PIPE, timeout=timeout_s, check=True
            )
    except subprocess.TimeoutExpired as error:
        raise MachineError(f"the machine did not end within {timeout_s:g} s; see {serial}") from error
    except subprocess.CalledProcessError as error:
        raise MachineError(f"qemu failed: {error.stderr.decode(errors='replace').strip()}") from error
    if not (folder / "code").is_file():
        raise MachineError(f"the job left no exit code; see {serial}")
    return Result(
        int((folder / "code").read_text()),
        (folder / "stdout").read_text(errors="replace"),
        (folder / "stderr").read_text(errors="replace"),
        folder,
    )


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.vm.machine", description=__doc__)
    parser.add_argument("--prepare", action="store_true", help="only fetch the kernel and make the image")
    parser.add_argument("--timeout", type=float, default=TIMEOUT_S, metavar="S")
    parser.add_argument("--out", type=Path, help="folder that the machine may write to (/mnt there)")
    parser.add_argument("command", nargs="*", help="command to run in the tree, after --")
    args = parser.parse_args()
    try:
        if args.prepare:
            print(*prepare())
            return 0
        result = run_in_machine(args.command, timeout_s=args.timeout, out=args.out)
    except MachineError as error:
        print(f"machine: {error}", file=sys.stderr)
        return 2
    sys.stdout.write(result.stdout)
    sys.stderr.write(result.stderr)
    return result.returncode


if __name__ == "__main__":
    sys.exit(main())
