"""compose.yaml: made from one source, committed as made, and valid by rules of our own.

No container engine is asked: the file is judged by what the Compose specification says.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from launcher import options
from launcher.cli import COMMANDS
from launcher.deploy import DEFAULT_RUN, PORT, ROUTER, RUN, USER, as_compose, compose, render, services
from launcher.health import HealthOptions
from launcher.parsing import parse
from launcher.router import RouterOptions
from rtcore import cast
from rtcore.channels import AGENT, ENV_SERVER, LEARNER, PROCESSES, RECORDER
from rtcore.config import ConfigError, SuperviseConfig

ROOT = Path(__file__).parents[2]
DURATION = re.compile(r"\d+(ms|s|m|h)")
KEYS = {
    "image", "build", "command", "user", "init", "restart", "stop_grace_period", "healthcheck",
    "security_opt", "cap_drop", "read_only", "tmpfs", "volumes", "depends_on", "ports", "ulimits",
}  # fmt: skip


@pytest.fixture(scope="module")
def file() -> dict[str, Any]:
    found = yaml.safe_load((ROOT / "compose.yaml").read_text())
    assert isinstance(found, dict)
    return found


def test_the_committed_file_is_the_rendered_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert compose([]) == 0
    assert capsys.readouterr().out == (ROOT / "compose.yaml").read_text()


def test_yaml_reads_what_was_meant(file: dict[str, Any]) -> None:
    assert file == as_compose(services())
    odd = {"a": {"b": [], "c": {}, "d": ['"', "x: y", "no", "1"], "e": True, "f": -1}}
    assert yaml.safe_load(render_mapping(odd)) == odd


def render_mapping(node: dict[str, Any]) -> str:
    from launcher.deploy import _yaml

    return _yaml(node, 0)


def test_every_process_and_a_router_is_a_service(file: dict[str, Any]) -> None:
    assert list(file) == ["name", "services", "volumes"]
    assert list(file["services"]) == [ROUTER, *PROCESSES]


def test_services_are_as_the_specification_wants_them(file: dict[str, Any]) -> None:
    for name, service in file["services"].items():
        assert set(service) <= KEYS, name
        assert all(isinstance(word, str) for word in service["command"])
        assert re.fullmatch(r"on-failure:\d+", service["restart"])
        assert DURATION.fullmatch(service["stop_grace_period"])
        check = service["healthcheck"]
        assert set(check) == {"test", "interval", "timeout", "retries", "start_period"}
        assert check["test"][0] == "CMD"
        assert all(DURATION.fullmatch(check[key]) for key in ("interval", "timeout", "start_period"))
        assert all(dependency in file["services"] for dependency in service.get("depends_on", ()))
        for mount in service.get("volumes", ()):
            volume, _, path = mount.partition(":")
            assert volume in file["volumes"]
            assert path.startswith("/")
        assert all(re.fullmatch(r"127\.0\.0\.1:\d+:\d+", port) for port in service.get("ports", ()))


def test_who_runs_has_no_more_rights_than_it_needs(file: dict[str, Any]) -> None:
    for service in file["services"].values():
        assert service["user"] == f"{USER}:{USER}"
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["read_only"] is True
    limited = [name for name, service in file["services"].items() if "ulimits" in service]
    assert limited == [ENV_SERVER, AGENT]


def test_they_are_started_again_as_often_as_by_tenuto_run(file: dict[str, Any]) -> None:
    supervise = SuperviseConfig()
    for name in PROCESSES:
        service = file["services"][name]
        assert service["restart"] == f"on-failure:{supervise.limit}"
        # a check waits for a turn for as long as a process may be stuck
        assert int(service["healthcheck"]["timeout"].rstrip("s")) > supervise.stuck_s
        assert "--kill-stuck" in service["healthcheck"]["test"]
        assert service["init"] is True  # else nothing in the container could kill it


def test_the_world_ends_first(file: dict[str, Any]) -> None:
    after = {name: service.get("depends_on", []) for name, service in file["services"].items()}
    assert after == {
        ENV_SERVER: [AGENT], AGENT: [LEARNER], LEARNER: [RECORDER], RECORDER: [ROUTER], ROUTER: [],
    }  # fmt: skip


def test_every_command_is_one_that_tenuto_understands() -> None:
    names = {command.name for command in COMMANDS}
    for service in services():
        tenuto, name, *arguments = service.command
        assert (tenuto, name in names) == ("tenuto", True)
        if service.name == ROUTER:
            assert parse(RouterOptions, arguments, prog="", description="").listen == (f"tcp/0.0.0.0:{PORT}",)
            continue
        config, chosen = options.read(options.ProcessOptions, arguments, prog="", description="")
        assert (config.duration_s, str(chosen.run_dir)) == (0.0, str(RUN))
        assert chosen.connect == (f"tcp/{ROUTER}:{PORT}",)
        health = parse(HealthOptions, service.check[2:], prog="", description="")
        assert (health.process, str(health.run_dir), health.kill_stuck) == (service.name, str(RUN), True)


def test_another_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert compose(["pointmass", "--env.hz", "50"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("# Made by `tenuto compose pointmass --env.hz 50 --duration-s 0`")
    command = yaml.safe_load(text)["services"][LEARNER]["command"]
    assert command[:7] == ["tenuto", "learn", "pointmass", "--env.hz", "50", "--duration-s", "0"]


def test_a_fleet_has_a_service_for_each_environment(capsys: pytest.CaptureFixture[str]) -> None:
    assert compose(["pointmass", "--env.count", "3"]) == 0
    found = yaml.safe_load(capsys.readouterr().out)["services"]
    assert list(found) == [
        ROUTER, *(f"{role}-{i}" for role in (ENV_SERVER, AGENT) for i in range(3)), LEARNER, RECORDER,
    ]  # fmt: skip
    assert found["env_server-2"]["command"][-2:] == ["--index", "2"]
    assert found["env_server-2"]["command"][:5] == ["tenuto", "env", "pointmass", "--env.count", "3"]
    assert found["env_server-2"]["healthcheck"]["test"][1:4] == ["tenuto", "health", "env_server.2"]
    assert "--index" not in found[LEARNER]["command"]
    after = {name: service.get("depends_on", []) for name, service in found.items()}
    assert after == {
        **{f"{ENV_SERVER}-{i}": [f"{AGENT}-{i}"] for i in range(3)},
        **{f"{AGENT}-{i}": [LEARNER] for i in range(3)},
        LEARNER: [RECORDER], RECORDER: [ROUTER], ROUTER: [],
    }  # fmt: skip
    limited = {name for name, service in found.items() if "ulimits" in service}
    assert limited == set(found) - {ROUTER, LEARNER, RECORDER}


def test_every_command_of_a_fleet_is_one_that_tenuto_understands() -> None:
    run = ("pointmass", "--env.count", "2", "--duration-s", "0")
    config, _ = options.read(options.RunOptions, run, prog="", description="")
    found = {service.name: service for service in services(run, config)}
    for part in cast.parts(config):
        service = found[part.name.replace(".", "-")]
        told, chosen = options.read(options.ProcessOptions, service.command[2:], prog="", description="")
        assert (told, chosen.index) == (config, part.index)
        health = parse(HealthOptions, service.check[2:], prog="", description="")
        assert health.process == part.name


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["pointmass", "--env.hz", "-1"], "env.hz"),
        (["nothing"], "preset"),
        (["--run-dir", "x"], "run_dir"),
        (["--link.secure=x"], "link.secure"),
        (["--index", "1"], "index"),
        (["pointmass", "--env.count", "17"], "env.count"),
    ],
)
def test_wrong_input_prints_nothing(
    arguments: list[str], field: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ConfigError) as caught:
        compose(arguments)
    assert caught.value.name == field
    assert capsys.readouterr().out == ""


def test_the_image_has_the_same_user_and_takes_only_what_it_needs() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    assert f"useradd --uid {USER}" in dockerfile
    lines = [line for line in dockerfile.splitlines() if line and not line.startswith(("#", " "))]
    assert lines[-2:] == ["USER tenuto", 'CMD ["tenuto"]']
    assert "pip install" in dockerfile
    assert "-r requirements.lock" in dockerfile
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    kept = {line.removeprefix("!") for line in ignored if line.startswith("!")}
    assert "*" in ignored
    packages = {
        name.partition(".")[0]
        for name in re.findall(r'"([a-z_.]+)"', _packages((ROOT / "pyproject.toml").read_text()))
    }
    assert packages <= kept
    assert {"requirements.lock", "pyproject.toml", "README.md", "LICENSE"} <= kept
    assert all((ROOT / name).exists() for name in kept)


def _packages(pyproject: str) -> str:
    return pyproject.partition("packages = [")[2].partition("]")[0]


def test_the_default_run_goes_on_until_it_is_stopped() -> None:
    assert DEFAULT_RUN[-2:] == ("--duration-s", "0")
    assert render(services(), "x") == render(services(DEFAULT_RUN), "x")
