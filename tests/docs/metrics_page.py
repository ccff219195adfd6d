"""docs/metrics.md, made of the table of metrics: ``python -m tests.docs.metrics_page > docs/metrics.md``."""

from __future__ import annotations

import sys
from textwrap import fill

from handfast.deploy.analysis.presence import GAP_S, PERIODS
from handfast.deploy.verdict.metrics import METRICS, Metric
from handfast.deploy.verdict.missing import SHARE_MAX
from handfast.deploy.verdict.oracles_drive import SPEED_MORE_MPS, SPEED_SHARE

HEAD = """# Metrics

<!-- Made of the table in deploy/verdict/metrics.py: change it there, then `make docs`. -->

What `metrics.json` in a run's folder holds, in its order. `a.b` is `b` within `a`; null is what is not known.
Those with a name in brackets are in the report's table. *Sweeps* name the column of `results.csv`; the
[summary](sweep.md#what-it-leaves) has quantiles of those that are *summarised*, pictures of those that are
*drawn*. The same recording gives the same bytes.

"""

TAIL = f"""
## Where poses are missing

Between two poses of a robot that are up to {GAP_S:g} s apart (or {PERIODS:g} periods of a slow body) it is
taken to have gone straight on. What is longer is a **gap**: where the robot was meanwhile is not known.

- **Distances** in a gap are not known. They are no violation, and in no least distance and no error; figures
  have a hole there.
- **Settling**: an edge that was off its distance before a gap, or is after it, was off all the while, and so
  was a robot that was off its place. What was right at both ends counts as right.
- **What can have happened**: from the pose before to the pose after, a hand went no faster than the verdict
  lets it ({SPEED_SHARE:g} times `control.max_speed_mps`, and {SPEED_MORE_MPS:g} m/s), or than it was measured
  in the drive. So it was within a disc around each of these poses. If it can nowhere have come nearer to
  another robot than the safe distance, to an obstacle than the clearance, or further outside the geofence
  than braking takes, the gap is a warning. Else the verdict fails: `it may have come within 0.31 m of robot 2
  (0.66 m is safe)`.
- A gap fails the verdict, too, if the robot moved further in it than it can; if it lasts to the end of the
  drive; and if the gaps of a robot are more than {100 * SHARE_MAX:.0f} % of the drive.
- Only warnings: a gap of a plant that a rule stopped, unless it lasts to the end; of a robot that was killed
  for good; of one that has no place in the formation; and, where the robot moved less than the safe distance
  meanwhile, one of a machine that was too slow, or of which nothing came of any robot.
- A part of a **damaged file** that is lost is such a gap, with the file as its cause. A file that ends in
  mid-drive fails the verdict.

## Robots that stop following

A robot in state released to the end of the drive is a warning where its operator took it. Where the bridge
let go of a vehicle that does not follow its commands, or was not heard for long, the verdict fails with its
reason. Recordings tell the two apart by the bridge's words alone. A vehicle's own failsafe that changes its
mode (battery, remote control, fence) says the same as its operator, and is a warning; one of its EKF or GPS
is a fault before that, and its robot, which does not drive on by itself, fails the verdict.
"""


def render() -> str:
    items = "".join(f"{fill(_item(metric), 110, subsequent_indent='  ')}\n" for metric in METRICS)
    return HEAD + items + TAIL


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
