"""A desk somewhere on the network: wait until the learner has all pairs, then ask as a viewer and as an operator.

It looks on as the page does, too.

Usage: python desk.py ENDPOINT PAIRS. Prints one line of JSON. A program of its own, since it runs on a host of its own.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.identity import Identity, Route
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.session import client
from bodyschema.dashboard.hub import Hub
from bodyschema.dashboard.watch import ProcessFollower
from bodyschema.interfaces.errors import BodyschemaError, BusError

LIMIT_S = 400.0
KEYS = Keys("arm")


def route(endpoint: str, name: str) -> Route:
    files = (Path(f"{file}") for file in ("ca.pem", f"{name}.pem", f"{name}.key"))
    return Route((endpoint,), Identity(*(file.absolute() for file in files)))


def asked(where: Route, key: str, **request: object) -> dict[str, object]:
    try:
        with client(where) as bus:
            return json.loads(bus.ask_one(key, json.dumps(request).encode() if request else b""))
    except BodyschemaError as error:
        return {"error": str(error)}


def shown() -> dict[str, object]:
    """Return the page's data on both processes, once both are there or the time limit has passed."""
    hub = Hub()
    until = time.monotonic() + LIMIT_S
    with ProcessFollower(Config.load(Path("robot.toml"), {}), hub):
        while True:
            documents = json.loads(hub.all())
            known = {process: documents.get(process) or {} for process in ("sampler", "learner")}
            if all(each.get("answers") for each in known.values()) or time.monotonic() > until:
                return {process: each.get("answers") for process, each in known.items()}
            time.sleep(0.1)


def main(endpoint: str, pairs: str) -> None:
    viewer, operator = route(endpoint, "anna"), route(endpoint, "bert")
    until = time.monotonic() + LIMIT_S
    while asked(viewer, KEYS.status("learner")).get("pairs") != int(pairs):
        if time.monotonic() > until:
            raise BusError("the samples have not come")
        time.sleep(0.2)
    answers = {
        "predict": asked(viewer, KEYS.predict, q=[0.3, 0.1]),
        "viewer's command": asked(viewer, KEYS.command("learner"), command="pause"),
        "operator's command": asked(operator, KEYS.command("learner"), command="pause"),
        "sampler": asked(viewer, KEYS.status("sampler")),
        "page": shown(),
    }
    print(json.dumps(answers))


if __name__ == "__main__":
    main(*sys.argv[1:])
