"""Attitudes by roll, pitch and yaw, as logs have them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def quaternion_of_euler(angles_rad: ArrayLike) -> NDArray[np.float64]:
    """Quaternions [..., 4] (w x y z) of roll, pitch and yaw [..., 3], turned about z, then y, then x (aerospace)."""
    half = 0.5 * np.asarray(angles_rad, np.float64)
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(half), -1, 0), np.moveaxis(np.sin(half), -1, 0)
    return np.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )
