"""The mountings of a joined calibration as a person reads them."""

from collections.abc import Sequence

import numpy as np
from rich.markup import escape

from estimator.estimation.mountings.join import MountingFound
from station.render.terminal import print_all, rich_table, stdout
from station.views.figures import StateUnit

_TURN = StateUnit("turn", "urad", 1e6, 0, 7)


def print_mountings(mountings: Sequence[MountingFound]) -> None:
    """Print by how much the device was turned in each recording, against how its mounting is stated.

    The angles are about x, y and z, in µrad, each with its standard deviation.
    """
    figure = _TURN.fitted(np.concatenate([one.sd_rad for one in mountings]).tolist())
    heads = ["\nrecording"]
    for axis in "xyz":
        heads += [f"about {axis}\n{figure.unit}", "±"]
    rows = []
    for one in mountings:
        cells = [escape(one.recording)]
        for value, sd in zip(one.error_rad.tolist(), one.sd_rad.tolist(), strict=True):
            cells += [figure.text(value), figure.text(sd)]
        rows.append(cells)
    table = rich_table("Mounting errors, from the frame of the gyros to the stated mounting", heads, "lr", rows)
    print_all(stdout(), [(table, {})])
