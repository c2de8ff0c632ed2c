"""Ask a running learner where the marker is. Needs eclipse-zenoh and nothing of bodyschema.

Usage: python ask_predictions.py ROBOT ENDPOINT ANGLE...

ROBOT and ENDPOINT are `name` in the table [robot] and `learner` in the table [zenoh] of robot.toml; an ANGLE for each
joint there, in rad (in m for one that slides). For example, while `bodyschema run --sim` is running:

    python ask_predictions.py upper_body tcp/127.0.0.1:7448 -0.7 0.3 0.2 1.0 0.2 0.9 -0.5
"""

from __future__ import annotations

import json
import sys

import zenoh


def session_to(endpoint: str) -> zenoh.Session:
    """Open a client session to one endpoint, without scouting for others."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def ask(session: zenoh.Session, key: str, request: object) -> dict:
    """Return the reply to a request. Raise RuntimeError with the learner's message, or if there is no reply."""
    payload = json.dumps(request)
    for reply in session.get(key, payload=payload, encoding=zenoh.Encoding.APPLICATION_JSON, timeout=5.0):
        if reply.ok is not None:
            return json.loads(reply.ok.payload.to_bytes())
        if reply.err is not None:
            raise RuntimeError(reply.err.payload.to_string())
    raise RuntimeError(f"nothing answers under {key}")


def main(robot: str, endpoint: str, *angles: str) -> None:
    q = [float(angle) for angle in angles]
    with session_to(endpoint) as session:  # a session that is not closed keeps Python from exiting
        reply = ask(session, f"bodyschema/{robot}/predict", {"q": [q]})
    for x, sigma, inside, pose in zip(reply["x"], reply["sigma"], reply["in_support"], reply["poses"], strict=True):
        where = "where data was" if inside else "away from all data"
        print(f"x = {x} m, 1-sigma {sigma} m, {where}")
        if pose["matrix"] is not None:  # an orientation is learnt
            print(f"T = {pose['matrix']}, covariance of x, y, z and turns {pose['covariance']} m², rad²")
    print(f"model {reply['model']} of {reply['pairs']} samples")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (RuntimeError, zenoh.ZError) as error:
        sys.exit(f"ask_predictions: {error}")
