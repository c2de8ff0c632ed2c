"""Too few file descriptors: reported at the start, survived later."""

from __future__ import annotations

import errno
import os
import resource
import sys

import pytest
from guided_arm import nominal_model

from bodyschema.cli import main as cli
from bodyschema.cli.main import allow_enough_files
from bodyschema.daemon.learner.solver_process import SolverLostError, SolverProcess
from bodyschema.interfaces.errors import ConfigError
from bodyschema.learning.solvers.solver import Task
from kbmaps import ChainTolerances

NOMINAL = nominal_model()


@pytest.mark.parametrize(
    ("soft", "hard", "then"),
    [
        (256, 4096, 1024),
        (256, resource.RLIM_INFINITY, 1024),
        (64, 500, 500),
        (1024, 524288, None),
        (8192, 524288, None),
        (resource.RLIM_INFINITY, resource.RLIM_INFINITY, None),
    ],
)
def test_descriptor_limit_is_raised_within_hard_limit(
    monkeypatch: pytest.MonkeyPatch, soft: int, hard: int, then: int | None
) -> None:
    raised: list[object] = []
    monkeypatch.setattr(resource, "getrlimit", lambda _: (soft, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: raised.append(limits))
    allow_enough_files()
    assert raised == ([] if then is None else [(then, hard)])


def test_too_low_descriptor_limit_error_names_ulimit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (20, 20))
    with pytest.raises(ConfigError, match=r"may open 20 files and needs 64. `ulimit -n 1024` in the shell"):
        allow_enough_files()


def test_a_command_that_gets_none_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def no_more(_: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(cli, "command_line", lambda _: no_more)
    monkeypatch.setattr(sys, "argv", ["bodyschema", "status"])
    with pytest.raises(SystemExit):
        cli.main()
    assert capsys.readouterr().err.startswith("bodyschema: too many files and connections are open. `ulimit -n 1024`")


def test_a_solver_that_cannot_start_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_more(*_: object, **__: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr("bodyschema.daemon.learner.solver_process.subprocess.Popen", no_more)
    with SolverProcess() as solver, pytest.raises(SolverLostError, match="cannot be started: Too many open files"):
        solver.start(Task(1, NOMINAL.prior, NOMINAL.belief(NOMINAL.chain, ChainTolerances())))
