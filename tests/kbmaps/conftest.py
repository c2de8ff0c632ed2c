from __future__ import annotations

from collections.abc import Iterator

import pytest

from kbmaps.maps import code_path


@pytest.fixture(scope="module", params=["compiled", "numpy"])
def kernel_path(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run the module's tests on each kernel path: once the compiled one, once NumPy's."""
    if request.param not in code_path.available():
        pytest.skip("no compiled kernels; to run it: unset BODYSCHEMA_PURE, apt-get install gcc, make clean setup")
    with code_path.using(request.param):
        yield request.param
