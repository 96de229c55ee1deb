"""The floor: the same three frames on the same sockets, nothing computed. The loop is :mod:`drivers.bare`.

    python -m benchmarks.bare_loop hil-local CHANNEL configs/drives/hil_pmsm.dbc --rate 1000
    python -m benchmarks.bare_loop socketcan vcan0 configs/drives/hil_pmsm.dbc --rate 1000

It needs `hil emulate` on that bus, which answers.
"""

from drivers.bare import main

if __name__ == "__main__":
    main()
