"""A Dask cluster of this machine that begins without a worker and grows by its work, up to one.

``python adaptive_cluster.py``: says its scheduler's address, and ends with its standard input.
"""

from __future__ import annotations

import logging
import sys
import warnings

import distributed


def main() -> None:
    warnings.simplefilter("ignore")
    with distributed.LocalCluster(
        n_workers=0,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=None,
        silence_logs=logging.ERROR,
    ) as cluster:
        cluster.adapt(minimum=0, maximum=1)
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
