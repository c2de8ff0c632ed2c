"""Follow a sampler's pairs and miss none. Needs eclipse-zenoh and nothing of bodyschema.

Usage: python follow_pairs.py ROBOT ENDPOINT [FIRST [LAST]]

ROBOT and ENDPOINT are `name` in the table [robot] and `sampler` in the table [zenoh] of robot.toml; FIRST and LAST are
sequence numbers. Without LAST it goes on until Ctrl-C.
"""

from __future__ import annotations

import json
import queue
import sys
from collections.abc import Iterator

import zenoh

SILENCE_S = 2.0


def session_to(endpoint: str) -> zenoh.Session:
    """Open a client session to one endpoint, without scouting for others."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def stored(session: zenoh.Session, prefix: str, first: int) -> dict:
    """Return stored pairs from number `first` on, as many as fit into a reply."""
    for reply in session.get(f"{prefix}/pairs?from={first}", timeout=5.0):
        if reply.ok is not None:
            return json.loads(reply.ok.payload.to_bytes())
        if reply.err is not None:
            raise RuntimeError(reply.err.payload.to_string())
    raise RuntimeError(f"nothing answers under {prefix}/pairs")


def follow(session: zenoh.Session, prefix: str, first: int) -> Iterator[dict]:
    """Yield every pair of one store from `first` on, once and in order, without end."""
    heard: queue.SimpleQueue[dict] = queue.SimpleQueue()
    # Subscribed before history is asked: what comes meanwhile comes both ways, and is taken once.
    subscriber = session.declare_subscriber(
        f"{prefix}/pair", lambda sample: heard.put(json.loads(sample.payload.to_bytes()))
    )
    store, last = None, first - 1
    while True:
        page = stored(session, prefix, last + 1)
        store = store or page["store"]
        if page["store"] != store:
            subscriber.undeclare()
            raise RuntimeError(f"the samples of store {store} have ended; those of {page['store']} begin at 1")
        for pair in page["pairs"]:
            last = pair["seq"]
            yield pair
        while last >= page["last_seq"]:
            try:
                pair = heard.get(timeout=SILENCE_S)
            except queue.Empty:
                break  # perhaps the newest was lost: ask
            if pair["store"] != store or pair["seq"] > last + 1:
                break  # a gap, or another store: ask
            if pair["seq"] == last + 1:
                last = pair["seq"]
                yield pair


def main(robot: str, endpoint: str, first: str = "1", last: str = "") -> None:
    with session_to(endpoint) as session:  # a session that is not closed keeps Python from exiting
        for pair in follow(session, f"bodyschema/{robot}", int(first)):
            print(pair["seq"], pair["q"], pair["x"], flush=True)
            if last and pair["seq"] >= int(last):
                return


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (RuntimeError, zenoh.ZError) as error:
        sys.exit(f"follow_pairs: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
