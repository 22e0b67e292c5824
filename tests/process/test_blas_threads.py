"""One thread for matrix products, and as many as before afterwards."""

import numpy as np
import pytest

from uavkit.process.blas_threads import _switches, one_blas_thread


def test_threads_are_as_before_afterwards() -> None:
    before = [get() for get, _ in _switches()]
    with one_blas_thread():
        assert all(get() == 1 for get, _ in _switches())
        np.testing.assert_array_equal(np.eye(3) @ np.eye(3), np.eye(3))
    assert [get() for get, _ in _switches()] == before


def test_also_after_an_error() -> None:
    before = [get() for get, _ in _switches()]
    with pytest.raises(ValueError, match="wrong"), one_blas_thread():
        raise ValueError("wrong")
    assert [get() for get, _ in _switches()] == before
