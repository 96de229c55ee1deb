"""Open a log as a pandas table: the load step in it, and how fast the estimate follows.

python examples/log_to_pandas.py [LOG]
"""

import sys
from pathlib import Path

import hil

CONFIG = Path(__file__).parents[1] / "configs" / "demo.toml"

log = hil.open_log(sys.argv[1]) if len(sys.argv) > 1 else hil.simulate(CONFIG)
table = log.to_pandas(names=True)
print(f"{len(table)} ticks, ended: {log.result['ended']}")
print(table["state"].value_counts().to_string())

load = table["T_L_true"].rolling(2).apply(lambda pair: pair.iloc[1] - pair.iloc[0])
step = load[table["request"] == "ARM"].abs().idxmax()
print(f"largest load step at {step:.3f} s: {load[step]:+.2f} {table.attrs['units']['T_L_true']}")
print(table.loc[step - 0.001 : step + 0.030, ["w_ref", "w", "i_q", "d_hat_w"]].iloc[::5].round(3).to_string())
