"""Shared fixtures: shipped configurations, unique bus channels, logs in a temporary folder."""

from __future__ import annotations

import uuid
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ROOT / "configs"


@pytest.fixture
def configs() -> Path:
    return CONFIGS


@pytest.fixture
def channel() -> str:
    """A bus of its own for each test."""
    return f"test-{uuid.uuid4().hex[:12]}"


@pytest.fixture
def settings(channel: str, tmp_path: Path) -> Callable[..., tuple[str, ...]]:
    """Overrides that keep a test to itself: own channel, own log folder, no real-time rights needed."""

    def make(*more: str) -> tuple[str, ...]:
        return (
            f'bus.channel="{channel}"',
            f'log.folder="{tmp_path / "logs"}"',
            "realtime.lock_memory=false",
            *more,
        )

    return make
