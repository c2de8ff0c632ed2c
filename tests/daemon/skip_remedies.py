"""Remedies that let a skipped test run."""

from __future__ import annotations

import re

import pytest

Report = pytest.TestReport | pytest.CollectReport
# Where a package comes from that a test imports or is skipped without; all others are of the extra `dev`.
EXTRAS = {
    "pybullet": "sim",
    "pybullet_data": "sim",
    "matplotlib": "plots",
    "cv2": "cameras",
    "pyarrow": "export",
    "mcap": "export",
    "starlette": "view",
    "uvicorn": "view",
    "distributed": "fleet",
    "rosbags": "bags",
    "rerun": "rerun",
    "pinocchio": "pinocchio",
}


def with_remedy(report: Report) -> Report:
    """Let a test that is skipped for want of a package say how to install it."""
    if report.skipped and isinstance(report.longrepr, tuple):
        file, line, reason = report.longrepr
        if missing := re.search(r"could not import '(\w+)", reason):
            extra = EXTRAS.get(missing[1], "dev")
            report.longrepr = file, line, f"no {missing[1]}; to run it: pip install -e '.[{extra}]'"
    return report
