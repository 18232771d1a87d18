"""The error function over arrays, compared with scipy's."""

import numpy as np
import scipy.special

from roughmap.reference.error_function import erf


def test_values_and_shape_agree_with_scipy() -> None:
    values = np.concatenate([np.linspace(-7, 7, 1401), [0.0, -0.0, np.inf, -np.inf, np.nan, 1e-300]]).reshape(7, 201)
    ours = erf(values.T)  # not contiguous
    assert ours.shape == (201, 7)
    # Both are within about one unit in the last place of the true value.
    np.testing.assert_allclose(ours, scipy.special.erf(values.T), rtol=4 * np.finfo(float).eps, atol=0)


def test_an_empty_array() -> None:
    assert erf(np.empty((0, 3))).shape == (0, 3)
