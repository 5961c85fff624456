"""A process's keys at work: its certificate on secured links, and who vouches for a policy.

The learner signs what it publishes with Ed25519 (RFC 8032), an agent adopts only what is signed. Where
nothing is secured, nothing is signed and everything is accepted. `tenuto keys init` makes the files; every
process has a directory of its own below `link.secure`, named after its role.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import msgspec

from rtcore.channels import LEARNER, PROCESSES
from rtcore.config import ConfigError, LinkConfig
from rtcore.messages import Policy
from rtcore.weights import WeightsError, sha256

if TYPE_CHECKING:  # 0.09 s to import: only where it is used
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
    from cryptography.x509 import Certificate

OPERATOR = "operator"  # the launcher and its commands
ROLES = (*PROCESSES, OPERATOR)  # each has a certificate with its name as the common name
CERTIFICATE, KEY, AUTHORITY = "cert.pem", "key.pem", "ca.pem"
POLICY_KEY, POLICY_PUBLIC = "policy.key", "policy.pub"
MADE_BY = "as 'tenuto keys init' makes it"
STATEMENT = b"tenuto-policy-1"  # what is signed is said first: nothing else can pass for it


@dataclass(frozen=True)
class Identity:
    """Files that prove who a process is. Checked by `identity`."""

    role: str
    certificate: Path
    key: Path
    authority: Path  # the certificate of who may issue one


class Signer(Protocol):
    """Signs policies, on the thread that publishes them."""

    def sign(self, policy: Policy) -> Policy:
        """The same policy with its `signature`."""


class Verifier(Protocol):
    """Checks policies, on the thread beside acting."""

    def check(self, policy: Policy) -> None:
        """Return if the signature is the learner's, over this policy.

        Raises:
            WeightsError: it is not.
        """


class NoSigner:
    """Leaves policies as they are."""

    def sign(self, policy: Policy) -> Policy:
        """The policy itself."""
        return policy


class NoVerifier:
    """Accepts whoever wrote it."""

    def check(self, policy: Policy) -> None:
        """Return."""


class PolicySigner:
    """Signs for one run. The weights enter by their hash, which who checks the signature checks as well."""

    def __init__(self, run_name: str, key: Ed25519PrivateKey) -> None:
        self._run_name = run_name
        self._key = key

    def sign(self, policy: Policy) -> Policy:
        """The same policy with its `signature`."""
        signature = self._key.sign(_statement(self._run_name, policy))
        return msgspec.structs.replace(policy, signature=signature)


class PolicyVerifier:
    """Checks for one run. That a version is new is for whoever adopts it to say."""

    def __init__(self, run_name: str, key: Ed25519PublicKey) -> None:
        self._run_name = run_name
        self._key = key

    def check(self, policy: Policy) -> None:
        """Return if the signature is the learner's, over this policy; see `Verifier`."""
        from cryptography.exceptions import InvalidSignature

        if not policy.signature:
            raise WeightsError("it is not signed")
        try:
            self._key.verify(policy.signature, _statement(self._run_name, policy))
        except InvalidSignature as error:
            raise WeightsError("its signature is not the learner's for this run") from error
        if sha256(policy.weights) != policy.sha256:  # the learner's signature, over others' weights
            raise WeightsError("sha256 differs")


def open_signer(link: LinkConfig, role: str, run_name: str) -> Signer:
    """The signer of process `role`: only a secured learner signs.

    Raises:
        ConfigError: `link.secure` has no key to sign with.
    """
    if not link.secure or role != LEARNER:
        return NoSigner()
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    path = Path(link.secure) / role / POLICY_KEY
    data = _secret(path)
    try:
        key = load_pem_private_key(data, None)
    except (ValueError, TypeError) as error:
        raise _wrong(path, "must be a private key in PEM") from error
    if not isinstance(key, Ed25519PrivateKey):
        raise _wrong(path, "must be an Ed25519 key")
    return PolicySigner(run_name, key)


def open_verifier(link: LinkConfig, role: str, run_name: str) -> Verifier:
    """The verifier of process `role`.

    Raises:
        ConfigError: `link.secure` has no key to check with.
    """
    if not link.secure:
        return NoVerifier()
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    from cryptography.hazmat.primitives.serialization import load_pem_public_key

    path = Path(link.secure) / role / POLICY_PUBLIC
    data = _read(path)
    try:
        key = load_pem_public_key(data)
    except ValueError as error:
        raise _wrong(path, "must be a public key in PEM") from error
    if not isinstance(key, Ed25519PublicKey):
        raise _wrong(path, "must be an Ed25519 key")
    return PolicyVerifier(run_name, key)


def identity(secure: str, role: str, now: datetime | None = None) -> Identity | None:
    """The checked certificate of `role` below the directory `secure`; None where that is empty.

    Raises:
        ConfigError: a file is missing, cannot be read, or is open to others; the certificate is another
            role's, not yet or no longer valid, not of the authority beside it, or not of the key.
    """
    if not secure:
        return None
    home = Path(secure) / role
    found = Identity(role, home / CERTIFICATE, home / KEY, home / AUTHORITY)
    certificate, authority = _certificate(found.certificate), _certificate(found.authority)
    _check_name(found.certificate, certificate, role)
    _check_dates(found.authority, authority, now or datetime.now(UTC))
    _check_dates(found.certificate, certificate, now or datetime.now(UTC))
    _check_issuer(found, certificate, authority)
    _check_key(found.key, certificate)
    return found


def _statement(run_name: str, policy: Policy) -> bytes:
    content = (
        run_name,
        policy.version,
        policy.window,
        policy.iterate,
        policy.algo,
        policy.architecture,
        policy.sha256,
        policy.created_ns,
    )
    return STATEMENT + msgspec.msgpack.encode(content)


def _certificate(path: Path) -> Certificate:
    from cryptography.x509 import load_pem_x509_certificate

    data = _read(path)
    try:
        return load_pem_x509_certificate(data)
    except ValueError as error:
        raise _wrong(path, "must be a certificate in PEM") from error


def _check_name(path: Path, certificate: Certificate, role: str) -> None:
    from cryptography.x509.oid import NameOID

    names = [str(name.value) for name in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    if names != [role]:
        raise _wrong(path, f"must be the certificate of {role}; it is that of {', '.join(names) or 'nobody'}")


def _check_dates(path: Path, certificate: Certificate, now: datetime) -> None:
    first, last = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if not first <= now <= last:
        raise _wrong(path, f"must be valid now ({now:%Y-%m-%d %H:%M} UTC); it is so from {first} to {last}")


def _check_issuer(found: Identity, certificate: Certificate, authority: Certificate) -> None:
    from cryptography.exceptions import InvalidSignature

    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise _wrong(found.certificate, f"must be issued by {found.authority}") from error


def _check_key(path: Path, certificate: Certificate) -> None:
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    data = _secret(path)
    try:
        key = load_pem_private_key(data, None)
    except (ValueError, TypeError) as error:
        raise _wrong(path, "must be a private key in PEM") from error
    if key.public_key() != certificate.public_key():
        raise _wrong(path, f"must be the key of the {CERTIFICATE} beside it")


def _secret(path: Path) -> bytes:
    data = _read(path)
    mode = path.stat().st_mode & 0o777
    if mode & 0o077:
        raise _wrong(path, f"must be closed to others: mode 0600, not {mode:04o}")
    return data


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _wrong(path, f"must be a file to read, {MADE_BY} ({error.strerror})") from error


def _wrong(path: Path, allowed: str) -> ConfigError:
    return ConfigError("link.secure", str(path), allowed)
