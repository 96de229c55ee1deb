#!/usr/bin/env bash
# can-utils 2020.11.0-1 (Debian, Ubuntu): log2asc -f writes an error frame as the CAN FD line of a data frame.
# Valid input: one error frame of candump -l, class 0x80 (bus error). Without -f it is written as "ErrorFrame".
# Seen: "CANFD   1 Rx         80 ... 0 0 8  8 00 00 08 ...", a data frame with identifier 080 (SYNC in CANopen).
# Fails when that changes.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT; cd "$folder"
apt-get download -q can-utils=2020.11.0-1 > /dev/null
dpkg-deb -x can-utils_*.deb .
echo '(1795758784.904425) can0 20000080#0000080000000000 R' > error.log
plain=$(usr/bin/log2asc -I error.log can0 | tail -1)
long=$(usr/bin/log2asc -f -I error.log can0 | tail -1)
printf 'log2asc:    %s\nlog2asc -f: %s\n' "$plain" "$long"
[[ $plain =~ ErrorFrame ]]
[[ ! $long =~ ErrorFrame && $long =~ CANFD\ +1\ Rx\ +80\ .*\ 8\ +8\ 00\ 00\ 08 ]]
