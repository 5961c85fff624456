"""Rogues at a secured run, and what each left behind.

Env server and agent are processes; this one has the learner's and the recorder's honest ends, and plays one
rogue after the other with a session of its own.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import zenoh
from msgspec.structs import replace

from env_server.worlds.registry import resolve
from launcher import keys
from rtcore import channels
from rtcore.bus import NoAnswerError
from rtcore.codec import Codec, Rejections
from rtcore.config import AgentConfig, EnvConfig, LinkConfig, RecorderConfig, RunConfig
from rtcore.messages import Action, Architecture, Command, Policy
from rtcore.run_dir import RunDir
from rtcore.weights import sha256
from rtcore.zenoh_bus import ZenohBus, open_bus
from tests.agent_service import rig
from tests.rtcore.bus_samples import eventually
from tests.system.secured_scene import CLOCK, Scene, linked, send, start

LINK_S = 1.0  # a rogue without a link tries for so long: some ten times
SENT_S = 0.1  # long enough for what was sent to be there
APART_S = 0.6  # with the settling: a refused policy is told once a second at most
SETTLE_S = 0.5  # two of a process's reports
SETTLED_STEPS = 10  # of the end of it: somebody acted in one of them, or nobody does any more
FORGED = 777  # the policy version that forged actions claim

# The rogues: each does its worst. Its policies have the version 9.


def no_certificate(scene: Scene) -> int:
    with scene.rogue(channels.LEARNER, shows=False) as session:
        send(session, channels.POLICY, "policy", scene.policy(9))
        time.sleep(LINK_S)
        return len(session.info.peers_zid())


def another_authority(scene: Scene) -> int:
    home = scene.home.parent / "theirs"
    keys.make(home, now=datetime.now(UTC))
    with scene.rogue(channels.LEARNER, home) as session:
        send(session, channels.POLICY, "policy", scene.policy(9))
        time.sleep(LINK_S)
        return len(session.info.peers_zid())


def recorder_publishes(scene: Scene) -> int:
    """Policies that are even signed, on a key that is declared and on one that is not."""
    payload = Codec(channels.POLICY, Rejections(CLOCK.now_ns)).encode(scene.policy(9))
    with scene.rogue(channels.RECORDER) as session:
        publisher = session.declare_publisher("policy")
        assert linked(session)
        for _ in range(3):
            session.put("policy", payload)
            publisher.put(payload)
        time.sleep(SENT_S)
    return 6


def recorder_acts(scene: Scene) -> int:
    """In time: it answers each step where it hears it."""
    action = Codec(channels.ACTION, Rejections(CLOCK.now_ns))
    steps = Codec(channels.STEP, Rejections(CLOCK.now_ns))
    answered: list[int] = []
    with scene.rogue(channels.RECORDER) as session:

        def answer(sample: zenoh.Sample) -> None:
            seen = steps.decode(sample.payload.to_bytes())
            assert seen is not None
            answered.append(seen.tick)
            values = b"\0\0\0\0" * scene.architecture.action_dim
            forged = Action(
                env=seen.env, incarnation=seen.incarnation, tick=seen.tick, values=values,
                policy_version=FORGED, received_ns=seen.sent_ns, sent_ns=seen.sent_ns,
            )  # fmt: skip
            session.put("env/env0/action", action.encode(forged))

        held = session.declare_subscriber("env/env0/step", zenoh.handlers.Callback(answer, indirect=True))
        assert eventually(lambda: len(answered) > 20)
        held.undeclare()  # type: ignore[no-untyped-call]
        time.sleep(SENT_S)
    return len(answered)


def recorder_orders(scene: Scene) -> int:
    """Says whether it was answered."""
    try:
        scene.recorder.ask(channels.ENV_SERVER, Command(id="1", verb="hold"), timeout_s=0.3, tries=1)
    except NoAnswerError:
        return 0
    return 1


def learners_link(scene: Scene, policy: Policy) -> int:
    """The learner's certificate was stolen, its key for policies was not."""
    with scene.rogue(channels.LEARNER) as session:
        # Links to two others are not enough: a message goes to whoever is known to want it.
        wanted: Any = session.declare_publisher("policy")
        assert eventually(lambda: wanted.matching_status.matching)
        send(session, channels.POLICY, "policy", policy)
        time.sleep(APART_S)
    return 0


def unsigned(scene: Scene) -> int:
    return learners_link(scene, replace(scene.policy(9), signature=b""))


def other_weights(scene: Scene) -> int:
    weights = rig.policy(9, mean_bias=5.0, architecture=scene.architecture).weights
    return learners_link(scene, replace(scene.policy(9), weights=weights, sha256=sha256(weights)))


def same_hash_claimed(scene: Scene) -> int:
    weights = rig.policy(9, mean_bias=5.0, architecture=scene.architecture).weights
    return learners_link(scene, replace(scene.policy(9), weights=weights))


def another_run(scene: Scene) -> int:
    return learners_link(scene, scene.policy(9, run="another"))


def replayed(scene: Scene) -> int:
    return learners_link(scene, scene.policy(1))


def restart_agent(scene: Scene) -> None:
    scene.agent.kill()
    scene.agent.wait()
    acted = scene.counters()[f"{channels.AGENT}.actions"]
    scene.agent = start(channels.AGENT, scene.run)
    assert scene.comes(lambda: scene.counters()[f"{channels.AGENT}.actions"] > acted)


def replayed_to_a_new_agent(scene: Scene) -> int:
    scene.learner.close()  # nobody tells it what the newest is
    restart_agent(scene)
    return learners_link(scene, scene.policy(2))


def tampered_file(scene: Scene) -> int:
    """Comes last: the agent has no policy then."""
    scene.run.adopted_path(channels.AGENT).write_bytes(
        msgspec.msgpack.encode(replace(scene.policy(3), version=9))
    )
    restart_agent(scene)
    return 0


# At one run each, so that one waits while the other does.
INTRUDERS = (
    no_certificate, another_authority, recorder_publishes, recorder_acts, recorder_orders, another_run,
)  # fmt: skip
FORGERS = (
    unsigned, other_weights, same_hash_claimed, replayed, replayed_to_a_new_agent, tampered_file,
)  # fmt: skip
ROGUES = (*INTRUDERS, *FORGERS)


@dataclass
class Traces:
    """What one rogue left behind."""

    returned: int
    counted: Counter[str]  # what rose meanwhile
    told: str  # in the logs of env server and agent
    versions: set[int]  # of the policies that acted
    version: int  # of the one that acted last
    ticked: bool


def watch(scene: Scene, rogue: Callable[[Scene], int]) -> Traces:
    logs = [scene.run.log_path(process) for process in (channels.ENV_SERVER, channels.AGENT)]
    sizes = [len(path.read_text()) for path in logs]
    scene.look()
    before, first = scene.counters(), len(scene.steps)
    returned = rogue(scene)
    time.sleep(SETTLE_S)
    scene.look()
    told = "".join(path.read_text()[size:] for path, size in zip(logs, sizes, strict=True))
    steps = scene.steps[first:]
    acted = [step.policy_version for step in steps[-SETTLED_STEPS:] if step.policy_version >= 0]
    counted = scene.counters() - before
    return Traces(
        returned, counted, told, {s.policy_version for s in steps}, acted[-1] if acted else -1, len(steps) > 5
    )


def play(home: Path, rogues: Sequence[Callable[[Scene], int]]) -> dict[str, Traces]:
    """Let rogues loose on one run, one after the other; its keys go to `home`, all else beside it.

    Before them nobody is, under that name.
    """
    keys.make(home, now=datetime.now(UTC))
    config = RunConfig(
        duration_s=0.0,
        env=resolve(EnvConfig(id="pointmass", hz=50.0)),
        agent=AgentConfig(rt="off"),
        recorder=RecorderConfig(record=False),
        link=LinkConfig(secure=str(home)),
    )
    run = RunDir.create(home.parent / "run", config)

    def bus(role: str) -> ZenohBus:
        return open_bus(role, run.run_name, run.socket_dir(), clock=CLOCK, secure=str(home))

    children = [start(channels.ENV_SERVER, run), start(channels.AGENT, run)]
    try:
        with bus(channels.LEARNER) as learner, bus(channels.RECORDER) as recorder:
            specs = learner.latest(channels.SPEC, "*")
            learner.declare_alive(channels.LEARNER)
            spec = specs.wait(20)
            assert spec is not None
            architecture = Architecture(
                kind="tanh_gaussian_mlp", observation_dim=spec.message.observation_dim,
                action_dim=spec.message.action_dim, hidden=[4],
            )  # fmt: skip
            scene = Scene(run, home, learner, recorder, architecture, children[1])
            for version in (1, 2, 3):
                scene.policies.put(scene.policy(version))
                assert scene.comes(partial(lambda wanted: scene.version() == wanted, version))
            found = {"nobody": watch(scene, lambda scene: 0)}
            for rogue in rogues:
                found[rogue.__name__] = watch(scene, rogue)
                children.append(scene.agent)
            return found
    finally:
        for process in children:
            process.kill()
            process.wait()
        run.remove_socket_dir()
