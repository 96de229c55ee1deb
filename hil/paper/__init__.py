"""The paper, recomputed."""
