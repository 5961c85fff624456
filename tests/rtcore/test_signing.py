"""Certificates that a process may use, and signatures that stand for a policy."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from launcher import keys
from rtcore import channels
from rtcore.config import ConfigError, LinkConfig
from rtcore.messages import Policy
from rtcore.signing import ROLES, identity, open_signer, open_verifier
from rtcore.weights import WeightsError, sha256
from tests.rtcore.bus_samples import policy

NOW = datetime.now(UTC)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("keys") / "ours"
    keys.make(made, now=NOW)
    return made


@pytest.fixture
def copied(home: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(home, tmp_path / "keys"))


def signed(home: Path, run: str = "run", version: int = 4) -> Policy:
    return open_signer(LinkConfig(secure=str(home)), channels.LEARNER, run).sign(whole(version))


def whole(version: int) -> Policy:
    """With the hash of its weights."""
    plain = policy(version)
    return replace(plain, sha256=sha256(plain.weights))


def test_without_security_a_policy_passes_as_it_is() -> None:
    plain = policy(1)
    assert open_signer(LinkConfig(), channels.LEARNER, "run").sign(plain) is plain
    open_verifier(LinkConfig(), channels.AGENT, "run").check(plain)
    assert identity("", channels.AGENT) is None


def test_what_the_learner_signs_everybody_can_check(home: Path) -> None:
    one = signed(home)
    assert replace(one, signature=b"") == whole(4)
    for role in ROLES:
        open_verifier(LinkConfig(secure=str(home)), role, "run").check(one)


@pytest.mark.parametrize(
    "change",
    [
        {"version": 5},
        {"window": 2},
        {"iterate": 3},
        {"algo": "sac"},
        {"sha256": "01"},
        {"created_ns": 4},
        {"architecture": policy(1).architecture.__class__(
            kind="tanh_gaussian_mlp", observation_dim=17, action_dim=6, hidden=[256]
        )},
        {"signature": b""},
        {"signature": b"\0" * 64},
        {"signature": b"short"},
    ],
)  # fmt: skip
def test_a_changed_policy_is_nobodys(home: Path, change: dict[str, Any]) -> None:
    verifier = open_verifier(LinkConfig(secure=str(home)), channels.AGENT, "run")
    with pytest.raises(WeightsError, match=r"it is not signed|its signature is not the learner's"):
        verifier.check(replace(signed(home), **change))


def test_other_weights_below_the_learners_signature_are_nobodys(home: Path) -> None:
    verifier = open_verifier(LinkConfig(secure=str(home)), channels.AGENT, "run")
    with pytest.raises(WeightsError, match="sha256 differs"):
        verifier.check(replace(signed(home), weights=b"others"))


def test_a_signature_is_for_one_run_and_by_one_key(home: Path, tmp_path: Path) -> None:
    keys.make(tmp_path / "theirs", now=NOW)
    verifier = open_verifier(LinkConfig(secure=str(home)), channels.AGENT, "run")
    for other in (signed(home, run="another"), signed(tmp_path / "theirs")):
        with pytest.raises(WeightsError, match="not the learner's for this run"):
            verifier.check(other)


def test_only_the_learner_signs(home: Path) -> None:
    for role in ROLES:
        is_signed = open_signer(LinkConfig(secure=str(home)), role, "run").sign(policy(1)).signature != b""
        assert is_signed == (role == channels.LEARNER)


def test_each_role_has_an_identity(home: Path) -> None:
    for role in ROLES:
        found = identity(str(home), role)
        assert found is not None
        assert found.certificate == home / role / "cert.pem"


def test_what_is_missing_or_no_pem_is_one_line(copied: Path) -> None:
    for name in ("cert.pem", "key.pem", "ca.pem"):
        path = copied / "learner" / name
        kept = path.read_bytes()
        path.write_bytes(b"nonsense")
        with pytest.raises(ConfigError, match=rf"^link\.secure = '{path}': must be a .* in PEM$"):
            identity(str(copied), "learner")
        path.unlink()
        with pytest.raises(ConfigError, match=r"must be a file to read, as 'tenuto keys init' makes it \(No"):
            identity(str(copied), "learner")
        path.write_bytes(kept)
        path.chmod(0o600)
    assert identity(str(copied), "learner") is not None
    for name, opened in (("policy.key", open_signer), ("policy.pub", open_verifier)):
        path = copied / "learner" / name
        path.write_bytes(b"nonsense")
        with pytest.raises(ConfigError, match=r"must be a .* key in PEM"):
            opened(LinkConfig(secure=str(copied)), "learner", "run")


def test_another_roles_certificate_is_refused(copied: Path) -> None:
    shutil.copytree(copied / "recorder", copied / "learner", dirs_exist_ok=True)
    with pytest.raises(ConfigError, match=r"must be the certificate of learner; it is that of recorder"):
        identity(str(copied), "learner")


def test_another_authoritys_certificate_is_refused(copied: Path, tmp_path: Path) -> None:
    keys.make(tmp_path / "theirs", now=NOW)
    shutil.copy(tmp_path / "theirs" / "ca" / "ca.pem", copied / "agent_service" / "ca.pem")
    with pytest.raises(ConfigError, match=r"cert\.pem': must be issued by .*ca\.pem"):
        identity(str(copied), "agent_service")


def test_another_certificates_key_is_refused(copied: Path) -> None:
    shutil.copy(copied / "recorder" / "key.pem", copied / "learner" / "key.pem")
    with pytest.raises(ConfigError, match=r"key\.pem': must be the key of the cert\.pem beside it"):
        identity(str(copied), "learner")


def test_a_key_that_others_can_read_is_refused(copied: Path) -> None:
    for name in ("key.pem", "policy.key"):
        (copied / "learner" / name).chmod(0o640)
    with pytest.raises(ConfigError, match=r"key\.pem': must be closed to others: mode 0600, not 0640"):
        identity(str(copied), "learner")
    with pytest.raises(ConfigError, match=r"policy\.key': must be closed to others"):
        open_signer(LinkConfig(secure=str(copied)), "learner", "run")


def test_a_certificate_is_refused_before_and_after_its_time(home: Path) -> None:
    for shift, days in ((-1, "from"), (400, "to")):
        then = NOW + timedelta(days=shift)
        with pytest.raises(ConfigError, match=rf"must be valid now .* it is so .*{days} "):
            identity(str(home), "agent_service", then)
    assert identity(str(home), "agent_service", NOW + timedelta(days=364)) is not None
