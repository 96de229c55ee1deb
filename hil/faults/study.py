"""All rows of a matrix, some side by side, in the order of the file."""

from __future__ import annotations

import multiprocessing
import re
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from hil.faults.case import check_rows, run_row
from hil.faults.judge import Result
from hil.faults.matrix import Matrix, Row
from hil.runtime.session import compile_kernels
from hil.sim.emulate import warm_up

_fork = multiprocessing.get_context("fork")


def folder_name(name: str) -> str:
    """A row's name as a folder's."""
    return re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")


def _child(pipe: Connection, path: Path, matrix: Matrix, row: Row, folder: Path) -> None:
    pipe.send(run_row(path, matrix, row, folder))
    pipe.close()


def study(
    path: Path, matrix: Matrix, rows: list[Row], folder: Path, jobs: int, done: Callable[[Result], None]
) -> list[Result]:
    """Run rows; those in real time one after the other once the machine is free of the others."""
    setups = check_rows(path, matrix, rows).values()
    for setup in setups:
        setup.machine.warm_up()
        compile_kernels(setup)  # here once: a row's own time is no time to compile in
    warm_up(path, *(setup.config for setup in setups))
    results: dict[str, Result] = {}
    for realtime, side_by_side in ((False, jobs), (True, 1)):
        part = [row for row in rows if row.realtime == realtime]
        _run_part(path, matrix, part, folder, side_by_side, results, done)
    return [results[row.name] for row in rows]


def _run_part(
    path: Path,
    matrix: Matrix,
    rows: list[Row],
    folder: Path,
    jobs: int,
    results: dict[str, Result],
    done: Callable[[Result], None],
) -> None:
    waiting, running = list(rows), dict[Any, tuple[Row, Any]]()
    while waiting or running:
        while waiting and len(running) < jobs:
            row = waiting.pop(0)
            mine, theirs = _fork.Pipe(duplex=False)
            args = (theirs, path, matrix, row, folder / folder_name(row.name))
            process = _fork.Process(target=_child, args=args)
            process.start()
            theirs.close()
            running[mine] = (row, process)
        for pipe in wait(list(running)):
            row, process = running.pop(pipe)
            results[row.name] = _received(pipe, row)
            process.join()
            done(results[row.name])


def _received(pipe: Any, row: Row) -> Result:
    try:
        result: Result = pipe.recv()
    except EOFError:
        result = Result(row.name, row.expect.text, why=["the row's process died"])
    pipe.close()
    return result
