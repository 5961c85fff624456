"""`tenuto compose`: the run's processes as containers on one machine, with a Zenoh router for other machines.

The containers share the run's directory, and so the unix sockets in it: the way from an observation to its
action is the one that it is without containers. The router is beside that way, not on it.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath

from launcher import options
from launcher.cli import DONE
from launcher.parsing import HELP_FLAGS, given
from launcher.supervisor import ENDING_LIMIT_S
from launcher.vitals import START_NS
from rtcore import cast
from rtcore.cast import Part
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PER_ENV, PROCESSES, RECORDER
from rtcore.config import ConfigError, RunConfig, SuperviseConfig

IMAGE = "tenuto:latest"
RUNS = PurePosixPath("/runs")  # in the container: on a volume, owned by the image's user
USER = 10001  # the same in the Dockerfile; all containers are one user, or they could not share sockets
RUN = RUNS / "live"
ROUTER = "router"
PORT = 7447
SUBCOMMANDS = {ENV_SERVER: "env", AGENT: "agent", LEARNER: "learn", RECORDER: "record"}
DEFAULT_RUN = ("halfcheetah", "--duration-s", "0")
OURS = ("--run-dir", "--connect", "--listen", "--router", "--config", "--link.connect", "--link.listen",
        "--link.secure", "--index")  # fmt: skip
CHECK_S = 30  # a check costs a third of a second of a core: four of them 4 % of one
CHECK_LIMIT_S = 5  # beyond what it waits for a turn
UNLIMITED = -1

Node = Mapping[str, "Node"] | Sequence["Node"] | str | int | bool


@dataclass(frozen=True)
class Service:
    """One container.

    Attributes:
        name: of the process, with a hyphen before its number, or `ROUTER`.
        command: what it runs.
        check: what says by its exit code whether it is well.
        check_limit_s: how long that may take.
        start_s: how long a failing check says nothing after the start.
        ports: published, on this machine's loopback alone.
        ulimits: what it may ask the kernel for.
        after: who is started before it, and ended after it: the world ends first, as with `tenuto run`.
    """

    name: str
    command: tuple[str, ...]
    check: tuple[str, ...]
    check_limit_s: int = CHECK_LIMIT_S
    start_s: int = 10
    ports: tuple[int, ...] = ()
    ulimits: Mapping[str, int] = field(default_factory=dict)
    after: tuple[str, ...] = ()


def services(run: Sequence[str] = DEFAULT_RUN, config: RunConfig | None = None) -> tuple[Service, ...]:
    """The containers of a run.

    Args:
        run: what says which run it is: a preset and what differs from it. Every process gets it: whoever
            comes first makes the directory.
        config: what that makes; None: with one environment.
    """
    found = [_service(part, run) for part in cast.parts(config or RunConfig())]
    connects = f"import socket; socket.create_connection(('127.0.0.1', {PORT}), 2)"
    router = Service(
        name=ROUTER,
        command=("tenuto", "router", "--listen", f"tcp/0.0.0.0:{PORT}"),
        check=("python", "-c", connects),
        ports=(PORT,),
    )
    return (router, *found)


def _service(part: Part, run: Sequence[str]) -> Service:
    place = ("--run-dir", str(RUN), "--connect", f"tcp/{ROUTER}:{PORT}")
    index = () if part.index is None else ("--index", str(part.index))
    later = PROCESSES[PROCESSES.index(part.role) + 1 :]
    # An environment's agent has its number; all others are one.
    after = Part(later[0], part.index if later[0] in PER_ENV else None) if later else None
    return Service(
        name=_service_name(part),
        command=("tenuto", SUBCOMMANDS[part.role], *run, *place, *index),
        check=("tenuto", "health", part.name, "--run-dir", str(RUN), "--kill-stuck"),
        check_limit_s=round(SuperviseConfig().stuck_s) + CHECK_LIMIT_S,
        start_s=START_NS // 1_000_000_000,
        # Real-time priorities and locked memory, for who has a deadline.
        ulimits={"rtprio": 99, "memlock": UNLIMITED} if part.role in PER_ENV else {},
        after=(ROUTER if after is None else _service_name(after),),
    )


def _service_name(part: Part) -> str:
    """A service is also a host's name, in which a dot would part it."""
    return part.name.replace(".", "-")


def as_compose(found: Sequence[Service]) -> dict[str, Node]:
    """The file's content."""
    return {
        "name": "tenuto",
        "services": {service.name: _as_node(service) for service in found},
        "volumes": {"runs": {}},
    }


def _as_node(service: Service) -> dict[str, Node]:
    node: dict[str, Node] = {
        "image": IMAGE,
        "build": ".",
        "command": list(service.command),
        "user": f"{USER}:{USER}",
        "init": True,  # so that the process is not number 1, which cannot be killed from within
        # As often as `tenuto run` would; Docker's own back-off lies in between.
        "restart": f"on-failure:{SuperviseConfig().limit}",
        "stop_grace_period": f"{ENDING_LIMIT_S:g}s",
        "healthcheck": {
            "test": ["CMD", *service.check],
            "interval": f"{CHECK_S}s",
            "timeout": f"{service.check_limit_s}s",
            "retries": 2,
            "start_period": f"{service.start_s}s",
        },
        "security_opt": ["no-new-privileges:true"],
        "cap_drop": ["ALL"],
        "read_only": True,
        "tmpfs": ["/tmp"],
    }
    if service.name != ROUTER:
        node["volumes"] = [f"runs:{RUNS}"]
    if service.after:
        node["depends_on"] = list(service.after)
    if service.ports:
        node["ports"] = [f"127.0.0.1:{port}:{port}" for port in service.ports]
    if service.ulimits:
        node["ulimits"] = dict(service.ulimits)
    return node


def render(found: Sequence[Service], command: str) -> str:
    """compose.yaml as text; `command` made it."""
    head = f"# Made by `{command}`: run that again rather than edit this.\n"
    return head + _yaml(as_compose(found), 0)


def compose(argv: Sequence[str]) -> int:
    """`tenuto compose [PRESET] ...`."""
    description = options.describe(
        "Print the compose.yaml of a run in containers. It goes on until stopped, unless --duration-s says "
        "otherwise."
    )
    for flag in OURS:
        if given(flag, argv):
            raise ConfigError(flag.lstrip("-").replace("-", "_"), "given", "is the containers' own here")
    argv = list(argv) or list(DEFAULT_RUN)
    if not given("--duration-s", argv) and not any(flag in argv for flag in HELP_FLAGS):
        argv += ["--duration-s", "0"]
    config, _ = options.read(options.RunOptions, argv, prog="tenuto compose", description=description)
    command = " ".join(["tenuto compose", *argv]) if argv != list(DEFAULT_RUN) else "tenuto compose"
    sys.stdout.write(render(services(argv, config), command))
    return DONE


def _yaml(node: Node, depth: int) -> str:
    """Block style for mappings and the lists in them, JSON's quoting for text: both are YAML."""
    assert isinstance(node, Mapping)
    lines = []
    for key, value in node.items():
        begin = "  " * depth + f"{key}:"
        if isinstance(value, Mapping) and value:
            lines.append(f"{begin}\n{_yaml(value, depth + 1)}")
        else:
            text = json.dumps({} if isinstance(value, Mapping) else value)
            lines.append(f"{begin} {text}\n")
    return "".join(lines)
