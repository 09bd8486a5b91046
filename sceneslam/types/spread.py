"""The deviation of errors, some of which are gross."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_PER_MEDIAN = 1.4826  # a normal error's standard deviation, over the median of its magnitude


def spread(errors: NDArray[np.number]) -> float:
    """Return the standard deviation of errors (N,) around 0, less than half of them gross ones.

    It is that of normal errors with the same median magnitude (Rousseeuw and Croux, JASA 1993).
    """
    return _PER_MEDIAN * float(np.median(np.abs(errors)))
