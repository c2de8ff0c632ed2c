"""Permissions over zenoh: real sessions in every role and of strangers, with the page's certificates."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, Queue

import pytest
import zenoh
from security_recipe import PAGE, SEVERAL, TWO, blocks, carried_out
from small_arm import write_small_arm

from bodyschema.cli.install.router import RouterConfig
from bodyschema.daemon.config import Config
from bodyschema.daemon.transport.access import ROLES
from bodyschema.daemon.transport.identity import Identity, Route, TlsConfig
from bodyschema.daemon.transport.keys import Keys
from bodyschema.daemon.transport.query_limiter import LIMITS
from bodyschema.daemon.transport.session import Request, ZenohSession, client
from bodyschema.interfaces.errors import BusError, ConfigError, RequestError

LIMIT_S = 500.0
SILENCE_S = 0.3  # time in which a dropped message would have arrived
KEYS = Keys("arm")
QUESTIONS = {name: getattr(KEYS, name) for name in ("predict", "jacobian", "ik", "model", "pairs")}
STATES = {f"status/{process}": KEYS.status(process) for process in ("sampler", "learner")}
COMMANDS = {f"command/{process}": KEYS.command(process) for process in ("sampler", "learner")}
OWNERS = {"viewer": "anna", "operator": "bert", "sampler": "arm.sampler", "learner": "arm.learner"}


@pytest.fixture(scope="module")
def pki(tmp_path_factory) -> Path:
    """Return a folder with certificates made by the page's commands, and one of a foreign authority in `foreign/`."""
    folder = tmp_path_factory.mktemp("pki")
    (folder / "foreign").mkdir()
    carried_out(folder / "foreign")
    return carried_out(folder)


def identity_of(folder: Path, name: str | None, ca: Path | None = None) -> Identity:
    names = {} if name is None else {"certificate": f"{name}.pem", "key": f"{name}.key"}
    return Identity.of(TlsConfig(ca=str(ca or folder / "ca.pem"), **names), None, None, folder)


def write_robot(folder: Path, zenoh_table: str, pki: Path) -> Config:
    """Write a robot.toml with this table next to the certificates."""
    for file in pki.glob("*.*"):
        if not (folder / file.name).exists():
            (folder / file.name).symlink_to(file)
    return Config.load(write_small_arm(folder, zenoh_table + '[daemon]\nstate_dir = "state"\n'), {})


@dataclass
class Site:
    """A router, with the sampler's and the learner's sessions; they answer everything with their own key."""

    pki: Path
    endpoint: str
    router: ZenohSession
    sampler: ZenohSession
    learner: ZenohSession
    heard: Queue[bytes]
    publish: Callable[[bytes], None]

    def as_somebody(self, name: str) -> Route:
        return Route((self.endpoint,), identity_of(self.pki, name))


@pytest.fixture(scope="module")
def site(pki: Path, tmp_path_factory, free_endpoint) -> Iterator[Site]:
    """Run the files of deploy/several_machines on one machine, with only the endpoints changed."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    router_file = pki / "router.toml"
    router_file.write_text((SEVERAL / "router.toml").read_text().replace("tls/192.0.2.10:7450", endpoint))
    own = {process: free_endpoint() for process in ("sampler", "learner")}
    heard: Queue[bytes] = Queue()
    with ExitStack() as stack:
        router = RouterConfig.load(router_file)
        meeting = stack.enter_context(ZenohSession(listen=endpoint, settings=router.settings()))
        buses = {}
        for process, machine in (("sampler", "robot"), ("learner", "learner")):
            folder = tmp_path_factory.mktemp(machine)
            text = (SEVERAL / f"{machine}.toml").read_text().replace("tls/192.0.2.10:7450", endpoint)
            ends = "".join(f'{name} = "{end}"\n' for name, end in own.items())
            config = write_robot(folder, text.replace("[zenoh]\n", f"[zenoh]\n{ends}"), pki)
            settings = config.zenoh_settings(process)
            # Only through the router: on the two machines of a site the loopback leads nowhere else.
            settings["connect/endpoints"] = [endpoint]
            buses[process] = stack.enter_context(ZenohSession(listen=own[process], settings=settings))
        sampler, learner = buses["sampler"], buses["learner"]
        for bus, keys in (
            (sampler, (KEYS.pairs, KEYS.status("sampler"), KEYS.command("sampler"))),
            (
                learner,
                (KEYS.predict, KEYS.jacobian, KEYS.ik, KEYS.model, KEYS.status("learner"), KEYS.command("learner")),
            ),
        ):
            for key in keys:
                bus.answer(key, lambda _request, key=key: key.encode())
        alive = threading.Event()
        learner.watch(KEYS.alive("sampler"), lambda is_alive: is_alive and alive.set())
        learner.subscribe(KEYS.pair, heard.put)
        publish = sampler.publisher(KEYS.pair, cache=10)
        sampler.token(KEYS.alive("sampler"))
        learner.token(KEYS.alive("learner"))
        assert alive.wait(LIMIT_S)
        found = Site(pki, endpoint, meeting, sampler, learner, heard, publish)
        operator, until = found.as_somebody("bert"), time.monotonic() + LIMIT_S
        while len(answered(operator, QUESTIONS | STATES | COMMANDS)) < len(QUESTIONS | STATES | COMMANDS):
            assert time.monotonic() < until
        while not (learner.ask(KEYS.pairs) and sampler.ask(KEYS.predict)):
            assert time.monotonic() < until
        yield found


def drained(queue: Queue[bytes]) -> list[bytes]:
    """Return all that arrives until a period of silence."""
    found = []
    while True:
        try:
            found.append(queue.get(timeout=SILENCE_S))
        except Empty:
            return found


def answered(route: Route, keys: dict[str, str]) -> set[str]:
    with client(route) as bus:
        return {name for name, key in keys.items() if [reply.payload for reply in bus.ask(key)] == [key.encode()]}


def test_viewer_can_query_but_not_command(site: Site) -> None:
    everything = QUESTIONS | STATES | COMMANDS
    assert answered(site.as_somebody("anna"), everything) == set(QUESTIONS | STATES)


def test_an_operator_may_give_commands(site: Site) -> None:
    everything = QUESTIONS | STATES | COMMANDS
    assert answered(site.as_somebody("bert"), everything) == set(everything)


def test_certificate_without_role_permits_nothing(site: Site) -> None:
    assert answered(site.as_somebody("hub"), QUESTIONS | STATES | COMMANDS) == set()


def test_learner_and_sampler_can_query_each_other(site: Site) -> None:
    assert site.learner.ask_one(KEYS.pairs) == KEYS.pairs.encode()
    assert site.sampler.ask_one(KEYS.predict) == KEYS.predict.encode()


def test_learner_and_sampler_cannot_command_each_other(site: Site) -> None:
    assert site.learner.ask(KEYS.command("sampler")) == []
    assert site.sampler.ask(KEYS.command("learner")) == []


def test_the_samplers_pairs_reach_learner_and_viewer(site: Site) -> None:
    drained(site.heard)
    seen: Queue[bytes] = Queue()
    with client(site.as_somebody("anna")) as viewer:
        viewer.subscribe(KEYS.pair, seen.put)
        viewer.ask_one(KEYS.pairs)  # the subscription has arrived before this
        site.publish(b"a pair")
        assert seen.get(timeout=LIMIT_S) == b"a pair"
    assert site.heard.get(timeout=LIMIT_S) == b"a pair"


@pytest.mark.parametrize("name", ["anna", "bert", "hub", "arm.learner"])
def test_pairs_from_others_do_not_reach_learner(site: Site, name: str) -> None:
    drained(site.heard)
    with client(site.as_somebody(name)) as bus:
        bus.publisher(KEYS.pair)(b"poison")
        bus.ask(KEYS.predict)
        site.publish(b"a pair")  # earlier messages would have arrived before it
        assert drained(site.heard) == [b"a pair"]


def test_operator_cannot_answer_for_learner(site: Site) -> None:
    with client(site.as_somebody("bert")) as forger:
        forger.answer(KEYS.predict, lambda _request: b"forged")
        forger.ask(KEYS.predict)
        with client(site.as_somebody("anna")) as viewer:
            assert [reply.payload for reply in viewer.ask(KEYS.predict)] == [KEYS.predict.encode()]


def test_viewer_cannot_intercept_commands(site: Site) -> None:
    with client(site.as_somebody("anna")) as spy:
        spy.answer(KEYS.command("learner"), lambda _request: b"forged")
        spy.ask(KEYS.predict)
        with client(site.as_somebody("bert")) as operator:
            assert [reply.payload for reply in operator.ask(KEYS.command("learner"))] == [
                b"bodyschema/arm/command/learner"
            ]


def test_operator_cannot_forge_liveliness(site: Site) -> None:
    seen: Queue[bool] = Queue()
    other = Keys("other")
    with client(site.as_somebody("bert")) as pretender, client(site.as_somebody("anna")) as viewer:
        viewer.watch(other.alive("sampler"), seen.put)
        viewer.ask_one(KEYS.pairs)
        pretender.token(other.alive("sampler"))
        pretender.ask_one(KEYS.pairs)
        with pytest.raises(Empty):
            seen.get(timeout=SILENCE_S)


@pytest.fixture(scope="module")
def second_robot(site: Site) -> Keys:
    """Return the keys of another robot, for which the router's own session answers; no certificate restricts it."""
    second = Keys("second")
    for key in (second.predict, second.status("sampler"), second.command("learner")):
        site.router.answer(key, lambda _request, key=key: key.encode())
    site.router.token(second.alive("sampler"))
    return second


def test_viewer_of_all_robots_sees_liveliness(site: Site, second_robot: Keys) -> None:
    with client(site.as_somebody("anna")) as viewer:
        assert {KEYS.alive("sampler"), second_robot.alive("sampler")} <= set(viewer.alive("bodyschema/*/alive/sampler"))


def test_operator_of_one_robot_reaches_no_other(site: Site, second_robot: Keys) -> None:
    keys = {key: key for key in (second_robot.predict, second_robot.status("sampler"), second_robot.command("learner"))}
    assert answered(site.as_somebody("anna"), keys) == {second_robot.predict, second_robot.status("sampler")}
    assert answered(site.as_somebody("bert"), keys | COMMANDS) == set(COMMANDS)


def test_operator_of_one_robot_cannot_list_all_robots(site: Site, second_robot: Keys) -> None:
    with client(site.as_somebody("bert")) as operator:
        assert operator.alive(KEYS.alive("sampler")) == [KEYS.alive("sampler")]
        assert operator.alive("bodyschema/*/alive/sampler") == []
        assert operator.alive(second_robot.alive("sampler")) == []


def test_denied_command_error_suggests_missing_role(site: Site) -> None:
    with client(site.as_somebody("anna")) as viewer, pytest.raises(BusError, match=r"certificate or name has no role"):
        viewer.ask_one(KEYS.command("learner"))


@pytest.mark.parametrize("who", ["nobody", "foreign"])
def test_client_without_valid_certificate_is_refused(site: Site, who: str) -> None:
    folder = site.pki if who == "nobody" else site.pki / "foreign"
    route = Route((site.endpoint,), identity_of(folder, None if who == "nobody" else "anna", site.pki / "ca.pem"))
    with pytest.raises(BusError, match="is there, but the connection was refused: your certificate"), client(route):
        pass


def test_client_without_tls_is_refused(site: Site) -> None:
    with pytest.raises(BusError), client(site.endpoint.replace("tls/", "tcp/"), open_timeout_s=1.0):
        pass


def test_router_of_foreign_authority_is_rejected(site: Site) -> None:
    identity = identity_of(site.pki / "foreign", "anna")
    with pytest.raises(BusError, match="not of your authority"), client(Route((site.endpoint,), identity)):
        pass


def test_programs_on_the_samplers_machine_need_no_certificate(site: Site) -> None:
    with client(str(site.sampler._listen)) as local:
        assert local.ask_one(KEYS.command("sampler")) == KEYS.command("sampler").encode()
        assert local.ask_one(KEYS.predict) == KEYS.predict.encode()


# --- without a router


@pytest.fixture
def two(pki: Path, tmp_path: Path, free_endpoint) -> Iterator[tuple[Config, Queue[bytes]]]:
    """Run the files of deploy/two_machines on one machine; yield the learner's configuration and what it receives."""
    ends = {"tls/192.0.2.20:7447": free_endpoint(), "tls/192.0.2.30:7448": free_endpoint()}
    heard: Queue[bytes] = Queue()
    with ExitStack() as stack:
        configs = {}
        for process, machine in (("sampler", "robot"), ("learner", "learner")):
            text = (TWO / f"{machine}.toml").read_text()
            for old, new in ends.items():
                text = text.replace(old, new.replace("tcp/", "tls/"))
            (tmp_path / machine).mkdir()
            configs[process] = write_robot(tmp_path / machine, text, pki)
        sampler, learner = (
            stack.enter_context(
                ZenohSession(listen=config.tables.zenoh.endpoint(process), settings=config.zenoh_settings(process))
            )
            for process, config in configs.items()
        )
        alive = threading.Event()
        learner.watch(KEYS.alive("sampler"), lambda is_alive: is_alive and alive.set())
        learner.subscribe(KEYS.pair, heard.put)
        learner.answer(KEYS.command("learner"), lambda _request: b"done")
        learner.answer(KEYS.predict, lambda _request: b"there")
        publish = sampler.publisher(KEYS.pair)
        sampler.token(KEYS.alive("sampler"))
        assert alive.wait(LIMIT_S)
        until = time.monotonic() + LIMIT_S
        while not sampler.ask(KEYS.predict):
            assert time.monotonic() < until
        publish(b"a pair")
        yield configs["learner"], heard


def test_two_machines_enforce_access_without_router(two, pki: Path) -> None:
    learner, heard = two
    assert heard.get(timeout=LIMIT_S) == b"a pair"
    as_anna = Route((learner.tables.zenoh.learner,), identity_of(pki, "anna"))
    with client(as_anna) as viewer:
        viewer.publisher(KEYS.pair)(b"poison")
        assert viewer.ask_one(KEYS.predict) == b"there"
        assert viewer.ask(KEYS.command("learner")) == []
    with client(Route(as_anna.endpoints, identity_of(pki, "bert"))) as operator:
        assert operator.ask_one(KEYS.command("learner")) == b"done"
    assert drained(heard) == []


# --- names and passwords


def test_router_accepts_only_valid_name_and_password(pki: Path, endpoint: str) -> None:
    endpoint = endpoint.replace("tcp/", "tls/")
    (pki / "users.txt").write_text("anna:a long password\nbert:another\n")
    (pki / "users.txt").chmod(0o600)
    tables = (SEVERAL / "router.toml").read_text().replace("tls/192.0.2.10:7450", endpoint)
    (pki / "by_user.toml").write_text('users_file = "users.txt"\n' + tables)

    def route(user: str, password: str) -> Route:
        file = pki / f"{user} {password}"
        file.write_text(password + "\n")
        file.chmod(0o600)
        return Route((endpoint,), Identity(pki / "ca.pem", user=user, password_file=file))

    with ZenohSession(listen=endpoint, settings=RouterConfig.load(pki / "by_user.toml").settings()) as router:
        router.answer(KEYS.predict, lambda _request: b"there")
        router.answer(KEYS.command("learner"), lambda _request: b"done")
        with client(route("anna", "a long password")) as viewer:
            assert viewer.ask_one(KEYS.predict) == b"there"
            assert viewer.ask(KEYS.command("learner")) == []
        for wrong in (
            route("anna", "another"),
            route("zoe", "a long password"),
            Route((endpoint,), identity_of(pki, "anna")),
        ):
            with pytest.raises(BusError, match="or password is not accepted"), client(wrong):
                pass


# --- valid settings of robot.toml and router.toml


@pytest.mark.parametrize(
    "open_to_all", ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "ws/192.0.2.1:7447", "udp/robot.lan:7447"]
)
def test_public_endpoint_without_tls_is_refused_with_remedy(tmp_path: Path, open_to_all: str) -> None:
    robot = write_small_arm(tmp_path, f'[zenoh]\nsampler = "{open_to_all}"\n')
    said = rf"line 9: zenoh.sampler: {re.escape(open_to_all)} is open to the network.*Write tcp/127.0.0.1:7447 for"
    with pytest.raises(ConfigError, match=said):
        Config.load(robot, {})


@pytest.mark.parametrize(
    "local", ["tcp/127.0.0.1:17447", "tcp/[::1]:17447", "tcp/localhost:17447", "unixsock-stream/./s"]
)
def test_endpoints_of_this_machine_need_nothing(tmp_path: Path, local: str) -> None:
    assert Config.load(write_small_arm(tmp_path, f'[zenoh]\nsampler = "{local}"\n'), {}).tables.zenoh.sampler == local


TLS = '[zenoh.tls]\nca = "ca.pem"\n'
OWN = TLS + 'certificate = "anna.pem"\nkey = "anna.key"\n'


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ('[zenoh]\nsampler = "tls/0.0.0.0:7447"\n', r"zenoh.sampler: tls/0.0.0.0:7447 needs certificates"),
        (f'[zenoh]\nsampler = "tls/0.0.0.0:7447"\n{TLS}', r"to listen on tls/0.0.0.0:7447 takes a certificate"),
        (f'[zenoh]\nsampler = "tls/0.0.0.0:7447"\n{OWN}', r"no one may do anything on tls/0.0.0.0:7447"),
        ('[zenoh]\nrouter = "tcp/hub.lan:7450"\n', r"zenoh.router: tcp/hub.lan:7450 is open.*Write tls/hub.lan:7450"),
        ('[zenoh]\nrouter = "tls/hub.lan:7450"\n', r"zenoh.router: tls/hub.lan:7450 needs certificates"),
        ('[zenoh.login]\nuser = "anna"\npassword_file = "p"\n', r"zenoh.login: passwords go over TLS only"),
        ('[zenoh.tls]\nca = "ca.pem"\nkey = "anna.key"\n', r"names a certificate or a key. Name both"),
        ('[zenoh.tls]\nca = "elsewhere.pem"\n', r"elsewhere.pem cannot be read: No such file"),
        ('[zenoh.access]\nviewers = ["anna"]\n', r"unknown key.*viewers.*viewer"),
    ],
)
def test_half_a_protection_is_refused(pki: Path, tmp_path: Path, tables: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        write_robot(tmp_path, tables, pki)


def test_documented_environment_variable_overrides_tls_identity(pki: Path, tmp_path: Path) -> None:
    shown = re.search(r"`(BODYSCHEMA_ZENOH_TLS)='(.*?)' bodyschema command", PAGE.read_text())
    assert shown is not None
    variable, value = shown.groups()
    robot = write_robot(tmp_path, '[zenoh]\nrouter = "tls/hub.lan:7450"\n' + OWN, pki).file
    route = Config.load(robot, {variable: value}).route("learner")
    assert route.endpoints == ("tcp/127.0.0.1:7448", "tls/hub.lan:7450")
    assert route.identity is not None
    assert route.identity.certificate == tmp_path / "bert.pem"


def test_a_key_that_everybody_can_read_is_refused(pki: Path, tmp_path: Path) -> None:
    (tmp_path / "anna.key").write_bytes((pki / "anna.key").read_bytes())
    (tmp_path / "anna.key").chmod(0o644)
    with pytest.raises(ConfigError, match=r"anna.key is secret, and every user of this machine can read it. chmod 600"):
        write_robot(tmp_path, OWN, pki)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("tls/192.0.2.10", "tcp/192.0.2.10", r"line 2: listen: 'tcp/192.0.2.10:7450' is no endpoint with TLS"),
        ('[access."*"]', '[access."a/**"]', r"'a/\*\*' is no robot's name"),
        ('viewer = ["anna"]', "", r"access.\*: no one has a role. Known are: viewer, operator, sampler, learner"),
        ("operator", "admin", r"unknown key.*admin"),
    ],
)
def test_wrong_router_file_setting_is_named(pki: Path, old: str, new: str, said: str) -> None:
    text = (SEVERAL / "router.toml").read_text()
    assert old in text
    (pki / "wrong.toml").write_text(text.replace(old, new))
    with pytest.raises(ConfigError, match=said):
        RouterConfig.load(pki / "wrong.toml")


def test_missing_router_file_error_names_documentation(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"there is no such file\. docs/security.md has one"):
        RouterConfig.load(tmp_path / "router.toml")


def test_zenohd_gets_the_same_configuration_as_a_file(pki: Path, tmp_path: Path) -> None:
    (pki / "router.toml").write_text((SEVERAL / "router.toml").read_text())
    router = RouterConfig.load(pki / "router.toml")
    (tmp_path / "zenohd.json5").write_text(router.as_zenohd())
    read = zenoh.Config.from_file(tmp_path / "zenohd.json5")
    assert json.loads(read.get_json("access_control"))["default_permission"] == "deny"
    assert json.loads(read.get_json("listen/endpoints")) == {"router": ["tls/192.0.2.10:7450"]} or json.loads(
        read.get_json("listen/endpoints")
    ) == ["tls/192.0.2.10:7450"]


# --- the page


def test_page_shows_deploy_files_verbatim() -> None:
    shown = blocks("toml")
    for file in (SEVERAL / "router.toml", SEVERAL / "robot.toml", TWO / "robot.toml"):
        assert file.read_text().split("\n", 1)[1] in shown


def test_page_lists_every_role_and_current_limit() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \| ", page, re.MULTILINE) == list(ROLES)
    for row in (
        f"| bytes in a request | {LIMITS.request_bytes:,} |",
        f"| bytes of requests that wait | {LIMITS.waiting_bytes:,} |",
        f"| queries that wait for an answer | {LIMITS.waiting} |",
        f"| queries a second | {LIMITS.rate_hz:g}, and {LIMITS.burst} at once after a rest |",
        f"| time that a query waits for its turn | {LIMITS.wait_s:g} s |",
        f"| sources that wait at the same time | {LIMITS.sources} |",
    ):
        assert row in page


# --- floods


def test_flood_from_one_client_does_not_starve_others(endpoint: str) -> None:
    served: list[bytes] = []
    refused: Queue[str] = Queue()
    busy, goes_on = threading.Event(), threading.Event()

    def serve(request: Request) -> bytes:
        busy.set()
        assert goes_on.wait(LIMIT_S)
        served.append(request.payload)
        return request.payload

    def hear(reply: zenoh.Reply) -> None:
        if reply.err is not None:
            refused.put(reply.err.payload.to_string())

    with ZenohSession(listen=endpoint) as server, client(endpoint) as greedy, client(endpoint) as modest:
        server.answer(KEYS.predict, serve)
        for _ in range(2 * LIMITS.waiting):
            greedy._open.get(
                KEYS.predict, zenoh.handlers.Callback(hear, indirect=False), payload=b"flood", timeout=LIMIT_S
            )
        said = refused.get(timeout=LIMIT_S)
        assert "100 queries of clients that give no source_info wait already, and that is the most" in said
        assert busy.wait(LIMIT_S)
        answers: Queue[bytes] = Queue()
        asking = threading.Thread(
            target=lambda: answers.put(modest.ask_one(KEYS.predict, b"modest", timeout_s=LIMIT_S))
        )
        asking.start()
        waiting = server._limiters[0]._sources
        until = time.monotonic() + LIMIT_S
        while len(waiting) < 2 and time.monotonic() < until:
            time.sleep(0.01)
        goes_on.set()
        assert answers.get(timeout=LIMIT_S) == b"modest"
        asking.join()
    assert served.index(b"modest") <= 2


def test_oversized_request_error_names_largest_size(endpoint: str) -> None:
    with ZenohSession(listen=endpoint) as server, client(endpoint) as asking:
        server.answer(KEYS.predict, lambda request: b"answered")
        assert asking.ask_one(KEYS.predict, bytes(LIMITS.request_bytes)) == b"answered"
        with pytest.raises(RequestError, match="the request has 4,194,305 bytes; send at most 4,194,304"):
            asking.ask_one(KEYS.predict, bytes(LIMITS.request_bytes + 1))
