"""The worker of a job of SLURM, with the arguments that dask-jobqueue gives."""

import argparse
import logging
import sys
from collections.abc import Sequence

from clsplat.cluster.offer import offer
from clsplat.errors import ClsplatError
from clsplat.pipeline.execution import options


def main(words: Sequence[str]) -> int:
    """Offer the device of this job, the one that a run would choose; return the exit code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("scheduler")
    for option in ("name", "interface", "tls-ca-file", "tls-cert", "tls-key", "local-directory"):
        parser.add_argument(f"--{option}")
    given, _ = parser.parse_known_args(words)  # the others are of Dask's own worker
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    files = (given.tls_ca_file, given.tls_cert, given.tls_key)
    tls = dict(zip(("ca", "cert", "key"), files, strict=True)) if all(files) else None
    engine = given.scheduler.replace("tcp://", "dask://")
    own = {"name": given.name, "interface": given.interface, "local_directory": given.local_directory}
    try:
        execution = options({"engine": engine, "tls": tls, "insecure": tls is None})
        offer(execution, [""], **{key: value for key, value in own.items() if value})
    except ClsplatError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
