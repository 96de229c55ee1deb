"""The kept logs, their checksums, and those that are known to replay otherwise, each with its reason."""

from __future__ import annotations

import hashlib
import tomllib
from pathlib import Path
from typing import Any

from hil.replay import Verdict, replay

LOGS = Path(__file__).parent / "logs"
SUMS, SIGNED = LOGS / "SHA256SUMS", LOGS / "signed.toml"
GROUPED = ("split",)
"""Runs in several files, by the beginning of their names."""


def runs() -> dict[str, tuple[Path, ...]]:
    """Every kept run by its name, generation/name, with its files in order."""
    found: dict[str, tuple[Path, ...]] = {}
    for path in sorted(LOGS.glob("*/*.mcap")):
        stem = path.name.split(".")[0]
        name = f"{path.parent.name}/{stem if stem in GROUPED else path.stem}"
        found[name] = (*found.get(name, ()), path)
    return found


def signed() -> dict[str, dict[str, Any]]:
    """What each signed run replays as, and why."""
    rows: dict[str, dict[str, Any]] = tomllib.loads(SIGNED.read_text(encoding="utf-8")).get("run", {})
    return rows


def sums() -> dict[str, str]:
    """SHA-256 of each kept file as it is now; `sha256sum -c` reads the same."""
    files = sorted([*LOGS.glob("*/*.mcap"), SIGNED])
    return {str(path.relative_to(LOGS)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def written_sums() -> dict[str, str]:
    """The checksums that were written down."""
    lines = SUMS.read_text(encoding="utf-8").splitlines()
    return {name: digest for digest, name in (line.split("  ", 1) for line in lines)}


def write_sums() -> None:
    """Write the checksums down."""
    SUMS.write_text("".join(f"{digest}  {name}\n" for name, digest in sums().items()), encoding="utf-8")


def found(paths: tuple[Path, ...]) -> tuple[Verdict, dict[str, Any]]:
    """The verdict on a run, and what of it a signature holds."""
    verdict = replay(paths)
    first = verdict.first_difference
    row: dict[str, Any] = {"verdict": verdict.verdict}
    row |= {"tick": first.tick, "field": first.field} if first else {}
    return verdict, row | ({"why": verdict.why} if verdict.why and verdict.verdict == "cannot" else {})
