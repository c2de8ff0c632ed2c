"""Roles over zenoh, and the access-control rules that enforce them.

The rules apply where connections come in: at the router, or at a process that listens beyond its own machine. A message
that no rule allows is dropped there, before it reaches a process.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import msgspec

from .keys import Keys

EVERY_ROBOT = "*"
# The cache and the announcements of advanced publications use keys next to the published key, hidden from wild cards.
CACHE = "@adv/**"

Action = Literal["says", "hears", "asks", "answers", "shows", "watches"]
# For each action: the messages sent by the client that performs it, and the messages sent to that client.
_MESSAGES: dict[Action, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "says": (("put", "delete"), ("declare_subscriber",)),
    "hears": (("declare_subscriber",), ("put", "delete")),
    "asks": (("query",), ("reply", "declare_queryable")),
    "answers": (("declare_queryable", "reply"), ("query",)),
    "shows": (("liveliness_token",), ("liveliness_query", "declare_liveliness_subscriber")),
    "watches": (("liveliness_query", "declare_liveliness_subscriber"), ("liveliness_token",)),
}


class Names(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Names per role: common names of certificates, or user names if passwords are required."""

    viewer: tuple[str, ...] = ()  # asks for predictions, pairs, the model and states, and receives pairs and states
    # a viewer who may give commands, see the cameras' picture, and change the simulated robot's tool
    operator: tuple[str, ...] = ()
    sampler: tuple[str, ...] = ()  # the process of that name: publishes pairs, answers from its store
    learner: tuple[str, ...] = ()  # the process of that name: receives pairs, answers predictions


ROLES = tuple(field.name for field in msgspec.structs.fields(Names))


def allowed_actions(role: str, keys: Keys) -> dict[Action, tuple[str, ...]]:
    """Return the keys under which the role may perform each action."""
    pair, cache = keys.pair, f"{keys.pair}/{CACHE}"
    states, alive = (keys.status("sampler"), keys.status("learner")), (keys.alive("sampler"), keys.alive("learner"))
    questions = (keys.predict, keys.jacobian, keys.ik, keys.model)
    # A role that covers both processes may also use wild cards: status/*, alive/*.
    views: dict[Action, tuple[str, ...]] = {
        "hears": (pair, keys.status("*")),
        "asks": (*questions, keys.pairs, keys.status("*"), pair, cache),
        "watches": (keys.alive("*"), cache),
    }
    if role == "viewer":
        return views
    if role == "operator":
        return {**views, "asks": (*views["asks"], keys.command("*"), keys.picture, keys.simulation)}
    if role == "sampler":
        return {
            "says": (pair, states[0]),
            "answers": (keys.pairs, states[0], keys.command("sampler"), keys.picture, keys.simulation, pair, cache),
            "asks": (keys.predict,),
            "shows": (alive[0], cache),
            "watches": (keys.alive("*"),),
        }
    return {
        "says": (states[1],),
        "hears": (pair,),
        "answers": (*questions, states[1], keys.command("learner")),
        "asks": (keys.pairs, pair, cache),
        "shows": (alive[1],),
        "watches": (keys.alive("*"), cache),
    }


def access_control(names_of_robot: Mapping[str, Names], *, by_user: bool) -> dict[str, Any]:
    """Return zenoh's table `access_control`: each role may use the keys of its robots; all else is denied.

    Args:
        names_of_robot: names per role, by the robot's name, or `*` for every robot.
        by_user: names are those of users, to whom the passwords belong; otherwise the certificates' common names.
    """
    kind = "usernames" if by_user else "cert_common_names"
    rules: list[dict[str, Any]] = []
    owners: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for robot, names in names_of_robot.items():
        for role in ROLES:
            who: tuple[str, ...] = getattr(names, role)
            if not who:
                continue
            identity = f"{role} of {robot}"
            of_role = list(_rules(identity, allowed_actions(role, Keys(robot))))
            rules += of_role
            owners.append({"id": identity, kind: list(who)})
            policies.append({"rules": [rule["id"] for rule in of_role], "subjects": [identity]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": owners, "policies": policies}


def _rules(identity: str, allowed: Mapping[Action, tuple[str, ...]]) -> Iterator[dict[str, Any]]:
    for action, keys in allowed.items():
        for flow, messages in zip(("ingress", "egress"), _MESSAGES[action], strict=True):
            yield {
                "id": f"{identity} {action} {flow}",
                "messages": list(messages),
                "flows": [flow],
                "permission": "allow",
                "key_exprs": list(keys),
            }
