from __future__ import annotations

from collections.abc import Iterator

import pytest

from kbmaps.maps import kernels


@pytest.fixture(scope="module", params=["compiled", "numpy"])
def kernel_path(request: pytest.FixtureRequest) -> Iterator[str]:
    """Everything made in the module takes this path: once the compiled one, once NumPy's."""
    if request.param not in kernels.available():
        pytest.skip("kbmaps was installed without a C compiler, or BODYSCHEMA_PURE is set")
    with kernels.using(request.param):
        yield request.param
