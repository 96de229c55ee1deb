"""A kept kernel is run again only while nothing that it is made of has changed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from drivers import kernelcache
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

CALLEE = """from drivers.jit import jit
from hil.factor import (  # the caller's kernel is made of these, too
    FACTOR,
)


@jit
def times(x: float) -> float:
    return FACTOR * x
"""
CALLER = """import sys

import numpy as np

from drivers.jit import jit
from hil import callee


times = callee.times


@jit
def plus(x: float) -> float:
    return 1.0 + times(x)


@jit
def room(n: int) -> float:
    return np.zeros(n).sum()


try:
    print(room(2), room(-1))
except ValueError as error:
    said = error.args[0].split()[0]
compiler = {"numba.cpython.mathimpl", "numba.np.arrayobj"} & set(sys.modules)
print(plus(3.0), sum(plus.stats.cache_hits.values()), said, len(compiler))
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A small project with the cache of ours, in the layout of ours."""
    (tmp_path / "drivers").mkdir()
    (tmp_path / "hil").mkdir()
    for name in ("__init__", "jit", "kernelcache"):
        shutil.copy(ROOT / "drivers" / f"{name}.py", tmp_path / "drivers")
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / "hil" / "factor.py").write_text("FACTOR = 2.0\n")
    (tmp_path / "hil" / "callee.py").write_text(CALLEE)
    (tmp_path / "hil" / "caller.py").write_text(CALLER)
    (tmp_path / "hil" / "other.py").write_text("")
    return tmp_path


def run(tree: Path, **environment: str) -> str:
    """What the caller prints.

    Its result, 1 when its kernel was a kept one, what a function of numba's own in a kernel raises, and how
    much is loaded of what only compiling needs.
    """
    inherited = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-m", "hil.caller"],
        cwd=tree,
        env=inherited | {"PYTHONPATH": str(tree)} | environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return done.stdout.strip()


@pytest.mark.long
@pytest.mark.compiled
def test_a_change_compiles_what_depends_on_it_alone(tree: Path) -> None:
    assert run(tree) == "7.0 0 negative 2"
    assert run(tree) == "7.0 1 negative 0"
    (tree / "hil" / "other.py").write_text("unrelated = 1\n")
    assert run(tree) == "7.0 1 negative 0"
    (tree / "hil" / "factor.py").write_text("FACTOR = 5.0\n")
    assert run(tree) == "16.0 0 negative 2"
    files = sorted(path.name for path in (tree / ".cache" / "numba").rglob("*.nb*"))
    (tree / "hil" / "caller.py").write_text(
        "\n\n" + CALLER
    )  # a kernel on another line takes the old one's files
    assert run(tree) == "16.0 0 negative 2"
    assert sorted(path.name for path in (tree / ".cache" / "numba").rglob("*.nb*")) == files


@pytest.mark.compiled
def test_an_installed_package_keeps_kernels_in_the_users_folder(tree: Path) -> None:
    (tree / "pyproject.toml").unlink()
    assert run(tree, XDG_CACHE_HOME=str(tree / "home")) == "7.0 0 negative 2"
    assert list((tree / "home" / "hil-drive" / "numba").rglob("*.nbi"))
    assert not (tree / ".cache").exists()


@pytest.mark.parametrize("left", [False, True], ids=["new", "out of date"])
def test_two_processes_that_save_at_once_keep_both_kernels(
    tmp_path: Path, left: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One comes when the other has read the index; what an older source left is never found."""
    if left:
        kernelcache.KernelFiles(str(tmp_path), "kernel", "before").save("a", "an old one")
    one, other = (kernelcache.KernelFiles(str(tmp_path), "kernel", "now") for _ in range(2))
    second = threading.Thread(target=other.save, args=("b", "of b"))
    index, data = one._load_index, one._save_data

    def read() -> Any:
        found = index()
        second.start()
        second.join(0.3)  # it waits for the first one; else it would be done by then
        return found

    def write(name: str, kernel: str) -> None:
        assert other.load("a") is None, "named before it is there"
        data(name, kernel)

    monkeypatch.setattr(one, "_load_index", read)
    monkeypatch.setattr(one, "_save_data", write)
    one.save("a", "of a")
    second.join()
    assert [other.load(key) for key in "abc"] == ["of a", "of b", None]
    assert len(list(tmp_path.iterdir())) == 3


def test_each_file_that_a_kernel_takes_names_from_is_found() -> None:
    found = {str(path.relative_to(ROOT)) for path in kernelcache.sources(ROOT / "hil/tick/kernel.py")}
    wanted = {f"hil/tick/{name}.py" for name in ("kernel", "guard", "supervisor")}
    wanted |= {"hil/signals.py", "hil/control/law.py"}
    assert wanted | {"drivers/jit.py", "hil/control/observer.py"} <= found
    assert not any(name.startswith(("hil/report", "hil/commands", "firmware_model")) for name in found)
