"""`hil paper`: everything that the paper prints and draws, computed again, with a verdict on each item."""

from __future__ import annotations

from hil.paper.result import PaperResult, run

__all__ = ["PaperResult", "run"]
