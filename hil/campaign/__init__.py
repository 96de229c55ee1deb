"""Campaigns: the same run over many cases, on one machine or a cluster.

``hil.campaign(plan, folder)`` is the package itself, called: a room cannot have the name of a function
otherwise.
"""

from __future__ import annotations

import sys
import types
from typing import Any


class _Room(types.ModuleType):
    """This package, which can be called."""

    def __call__(self, plan: Any, folder: Any, **options: Any) -> Any:
        """:func:`hil.campaign.run.campaign`."""
        from hil.campaign.run import campaign

        return campaign(plan, folder, **options)


sys.modules[__name__].__class__ = _Room
