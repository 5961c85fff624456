"""Who takes part in a run."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtcore import cast
from rtcore.cast import Part
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.config import ConfigError, EnvConfig, RunConfig
from rtcore.config_check import check
from rtcore.tally import NAME_BYTES

ALONE = RunConfig()
FLEET = RunConfig(env=EnvConfig(count=3))


def test_one_environment_has_the_plain_names() -> None:
    assert cast.names(ALONE) == PROCESSES
    assert cast.names(ALONE, record=False) == PROCESSES[:3]
    assert cast.env_names(ALONE.env) == ("env0",)
    assert cast.env_names(EnvConfig(name="cell7")) == ("cell7",)


def test_a_fleet_has_an_env_server_and_an_agent_for_each_environment_in_connect_order() -> None:
    env_servers, agents = ("env_server.0", "env_server.1", "env_server.2"), cast.of_role(FLEET, AGENT)
    assert agents == ("agent_service.0", "agent_service.1", "agent_service.2")
    assert cast.names(FLEET) == (*env_servers, *agents, LEARNER, RECORDER)
    assert cast.names(FLEET, record=False) == (*env_servers, *agents, LEARNER)
    assert cast.of_role(FLEET, LEARNER) == (LEARNER,)


@pytest.mark.parametrize(
    ("name", "names"),
    [("env0", ("env0", "env1")), ("robot", ("robot0", "robot1")), ("cell-17", ("cell-0", "cell-1"))],
)
def test_environments_of_a_fleet_are_numbered(name: str, names: tuple[str, ...]) -> None:
    assert cast.env_names(EnvConfig(name=name, count=2)) == names


def test_a_name_tells_role_and_environment() -> None:
    for part in cast.parts(replace(FLEET, env=EnvConfig(count=12))):
        assert (cast.role_of(part.name), cast.index_of(part.name)) == (part.role, part.index)
        assert part.number == (part.index or 0)


def test_a_part_goes_by_the_name_of_its_own_environment_alone() -> None:
    mine = cast.as_part(FLEET, Part(AGENT, 2))
    assert mine == replace(FLEET, env=replace(FLEET.env, name="env2"))
    assert cast.names(mine) == cast.names(FLEET)
    assert cast.env_names(mine.env) == cast.env_names(FLEET.env)
    assert cast.as_part(FLEET, Part(LEARNER)) is FLEET
    assert cast.as_part(ALONE, Part(AGENT)) is ALONE


@pytest.mark.parametrize(
    ("config", "role", "index", "part"),
    [
        (ALONE, ENV_SERVER, None, Part(ENV_SERVER)),
        (ALONE, ENV_SERVER, 0, Part(ENV_SERVER)),
        (FLEET, ENV_SERVER, 0, Part(ENV_SERVER, 0)),
        (FLEET, AGENT, 2, Part(AGENT, 2)),
        (FLEET, LEARNER, None, Part(LEARNER)),
    ],
)
def test_a_process_plays_the_part_that_it_is_given(
    config: RunConfig, role: str, index: int | None, part: Part
) -> None:
    assert cast.part_for(config, role, index) == part


@pytest.mark.parametrize(
    ("config", "role", "index", "text"),
    [
        (FLEET, AGENT, None, r"index = None: must be in 0\.\.2: env\.count = 3"),
        (FLEET, ENV_SERVER, 3, r"index = 3: must be in 0\.\.2: env\.count = 3"),
        (FLEET, ENV_SERVER, -1, r"index = -1: must be in 0\.\.2"),
        (ALONE, AGENT, 1, r"index = 1: must not be given: the run has one agent_service"),
        (FLEET, LEARNER, 0, r"index = 0: must not be given: the run has one learner"),
    ],
)
def test_a_part_that_there_is_not(config: RunConfig, role: str, index: int | None, text: str) -> None:
    with pytest.raises(ConfigError, match=f"^{text}"):
        cast.part_for(config, role, index)


def test_a_fleets_names_fit_into_the_names_of_its_counters() -> None:
    longest = "a" * 39
    for name in (longest, f"{longest}12345"):  # of the number at its end another one takes the place
        env = EnvConfig(name=name, count=10)
        check(RunConfig(env=env))
        assert {len(one) for one in cast.env_names(env)} == {40}
        assert all(len(f"duplicate.{one}") < NAME_BYTES for one in cast.env_names(env))
    for name, count, most in ((f"{longest}a", 2, 39), (longest, 11, 38)):
        with pytest.raises(ConfigError) as caught:
            check(RunConfig(env=EnvConfig(name=name, count=count)))
        allowed = f"must be at most {most} characters, but for a number at its end, with env.count > 1"
        assert str(caught.value) == f"env.name = {name!r}: {allowed}"
    check(RunConfig(env=EnvConfig(name="a" * 64)))
