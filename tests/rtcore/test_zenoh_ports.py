"""Ports that all processes of a run on one machine agree on."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from rtcore.channels import PROCESSES
from rtcore.config import ConfigError
from rtcore.zenoh_ports import FIRST, LAST, local_ports


def test_the_first_chooses_and_the_others_find(tmp_path: Path) -> None:
    ports = local_ports(tmp_path)
    assert set(ports) == set(PROCESSES)
    assert all(FIRST <= port < LAST for port in ports.values())
    with socket.create_server(("127.0.0.1", ports["env_server"])):  # in use: it is still the run's
        assert local_ports(tmp_path) == ports


def test_ports_in_use_are_not_chosen(tmp_path: Path) -> None:
    wanted = local_ports(tmp_path)
    (tmp_path / "ports.json").unlink()
    with socket.create_server(("127.0.0.1", wanted["learner"])):
        other = local_ports(tmp_path)
    assert not set(other.values()) & set(wanted.values())
    (tmp_path / "ports.json").unlink()
    assert local_ports(tmp_path) == wanted  # they follow from the place


@pytest.mark.parametrize("text", ["", "{}", '{"env_server": "x"}'])
def test_a_damaged_file_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "ports.json").write_text(text)
    with pytest.raises(ConfigError, match=r"^link = '.*ports\.json': must hold a port for each process"):
        local_ports(tmp_path)
