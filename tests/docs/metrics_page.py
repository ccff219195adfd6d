"""docs/metrics.md, made of the table of metrics: ``python -m tests.docs.metrics_page > docs/metrics.md``."""

from __future__ import annotations

import sys
from textwrap import fill

from deploy.verdict.metrics import METRICS, Metric

HEAD = """# Metrics

<!-- Made of the table in deploy/verdict/metrics.py: change it there, then `make docs`. -->

What `metrics.json` in a run's folder holds, in its order. `a.b` is `b` within `a`; null is what is not known.
Those with a name in brackets are in the report's table. *Sweeps* name the column of `results.csv`; the
[summary](sweep.md#what-it-leaves) has quantiles of those that are *summarised*, pictures of those that are
*drawn*. The same recording gives the same bytes.

"""


def render() -> str:
    return HEAD + "".join(f"{fill(_item(metric), 110, subsequent_indent='  ')}\n" for metric in METRICS)


def _item(metric: Metric) -> str:
    about = [each for each in (metric.title, metric.unit) if each]
    text = f"- `{metric.name}`" + (f" ({', '.join(about)})" if about else "") + f": {metric.meaning}"
    column = metric.column
    if column is None:
        return text
    text += f" Sweeps: `{column.name or metric.name}`"
    text += ", summarised" * column.summarised + ", drawn" * (column.picture is not None)
    return text + "."


if __name__ == "__main__":
    sys.stdout.write(render())
