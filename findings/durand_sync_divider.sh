#!/usr/bin/env bash
# durand 0.5.0: a TPDO of transmission type 2 (CiA 301: with every second SYNC) goes with every SYNC from the
# second on. Valid input: 1800h:2 = 2, one mapped object, ten SYNCs. Seen: 9 frames; CiA 301 asks for 5.
# Type 1 is right (10 of 10). Fails when that changes.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT; cd "$folder"
python3 -m venv v
v/bin/pip install -q durand==0.5.0 python-can==4.6.1
cat > count.py <<'PY'
import sys

from durand import MinimalNode, Variable, set_scheduler
from durand.datatypes import DatatypeEnum
from durand.scheduler import VirtualScheduler


class Wire:
    def __init__(self):
        self.calls, self.sent = {}, []

    def add_subscription(self, cob_id, callback):
        self.calls[cob_id] = callback

    def remove_subscription(self, cob_id, callback=None):
        self.calls.pop(cob_id, None)

    def send(self, cob_id, msg):
        self.sent.append(cob_id)


set_scheduler(VirtualScheduler())
wire = Wire()
node = MinimalNode(wire, 5)
node.object_dictionary[0x2000] = Variable(DatatypeEnum.UNSIGNED16, "ro", 1, name="Value")
node.tpdo[0].mapping = [(0x2000, 0)]
node.tpdo[0].transmission_type = int(sys.argv[1])
wire.calls[0](0, b"\x01\x05")
wire.sent.clear()
for _ in range(10):
    wire.calls[0x80](0x80, b"")
print(wire.sent.count(0x185))
PY
one=$(v/bin/python count.py 1); two=$(v/bin/python count.py 2)
printf 'type 1: %s of 10\ntype 2: %s of 10\n' "$one" "$two"
[[ $one == 10 && $two == 9 ]]
