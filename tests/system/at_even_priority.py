"""Run `bodyschema` with all work at one priority: on a full machine, what is put last gets nothing for minutes."""

from __future__ import annotations

import sys

from bodyschema.cli.main import main
from bodyschema.daemon.learner import host, solver_process

SOLVER = "import sys; from bodyschema.daemon.learner import solver_process; "
SOLVER += "solver_process.serve(sys.stdin.buffer, sys.stdout.buffer)"

if __name__ == "__main__":
    host.NICENESS = 0
    solver_process.module_command = lambda _: [sys.executable, "-P", "-c", SOLVER]
    sys.argv[:] = ["bodyschema", *sys.argv[1:]]
    main()
