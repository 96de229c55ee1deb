#!/usr/bin/env bash
# python-can 4.6.1: CanutilsLogReader knows an error frame of candump -l by bit 0x80 of its class alone.
# Valid input: a controller error (class 0x004) and a bus error (class 0x088) as candump -l writes them.
# Seen: the first is a data frame with the extended identifier 4, which can.player sends; the second is an error
# frame without its class, data, channel and direction. Fails when that changes.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT; cd "$folder"
python3 -m venv env
env/bin/pip install -q python-can==4.6.1
printf '%s\n' '(1795758784.904425) can0 20000004#0030000000008888 T' \
              '(1795758784.904625) can0 20000088#0000080000000000 T' > errors.log
env/bin/python - <<'PYTHON'
import can

controller, bus = can.CanutilsLogReader("errors.log")
for message in (controller, bus):
    print(message)
assert not controller.is_error_frame and controller.is_extended_id and controller.arbitration_id == 4
assert bus.is_error_frame and bus.arbitration_id == 0 and bus.dlc == 0 and bus.channel is None and bus.is_rx
PYTHON
