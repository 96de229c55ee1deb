"""The bench machine: a Debian kernel with CAN under software emulation, running this very tree.

`python -m tests.vm.machine -- COMMAND...` boots it, runs COMMAND in the tree with the same virtual
environment and brings back its exit code and output. The machine runs in virtual time (one instruction, one
nanosecond), so that timing is repeatable; can0 and can1 are two emulated Kvaser cards on one wire.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "busybox": "busybox-static",
    "cpio": "cpio",
    "modprobe": "kmod",
    "depmod": "kmod",
    "dpkg": "dpkg",
    "apt-get": "apt",
}
MODULES = ("virtio_pci", "9pnet_virtio", "9p", "kvaser_pci", "can_raw", "can_bcm", "vcan", "sch_tbf")
TIMEOUT_S = 300.0


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
    """Where kernel and initramfs are kept."""
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
    """Return (kernel, initramfs), made if they are not in the cache. Raises MachineError."""
    missing = missing_packages()
    if missing:
        raise MachineError(f"the bench machine needs Debian packages: apt-get install {' '.join(missing)}")
    cache = cache_folder()
    cache.mkdir(parents=True, exist_ok=True)
    tree = _kernel_tree(cache)
    kernel = next((tree / "boot").glob("vmlinuz-*"))
    key = hashlib.sha256((HERE / "init.sh").read_bytes() + repr(MODULES).encode() + kernel.name.encode())
    initramfs = cache / f"initramfs-{key.hexdigest()[:12]}.cpio"
    if not initramfs.is_file():
        _make_initramfs(tree, kernel.name.removeprefix("vmlinuz-"), initramfs)
    return kernel, initramfs


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


def _make_initramfs(tree: Path, release: str, target: Path) -> None:
    """busybox, the modules in loading order, and init.sh."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bin").mkdir()
        (folder / "modules").mkdir()
        shutil.copy(shutil.which("busybox") or "/bin/busybox", folder / "bin" / "busybox")
        shutil.copy(HERE / "init.sh", folder / "init")
        (folder / "init").chmod(0o755)
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
        listing = _run("find", ".", cwd=folder)
        with target.with_suffix(".part").open("wb") as out:
            subprocess.run(
                ["cpio", "-o", "-H", "newc", "--quiet"],
                cwd=folder,
                input=listing.encode(),
                stdout=out,
                check=True,
            )
        target.with_suffix(".part").rename(target)


def _job(script: str) -> str:
    """The script that the machine runs: interfaces up, own caches on its tmpfs, then the caller's script."""
    cache = kernel_cache()
    python = Path(sys.executable).parent
    return f"""\
export PATH={shlex.quote(str(python))}:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
export PYTHONPATH={shlex.quote(str(ROOT))} HOME=/dev/shm TMPDIR=/dev/shm OUT=/mnt LANG=C.UTF-8
export NUMBA_CACHE_DIR=/dev/shm/numba PYTHONDONTWRITEBYTECODE=1 OPENBLAS_NUM_THREADS=1
[ -d {shlex.quote(cache)} ] && cp -r {shlex.quote(cache)} /dev/shm/numba
echo -1 > /proc/sys/kernel/sched_rt_runtime_us
ip link set lo up
ip link add vcan0 type vcan && ip link set vcan0 mtu 72 && ip link set vcan0 up
for card in can0 can1; do
  [ -d /sys/class/net/$card ] || continue
  ip link set $card type can bitrate 1000000 restart-ms 0
  ip link set $card txqueuelen 10
  ip link set $card up
done
cd {shlex.quote(str(ROOT))}
{script}
"""


def kernel_cache() -> str:
    """Where compiled kernels are kept for the machine."""
    return os.environ.get("NUMBA_CACHE_DIR") or str(ROOT / ".cache" / "numba")


def warm_kernels() -> None:
    """Compile on the host what the machine will run: compiling there takes minutes."""
    environment = os.environ | {"NUMBA_CACHE_DIR": kernel_cache()}
    with tempfile.TemporaryDirectory() as folder:
        short = ("--set", "loop.duration_s=0.2", "--set", f'log.folder="{folder}"')
        demo = ("hil.cli", "demo", str(ROOT / "configs" / "demo.toml"), "--lockstep", "--json", *short)
        for module in (demo, ("tests.vm.guest.process",)):
            command = [sys.executable, "-m", *module]
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


def run_in_machine(script: str, *, timeout_s: float = TIMEOUT_S, out: Path | None = None) -> Result:
    """Boot, run a bash script in the tree, power off. Raises MachineError when it does not come back."""
    kernel, initramfs = prepare()
    warm_kernels()
    folder = out or Path(tempfile.mkdtemp(prefix="hil-machine-"))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "job.sh").write_text(_job(script))
    for name in ("stdout", "stderr", "code"):
        (folder / name).unlink(missing_ok=True)
    command = [
        "qemu-system-x86_64", "-nodefaults", "-no-user-config", "-display", "none", "-no-reboot",
        "-m", "2048", "-smp", "1", "-cpu", "max", "-accel", "tcg", "-icount", "shift=0,sleep=off",
        "-kernel", str(kernel), "-initrd", str(initramfs),
        "-append", "console=ttyS0 quiet panic=-1 mitigations=off preempt=full hil.bench_machine=1",
        "-serial", f"file:{folder / 'serial.log'}",
        "-virtfs", "local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap",
        "-virtfs", f"local,path={folder},mount_tag=out,security_model=none",
        "-object", "can-bus,id=c0", "-device", "kvaser_pci,canbus=c0", "-device", "kvaser_pci,canbus=c0",
    ]  # fmt: skip
    try:
        subprocess.run(command, timeout=timeout_s, check=True, capture_output=True, text=True)
    except subprocess.TimeoutExpired as error:
        raise MachineError(
            f"the machine did not end within {timeout_s:g} s; see {folder}/serial.log"
        ) from error
    except subprocess.CalledProcessError as error:
        raise MachineError(f"qemu failed: {error.stderr.strip()}") from error
    if not (folder / "code").is_file():
        raise MachineError(f"the job left no exit code; see {folder}/serial.log")
    return Result(
        int((folder / "code").read_text()),
        (folder / "stdout").read_text(errors="replace"),
        (folder / "stderr").read_text(errors="replace"),
        folder,
    )


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.vm.machine", description=__doc__)
    parser.add_argument(
        "--prepare", action="store_true", help="only fetch the kernel and build the initramfs"
    )
    parser.add_argument("--timeout", type=float, default=TIMEOUT_S, metavar="S")
    parser.add_argument("--out", type=Path, help="folder that the machine may write to (/mnt there)")
    parser.add_argument("command", nargs="*", help="command to run in the tree, after --")
    args = parser.parse_args()
    try:
        if args.prepare:
            print(*prepare())
            return 0
        result = run_in_machine(shlex.join(args.command), timeout_s=args.timeout, out=args.out)
    except MachineError as error:
        print(f"machine: {error}", file=sys.stderr)
        return 2
    sys.stdout.write(result.stdout)
    sys.stderr.write(result.stderr)
    return result.returncode


if __name__ == "__main__":
    sys.exit(main())
