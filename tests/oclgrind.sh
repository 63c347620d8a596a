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

check() {  # names of tests, as pytest's -k has them; options of Oclgrind
    local tests=$1
    shift
    echo "oclgrind $*: ${tests:-all}"
    oclgrind "$@" --global-mem-size 4000000000 --max-errors 20 --log "$log" \
        "$python" -m pytest "${arguments[@]}" -m "kernels and not large" -k "$tests" -p no:cacheprovider
    if [ -s "$log" ]; then
        cat "$log"
        echo "oclgrind $*: found something" >&2
        exit 1
    fi
}

check "simt and not schedules" --data-races --uninitialized
# Oclgrind 21.10 reads vectors at index -1, so that it crashes or computes other values, where the optimiser left lanes of a
# shuffle open (https://github.com/jrprice/Oclgrind/issues/193): what may run the wide schedule is checked unoptimized.
check "not simt or schedules" --data-races --uninitialized --build-options -O0
echo "oclgrind: clean"
