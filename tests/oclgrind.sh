#!/usr/bin/env bash
# The small kernel tests under Oclgrind: data races, out-of-bounds accesses, uninitialized reads.  That takes hours;
# arguments go to pytest: `tests/oclgrind.sh tests/render --one-each` takes minutes.  Oclgrind exits 0 whatever it finds, so
# its log is what counts.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}
arguments=("${@:-tests}")
log=$(mktemp)
trap 'rm -f "$log"' EXIT
export CLSPLAT_TEST_DEVICES=Oclgrind
export PYOPENCL_NO_CACHE=1  # its kernels on disk may have been built with other options

# Unoptimized: Oclgrind 21.10 does not know instructions of an optimized build (freeze, llvm.usub.sat), and reads vectors at
# index -1 where the optimizer left lanes of a shuffle open (https://github.com/jrprice/Oclgrind/issues/193).
oclgrind --data-races --uninitialized --build-options -O0 --global-mem-size 4000000000 --max-errors 20 --log "$log" \
    "$python" -m pytest "${arguments[@]}" -m "kernels and not large" -p no:cacheprovider
if [ -s "$log" ]; then
    cat "$log"
    echo "oclgrind: found something" >&2
    exit 1
fi
echo "oclgrind: clean"
