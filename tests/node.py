"""JavaScript programs in tests: readers and viewers that others wrote for what we write.

`make node` installs them into .cache/node; HIL_NODE_MODULES names another node_modules folder. Tests that
need them are skipped without, and fail with HIL_REQUIRE_NODE=1.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

MISSING = "node or its packages are not there: make node"
INSTALLED = Path(__file__).parents[1] / ".cache" / "node" / "node_modules"


def node(script: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a script that finds the packages."""
    env = os.environ | {"NODE_PATH": str(modules())}
    return subprocess.run(
        ["node", "-e", script, *words], capture_output=True, text=True, timeout=120, env=env, check=False
    )


def modules() -> Path:
    """The folder with the packages."""
    return Path(os.environ.get("HIL_NODE_MODULES", INSTALLED))


def has_packages(*names: str) -> bool:
    """True when node can load them; HIL_REQUIRE_NODE=1 makes it a failure that it can't."""
    try:
        missing = node("".join(f"require.resolve({name!r});" for name in names)).stderr.strip()
    except FileNotFoundError:
        missing = "there is no node"
    if missing and os.environ.get("HIL_REQUIRE_NODE") == "1":
        pytest.fail(missing)
    return not missing
