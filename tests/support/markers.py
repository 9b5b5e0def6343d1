"""Files of marker tracks."""

import numpy as np

from neuma_lib.io.markers import TIME


def write_markers(path, tracks, names):
    """Write tracks in mm, as `read_markers` reads them."""
    columns = [f"{name}_{axis}_mm" for name in names for axis in "xyz"]
    values = np.column_stack([tracks.times, 1e3 * tracks.positions.reshape(len(tracks.times), -1)])
    np.savetxt(path, values, fmt="%.6g", delimiter=",", header=",".join([TIME, *columns]), comments="")
