"""The deviation of errors, some of which are gross."""

import numpy as np
import pytest

from sceneslam.types.spread import spread


def test_gross_errors_do_not_widen_the_spread():
    errors = np.random.default_rng(0).normal(0.0, 2.0, 20_000)
    assert spread(errors) == pytest.approx(2.0, rel=0.03)
    errors[:2000] = 1e6
    assert spread(errors) == pytest.approx(2.0, rel=0.2)
    assert spread(np.array([-3, 1, 2])) == pytest.approx(2 * 1.4826)
