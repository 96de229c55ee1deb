"""The paper's own law for a bench whose load machine is commanded too: u = [T_L, u_q, u_d]."""

from __future__ import annotations

from hil.control.laws import cascade
from hil.control.registry import Law

MEMBER = Law("fac", "the paper's fully actuated law, load torque commanded", 1, cascade.design, cascade.KEYS)
