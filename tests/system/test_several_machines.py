"""Router, sampler, learner and viewers on hosts of their own: network namespaces on a bridge, the files of deploy/."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from security_recipe import SEVERAL, carried_out
from small_arm import write_small_arm

LIMIT_S = 500.0
HOSTS = {"hub": "192.0.2.10", "robot": "192.0.2.20", "learner": "192.0.2.30", "desk": "192.0.2.40"}
PAIRS = 20
DESK = Path(__file__).with_name("desk.py")


@dataclass
class Network:
    """Hosts on one bridge, which is a namespace too; `close` removes all."""

    prefix: str
    made: list[str] = field(default_factory=list)

    def build(self) -> None:
        switch = self._host("switch")
        self._ip("-n", switch, "link", "add", "bridge", "type", "bridge")
        self._ip("-n", switch, "link", "set", "bridge", "up")
        for name, address in HOSTS.items():
            host = self._host(name)
            self._ip("-n", switch, "link", "add", name, "type", "veth", "peer", "name", "lan", "netns", host)
            self._ip("-n", switch, "link", "set", name, "master", "bridge", "up")
            self._ip("-n", host, "address", "add", f"{address}/24", "dev", "lan")
            for device in ("lo", "lan"):
                self._ip("-n", host, "link", "set", device, "up")

    def close(self) -> None:
        for name in self.made:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True, check=False)

    def on(self, host: str) -> list[str]:
        """Return the beginning of a command on the host."""
        return ["ip", "netns", "exec", self.prefix + host]

    def _host(self, name: str) -> str:
        self._ip("netns", "add", self.prefix + name)
        self.made.append(self.prefix + name)
        return self.prefix + name

    def _ip(self, *arguments: str) -> None:
        done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
        if done.returncode:
            said = f"ip {' '.join(arguments)}: {done.stderr.strip()}"
            pytest.skip(f"no network namespaces ({said}); to run it: leave the container")


@pytest.fixture(scope="module")
def network() -> Iterator[Network]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("no network namespaces; to run it: be root, apt-get install iproute2")
    network = Network(f"bs{os.getpid()}-")
    try:
        network.build()
        yield network
    finally:
        network.close()


@pytest.fixture(scope="module")
def desk(network: Network, tmp_path_factory) -> Iterator[dict[str, Any]]:
    """Yield what is received at the desk, while router, sampler and learner run on their hosts."""
    pki = carried_out(tmp_path_factory.mktemp("pki"))
    shutil.copy(SEVERAL / "router.toml", pki)
    write_small_arm(pki, (SEVERAL / "viewer.toml").read_text())
    folders = {"hub": pki}
    for host, table in (("robot", "robot"), ("learner", "learner")):
        folder = folders[host] = tmp_path_factory.mktemp(host)
        for file in pki.glob("*.[pk]e[my]"):
            shutil.copy(file, folder)
        text = (SEVERAL / f"{table}.toml").read_text() + '[daemon]\nstate_dir = "state"\n'
        if host == "robot":
            text += '[drivers]\nrecording = "recording.csv"\n'
        write_small_arm(folder, text)
    rows = "".join(f"{k / 30},{0.03 * k},0.1,0.3,{0.01 * k},0\n" for k in range(PAIRS))
    (folders["robot"] / "recording.csv").write_text("t,waist,shoulder,x,y,z\n" + rows)

    with ExitStack() as stack:
        for host, process in (("hub", ["router"]), ("robot", ["run", "sampler"]), ("learner", ["run", "learner"])):
            log = stack.enter_context((folders[host] / "log").open("wb"))
            command = [*network.on(host), sys.executable, "-m", "bodyschema", *process]
            running = stack.enter_context(subprocess.Popen(command, cwd=folders[host], stderr=log))
            stack.callback(running.terminate)
        command = [*network.on("desk"), sys.executable, str(DESK), f"tls/{HOSTS['hub']}:7450", str(PAIRS)]
        done = subprocess.run(command, cwd=pki, capture_output=True, text=True, timeout=LIMIT_S, check=False)
        logs = "\n".join(f"{host}: {(folders[host] / 'log').read_text()}" for host in folders)
        assert done.returncode == 0, done.stderr + logs
        yield json.loads(done.stdout)


@pytest.mark.soak
def test_pairs_are_learnt_remotely_and_viewers_answered(desk: dict[str, Any]) -> None:
    assert (desk["predict"]["pairs"], desk["sampler"]["pairs"]) == (PAIRS, PAIRS)


def test_the_page_of_a_viewer_follows_both_processes(desk: dict[str, Any]) -> None:
    assert desk["page"] == {"sampler": True, "learner": True}


def test_only_operators_may_give_commands(desk: dict[str, Any]) -> None:
    assert "certificate or name has no role" in desk["viewer's command"]["error"]
    assert desk["operator's command"]["command"] == "pause"


def test_nobody_listens_on_the_network_but_the_router(desk: dict[str, Any], network: Network) -> None:
    for host, at_most in (("hub", {"192.0.2.10:7450"}), ("robot", {"127.0.0.1:7447"}), ("learner", {"127.0.0.1:7448"})):
        listening = subprocess.run(
            [*network.on(host), "ss", "-Hltun"], capture_output=True, text=True, check=True
        ).stdout
        assert {line.split()[4] for line in listening.splitlines()} == at_most
