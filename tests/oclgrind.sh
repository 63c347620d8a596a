#!/usr/bin/env bash
# The small kernel tests under Oclgrind: data races, out-of-bounds accesses, uninitialised reads.
# Oclgrind exits 0 whatever it finds, so its log is what counts.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}
log=$(mktemp)
for check in --data-races --uninitialized; do
    : > "$log"
    CLSPLAT_TEST_DEVICES=Oclgrind oclgrind "$check" --max-errors 20 --log "$log" \
        "$python" -m pytest tests/kernels -m "not large" -p no:cacheprovider "$@"
    if [ -s "$log" ]; then
        cat "$log"
        echo "oclgrind $check: found something" >&2
        exit 1
    fi
done
echo "oclgrind: clean"
