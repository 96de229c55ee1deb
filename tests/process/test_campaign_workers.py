"""Campaigns over real workers: the same rows whatever their number and losses; Ctrl-C."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import distributed
import psutil
import pytest

import hil
from hil.campaign import store, summary
from hil.campaign.engine import run_batch
from hil.campaign.figures import KEYS
from hil.campaign.identity import identity, source
from hil.campaign.onbus import CASE_S
from hil.campaign.run import dry_run, one_case
from hil.errors import HilError
from tests.conftest import CONFIGS, ROOT

pytestmark = [pytest.mark.process, pytest.mark.beside, pytest.mark.compiled]
CASES = 48
PLAN = f"""config = "{CONFIGS / "demo.toml"}"
samples = {CASES}
set = ["loop.duration_s=SECONDS"]
[random]
"plant:motor.J_kg_m2" = {{ percent = 20 }}
"""


def plan_file(folder: Path, seconds: float = 2.0) -> Path:
    path = folder / "plan.toml"
    path.write_text(PLAN.replace("SECONDS", str(seconds)), encoding="utf-8")
    return path


def text_of(folder: Path) -> str:
    held = store.open_folder(folder)
    return repr({name: held.columns(name)[name].tolist() for name in held.schema})


def started(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "hil.cli", "campaign", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)


def below(pid: int) -> list[psutil.Process]:
    """The processes below one, but for the helper that counts shared memory."""
    found = psutil.Process(pid).children(recursive=True)
    return [p for p in found if "resource_tracker" not in " ".join(p.cmdline())]


def workers(pid: int) -> list[psutil.Process]:
    """Those that were forked off the one that has imported everything."""
    return [p for p in below(pid) if p.ppid() != pid]


def until(what: str, seconds: float = 240.0) -> Iterator[None]:
    """Wait for something a busy machine may take long for."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        yield
        time.sleep(0.05)
    pytest.fail(f"never: {what}")


@pytest.mark.long
@pytest.mark.parametrize("victim", ["worker", "source"])
def test_rows_do_not_depend_on_workers_batches_and_losses(tmp_path: Path, victim: str) -> None:
    """What is killed: a worker, or what workers are forked off."""
    path = plan_file(tmp_path, 12.0)
    alone = hil.campaign(path, tmp_path / "alone", workers=0)
    assert alone.cases == CASES
    process = started(str(path), "-o", str(tmp_path / "lossy"), "--json", "-j", "2")
    for _ in until("a first part"):
        if list((tmp_path / "lossy" / "rows").glob("part-*")):
            break
        assert process.poll() is None
    worker = workers(process.pid)[0]
    (worker if victim == "worker" else worker.parent()).kill()
    out, err = process.communicate(timeout=280)
    assert process.returncode == 0, err
    assert json.loads(out)["cases"] == CASES and "Traceback" not in err
    assert text_of(tmp_path / "lossy") == text_of(tmp_path / "alone")


def test_what_is_done_is_kept_and_gone_on_with_and_workers_end(tmp_path: Path) -> None:
    path, folder = plan_file(tmp_path, 40.0), tmp_path / "out"
    process = started(str(path), "-o", str(folder), "-j", "1")
    for _ in until("a first part"):
        if list((folder / "rows").glob("part-*")):
            break
        assert process.poll() is None
    all_below = below(process.pid)
    assert len(all_below) >= 2
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert "Traceback" not in err
    assert process.returncode == 130
    for _ in until("the end of the workers"):
        if not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in all_below):
            break
    kept = int(store.open_folder(folder).done().sum())
    assert 0 < kept < CASES
    assert hil.campaign(path, folder, workers=0, resume=True).cases == CASES


def test_ctrl_c_while_everything_is_imported_is_one_line(tmp_path: Path) -> None:
    """A terminal sends it to every process of the command."""
    process = started(str(plan_file(tmp_path)), "-o", str(tmp_path / "out"), "-j", "2")
    for _ in until("what workers are forked off"):
        found = [p for p in below(process.pid) if "forkserver" in " ".join(p.cmdline())]
        if found:
            break
    for one in (*found, process):
        one.send_signal(signal.SIGINT)
    assert process.communicate(timeout=120) == ("", "hil: interrupted\n")


@pytest.mark.long
def test_a_script_that_guards_nothing_runs_once(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    arguments = f"{str(plan_file(tmp_path, 0.5))!r}, {str(tmp_path / 'out')!r}, workers=1"
    script.write_text(
        f"import hil\nprint('begins')\nprint(hil.campaign({arguments}).cases)\n", encoding="utf-8"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=240)
    assert (done.stdout, done.stderr) == (f"begins\n{CASES}\n", "")


def settled(*words: str) -> tuple[int, str, str]:
    process = started(*words)
    out, err = process.communicate(timeout=280)
    return process.returncode, out, err


@contextlib.contextmanager
def dask(*words: str, **more: Any) -> Iterator[None]:
    """A process of Dask's own command line for as long as the block runs."""
    command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:], "--no-dashboard"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **more)
    try:
        yield
    finally:
        process.terminate()
        process.wait(30)


@contextlib.contextmanager
def joined(address: str) -> Iterator[None]:
    """The block begins once a worker is there."""
    with distributed.Client(address) as client:  # type: ignore[no-untyped-call]
        client.wait_for_workers(1)
    yield


@pytest.mark.long
def test_a_worker_of_another_version_is_refused_by_name_and_an_equal_one_taken(tmp_path: Path) -> None:
    """The other one's sources differ in a comment: two states may have one version."""
    other, known = tmp_path / "other", tmp_path / "scheduler.json"
    for package in ("hil", "drivers", "firmware_model"):
        shutil.copytree(ROOT / package, other / package, ignore=shutil.ignore_patterns("__pycache__"))
    with (other / "hil/tick/guard.py").open("a") as file:
        file.write("# changed\n")
    path, env = plan_file(tmp_path), {**os.environ, "PYTHONPATH": str(other)}
    file_of = ("--scheduler-file", str(known))
    with dask("dask_scheduler", "--host", "127.0.0.1", "--port", "0", *file_of):
        for _ in until("the scheduler's address"):
            if known.exists() and known.read_text():
                break
        address = json.loads(known.read_text())["address"]
        words = (str(path), "--scheduler", address, "-o")
        worker = ("dask_worker", *file_of, "--nthreads", "1", "--host", "127.0.0.1")
        with dask(*worker, cwd=other, env=env), joined(address):
            code, out, err = settled(*words, str(tmp_path / "refused"))
        assert (code, out) == (2, "")
        told = rf"hil: worker tcp://\S+ has source \w{{12}} and not {source()}; install the same on all\n"
        assert re.fullmatch(told, err), err
        with dask(*worker, cwd=ROOT), joined(address):
            code, out, err = settled(*words, str(tmp_path / "taken"), "--json")
    assert code == 0 and json.loads(out)["cases"] == CASES, err


def test_a_worker_of_another_version_that_comes_later_runs_nothing() -> None:
    with pytest.raises(HilError, match=r"a worker has numpy .* and not 0; install the same on all"):
        run_batch(None, {**identity(), "numpy": "0"}, 0, 1)  # type: ignore[arg-type]


@pytest.mark.long
def test_a_fault_script_is_an_axis(tmp_path: Path) -> None:
    """Those cases go over the bus in lockstep; a fault that never comes leaves a simulation's figures."""
    path = tmp_path / "plan.toml"
    path.write_text(
        f"""config = "{CONFIGS / "demo.toml"}"
set = ["loop.duration_s=0.6", "reference.at_s=0.05"]
plant_set = ["load.0.at_s=0.3"]
[grid]
"plant:fault" = [
    [],
    [{{ kind = "drop", at_s = 60.0, message = "FEEDBACK" }}],
    [{{ kind = "drop", at_s = 0.4, message = "FEEDBACK" }}],
    [{{ kind = "drop", at_s = 0.4, message = "FEEDBAK" }}],
]
""",
        encoding="utf-8",
    )
    result = hil.campaign(path, tmp_path / "out", workers=2)
    simulated, never, dropped, misspelt = result.rows()
    assert simulated["ended"] == never["ended"] == "stop_requested"
    assert dropped["ended"] == "stale_feedback"
    assert dropped["why"].startswith("no fresh feedback: 61 ms, limit feedback.hold_ticks = 60 ms")
    assert misspelt["ended"] == "refused"
    assert misspelt["why"].startswith("plants/../drives/hil_pmsm.dbc: has no message FEEDBAK; it has COMMAND")
    figures = [name for name in KEYS if simulated[name] == simulated[name]]
    assert {name: never[name] for name in figures} == pytest.approx({n: simulated[n] for n in figures})
    assert len(figures) > 10
    alone = one_case(path, 2)
    assert {name: alone[name] for name in figures if alone[name] is not None} == {
        name: dropped[name] for name in figures if alone[name] is not None
    }
    assert dry_run(path, 2)["seconds"] > 4 * 0.5 * CASE_S / 2
    again = shlex.split(summary.command(result.folder, dropped))
    shown = subprocess.run(
        [sys.executable, "-m", "hil.cli", *again[1:], "--set", f'log.folder="{tmp_path}"', "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert json.loads(shown.stdout)["end"]["text"] == dropped["why"]
    assert again[1] == "demo" and summary.command(result.folder, simulated).startswith("hil simulate ")
