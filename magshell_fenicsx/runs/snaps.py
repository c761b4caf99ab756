"""What snaps of a run amount to, from its rows: their time, overshoot and dissipated energy."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from magshell_fenicsx.output.store.table import Row


def snaps(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The motions that begin at a fold and end at rest (`then: snap`).

    `time` is from the release until the deflection is half way, in the unit of the column time; `overshoot` the largest
    deflection beyond the last, over the way; `dissipated` the energy over E h R^2.
    """
    found = []
    for i, fold in enumerate(rows[:-1]):
        if fold["label"] != "fold" or rows[i + 1]["amplitude"] != "time":
            continue
        same = (row for row in rows[i + 1 :] if row["step"] == fold["step"])
        moving = [fold, *same]
        if moving[-1]["label"] != "target":
            continue
        t, w, lost = (np.array([float(row[key]) for row in moving]) for key in ("time", "w_over_h", "dissipated"))
        way = (w - w[0]) / (w[-1] - w[0])
        at = int(np.argmax(way >= 0.5))
        past_half = scipy.interpolate.CubicSpline(t[:-1], way[:-1] - 0.5)  # the last two rows are of one time
        half = float(scipy.optimize.brentq(past_half, t[at - 1], t[at], xtol=1e-12 * t[at])) - t[0]
        ends = {"point": fold["point"], "rest": moving[-1]["point"]}
        found.append({**ends, "time": half, "overshoot": float(way.max() - 1), "dissipated": float(lost[-1] - lost[0])})
    return found
