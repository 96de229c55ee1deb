"""The image of the bench machine: its state after the kernel's boot and the imports of the packages.

Made once for a set of packages and kept in the cache folder; each run goes on from there. Its name is a
digest of all that is in it: another kernel, another version of a package, another command line is another
image.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
SOURCES = ("init.sh", "standby.py", "image.py", "guest/__init__.py", "guest/imported.py")
MADE_WITHIN_S = 300.0
KEPT = 3


class ImageError(RuntimeError):
    """The image can't be made; the message says where to look."""


def key(*parts: str) -> str:
    """Name for these parts, our own sources, this Python and its packages."""
    packages = sorted(
        f"{one.metadata['Name']} {one.version} {one.read_text('entry_points.txt')}"
        for one in importlib.metadata.distributions()
    )
    digest = hashlib.sha256(repr((sys.version, sys.prefix, sys.base_prefix, packages, parts)).encode())
    for name in SOURCES:
        digest.update((HERE / name).read_bytes())
    return digest.hexdigest()[:16]


def is_whole(image: Path) -> bool:
    """Whether the file is there and is what was written."""
    sign = image.with_suffix(".sha256")
    return image.is_file() and sign.is_file() and sign.read_text() == digest_of(image)


def digest_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_way(path: Path) -> Iterator[Path]:
    """A file and all that leads to it: folders, and symbolic links with what they lead to."""
    for place in [*reversed(path.parents), path]:
        yield place
        if place.is_symlink():
            yield from with_way(
                Path(os.path.normpath(place.parent / place.readlink() / path.relative_to(place)))
            )
            return


def archive(folder: Path, files: Sequence[Path], out: Path) -> None:
    """Append files of the folder to an archive that the kernel unpacks."""
    names = "".join(f"{file.relative_to(folder)}\n" for file in files)
    with out.open("ab") as target:
        command = ["cpio", "-o", "-H", "newc", "--quiet"]
        subprocess.run(command, cwd=folder, input=names.encode(), stdout=target, check=True)


def packages() -> dict[str, Any]:
    """What :mod:`tests.vm.guest.imported` prints. Raises ImageError."""
    command = [sys.executable, "-m", "tests.vm.guest.imported"]
    environment = os.environ | {"LANG": "C.UTF-8"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise ImageError(f"{' '.join(command[1:])} failed on the host: {done.stderr.strip()}")
    listed: dict[str, Any] = json.loads(done.stdout)
    return listed


def initramfs(base: Path, listed: dict[str, Any], out: Path) -> None:
    """The base's files, the Python that stands by, and the packages where they are on the host."""
    standby = base / "standby"
    standby.mkdir()
    shutil.copy(HERE / "standby.py", standby)
    (standby / "python").write_text(sys.executable + "\n")
    (standby / "imports.json").write_text(json.dumps({name: listed[name] for name in ("absent", "modules")}))
    archive(base, sorted(base.rglob("*")), out)
    root = Path("/")
    archive(root, sorted({way for file in listed["files"] for way in with_way(Path(file))} - {root}), out)


def save(command: Sequence[str], serial: Path, part: Path) -> None:
    """Boot, wait until Python stands by, write the machine's state to the file. Raises ImageError."""
    begin_s = time.monotonic()
    serial.unlink(missing_ok=True)
    with subprocess.Popen(
        [*command, "-serial", f"file:{serial}", "-qmp", "stdio"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    ) as machine:  # fmt: skip
        try:
            while "standing by" not in (serial.read_text(errors="replace") if serial.exists() else ""):
                if machine.poll() is not None or time.monotonic() - begin_s > MADE_WITHIN_S:
                    raise ImageError(f"the machine does not come to stand by; see {serial}")
                time.sleep(0.1)
            _ask(machine, "qmp_capabilities")
            _ask(machine, "migrate-set-parameters", **{"max-bandwidth": 1 << 40})
            _ask(machine, "migrate", uri=f"exec:zstd -q -1 -f -o {shlex.quote(str(part))}")
            while (status := _ask(machine, "query-migrate").get("status")) in ("setup", "active", "device"):
                time.sleep(0.05)
            if status != "completed":
                raise ImageError(f"the machine's state was not saved to {part}: {status}")
            _ask(machine, "quit")
        finally:
            machine.kill()


def restored(image: Path) -> str:
    """What QEMU goes on from."""
    return f"exec:zstd -dcq {shlex.quote(str(image))}"


def _ask(machine: subprocess.Popen[str], what: str, **arguments: Any) -> dict[str, Any]:
    """One command of QEMU's monitor; its answer. Raises ImageError."""
    assert machine.stdin is not None and machine.stdout is not None
    machine.stdin.write(json.dumps({"execute": what, "arguments": arguments}) + "\n")
    machine.stdin.flush()
    for line in machine.stdout:
        said = json.loads(line)
        if "error" in said:
            raise ImageError(f"QEMU refuses {what}: {said['error'].get('desc')}")
        if "return" in said:
            answer: dict[str, Any] = said["return"]
            return answer
    raise ImageError(f"QEMU ended at {what}")


def prune(cache: Path) -> None:
    """Keep the newest images."""
    images = sorted(cache.glob("image-*.zst"), key=lambda path: path.stat().st_mtime, reverse=True)
    for old in images[KEPT:]:
        old.unlink()
        for beside in (".sha256", ".log"):
            old.with_suffix(beside).unlink(missing_ok=True)


def made(cache: Path, name: str, fill: Callable[[Path], None], machine: Callable[[Path], list[str]]) -> Path:
    """The image of that name, made when it is not there or is not whole. Raises ImageError.

    ``fill`` puts the base into a folder; ``machine`` is the command line for a writable folder.
    """
    image = cache / f"image-{name}.zst"
    if is_whole(image):
        image.touch()
        return image
    why = "is damaged" if image.exists() else "is not there"
    print(f"machine: {image.name} {why}: making it takes half a minute", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory(dir=cache) as name_of_folder:
        folder = Path(name_of_folder)
        base, ram = folder / "base", folder / "initramfs.cpio"
        base.mkdir()
        fill(base)
        initramfs(base, packages(), ram)
        part = folder / "part"
        save([*machine(folder), "-initrd", str(ram)], image.with_suffix(".log"), part)
        image.with_suffix(".sha256").write_text(digest_of(part))
        part.rename(image)
    prune(cache)
    return image
