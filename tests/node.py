"""JavaScript programs in tests: readers and viewers that others wrote for what we write.

HIL_NODE_MODULES names the node_modules folder in which the packages were installed:

    npm install @mcap/core fzstd @foxglove/ws-protocol ws
    npm install @foxglove/studio-base@1.48.0 react@17.0.2 react-dom@17.0.2
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

MISSING = "node or its packages are not there: see tests/node.py"


def node(script: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a script; the packages are looked for where HIL_NODE_MODULES says."""
    env = os.environ | {"NODE_PATH": os.environ.get("HIL_NODE_MODULES", "")}
    return subprocess.run(
        ["node", "-e", script, *words], capture_output=True, text=True, timeout=120, env=env, check=False
    )


def modules() -> Path:
    """The folder that HIL_NODE_MODULES names."""
    return Path(os.environ.get("HIL_NODE_MODULES", "node_modules"))


def has_packages(*names: str) -> bool:
    """True when node can load them; HIL_REQUIRE_NODE=1 makes it a failure that it can't."""
    try:
        missing = node("".join(f"require.resolve({name!r});" for name in names)).stderr.strip()
    except FileNotFoundError:
        missing = "there is no node"
    if missing and os.environ.get("HIL_REQUIRE_NODE") == "1":
        pytest.fail(missing)
    return not missing
