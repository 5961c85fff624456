"""`tenuto keys init`: what it makes, for whom, and that it makes all or nothing."""

from __future__ import annotations

import stat
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from launcher import keys
from launcher.cli import run_command
from rtcore.config import ConfigError
from rtcore.signing import ROLES, identity
from tests.launcher.commands import tenuto, tree

NOW = datetime(2026, 1, 31, 12, tzinfo=UTC)


@pytest.fixture
def home(tmp_path: Path) -> Path:
    keys.make(tmp_path / "keys", ["10.1.2.3", "box.example", "localhost"], days=30, now=NOW)
    return tmp_path / "keys"


def certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


def test_every_role_has_its_files_and_only_the_learner_signs(home: Path) -> None:
    found = {str(path.relative_to(home)) for path in tree(home) if path.is_file()}
    each = {"cert.pem", "key.pem", "ca.pem", "policy.pub"}
    wanted = {f"{role}/{name}" for role in ROLES for name in each}
    assert found == wanted | {"learner/policy.key", "ca/ca.key", "ca/ca.pem"}


def test_private_keys_are_their_owners_alone(home: Path) -> None:
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tree(home) if path.is_file()}
    assert {name for name, mode in modes.items() if mode & 0o077 == 0} == {"key.pem", "policy.key", "ca.key"}
    folders = [home, *(path for path in tree(home) if path.is_dir())]
    assert {stat.S_IMODE(path.stat().st_mode) for path in folders} == {0o700}
    assert len({(home / role / "key.pem").read_bytes() for role in ROLES}) == len(ROLES)


def test_a_certificate_says_who_where_and_until_when(home: Path) -> None:
    authority = certificate(home / "ca" / "ca.pem")
    for role in ROLES:
        one = certificate(home / role / "cert.pem")
        assert [name.value for name in one.subject.get_attributes_for_oid(NameOID.COMMON_NAME)] == [role]
        one.verify_directly_issued_by(authority)
        names = one.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert names.get_values_for_type(x509.DNSName) == ["localhost", "box.example"]
        addresses = [ip_address("127.0.0.1"), ip_address("10.1.2.3")]
        assert names.get_values_for_type(x509.IPAddress) == addresses
        assert one.not_valid_after_utc == NOW + timedelta(days=30)
        assert not one.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        usage = set(one.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        assert usage == {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH}
        assert identity(str(home), role, NOW) is not None


def test_the_command_says_what_it_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["keys", "init", str(tmp_path / "keys"), "--host", "a", "--host", "b"]) == 0
    said = capsys.readouterr().out
    assert all(f"{role}/" in said for role in ROLES)
    assert "policy.key: signs policies" in said and "Copy to each host" in said
    names = certificate(tmp_path / "keys" / "agent_service" / "cert.pem").extensions
    found = names.get_extension_for_class(x509.SubjectAlternativeName).value
    assert found.get_values_for_type(x509.DNSName) == ["localhost", "a", "b"]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "keys = '': must be init: tenuto keys init DIR"),
        (["make"], "keys = 'make': must be init: tenuto keys init DIR"),
        (["init"], "DIRECTORY"),
        (["init", "keys"], "directory = 'keys': must not exist yet"),
        (["init", "new", "--host", "a:80"], "host = 'a:80': must be a host's name or address"),
        (["init", "new", "--host", ""], "host = '': must be a host's name or address"),
        (["init", "new", "--days", "0"], "days = 0: must be in 1..36500"),
        (["init", "/proc/new"], "directory = '/proc/new': must be a path to write to"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    arguments: list[str], line: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "keys").mkdir()
    before = tree(tmp_path)
    assert run_command(["keys", *arguments]) == 2
    said = capsys.readouterr().err
    assert line.lower() in said.lower() and len(said.splitlines()) == 1
    assert tree(tmp_path) == before


def test_a_failure_half_way_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: bytes, mode: int = 0) -> None:
        if path.parent.name == "recorder":
            raise OSError(28, "No space left on device")
        write(path, data, mode)

    write = keys._write
    monkeypatch.setattr(keys, "_write", full)
    with pytest.raises(ConfigError, match=r"must be a path to write to \(No space left on device\)"):
        keys.make(tmp_path / "keys", now=NOW)
    assert tree(tmp_path) == set()


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        ("recorder/cert.pem", "must be a file to read"),
        ("operator/key.pem", "must be a file to read"),
        ("expired", "must be valid now"),
    ],
)
def test_a_run_with_wrong_keys_is_one_line_and_exit_code_2(tmp_path: Path, spoil: str, line: str) -> None:
    keys.make(tmp_path / "keys", days=1, now=NOW if spoil == "expired" else datetime.now(UTC))
    if spoil != "expired":
        (tmp_path / "keys" / spoil).unlink()
    before = tree(tmp_path)
    done = tenuto("run", "pointmass", "--run-dir", "run", "--link.secure", "keys", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("tenuto: link.secure = ") and line in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert tree(tmp_path) == before


def test_a_process_with_anothers_certificate_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    keys.make(tmp_path / "keys", now=datetime.now(UTC))
    (tmp_path / "keys" / "agent_service").rename(tmp_path / "keys" / "spare")
    (tmp_path / "keys" / "recorder").rename(tmp_path / "keys" / "agent_service")
    done = tenuto("agent", "pointmass", "--run-dir", "run", "--link.secure", "keys", cwd=tmp_path)
    assert done.returncode == 2
    assert "must be the certificate of agent_service; it is that of recorder" in done.stderr
    assert not (tmp_path / "run").exists()
    endpoint = tenuto(
        "env", "pointmass", "--run-dir", "run", "--link.secure", "keys", "--listen", "tcp/h:1", cwd=tmp_path
    )
    assert endpoint.returncode == 2
    assert endpoint.stderr.endswith("must be like tls/host:port, as link.secure is given\n")
    assert not (tmp_path / "run").exists()
